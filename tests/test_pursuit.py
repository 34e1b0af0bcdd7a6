"""Arms that have fallen behind meet their targets where these will be."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from teleoperated import STEP, follow_targets, some_vertices

import grr_torch
from grr_torch import Teleoperator
from grr_torch.applications.arms import Arms
from grr_torch.applications.lines import Follower
from grr_torch.applications.pursuit import _TOO_LATE, Pursuit
from grr_torch.applications.routes import Routes
from grr_torch.experiments.paths import draw_paths
from grr_torch.experiments.teleoperation import starts
from grr_torch.projection.project import DEFAULT_TOLERANCES
from grr_torch.spaces.configuration import difference


@pytest.fixture(scope="module")
def roadmap(kinova_roadmap) -> grr_torch.Roadmap:
    return kinova_roadmap


def _followed(roadmap, targets, foresight):
    """Tools (steps, arms, 3) and statuses of arms that follow targets (steps, arms, 3)."""
    start = starts(roadmap, targets[0])
    teleoperator = Teleoperator(roadmap, start=start, max_step=STEP, foresight=foresight)
    q, status = follow_targets(teleoperator, targets)
    assert float(torch.cat([start[None], q]).diff(dim=0).abs().max()) <= STEP + 1e-12
    assert not bool(roadmap.robot.in_self_collision(q).any())
    return roadmap.robot.forward_kinematics(q)[0], status


def _behind(tools, targets):
    return float((tools - targets).norm(dim=2).mean())


def test_who_heads_for_where_it_will_meet_its_target_does_not_say_that_it_tracks_it(roadmap, through_holes):
    ahead, status = _followed(roadmap, through_holes, 2.0)
    far = torch.from_numpy(status == "tracking") & ((ahead - through_holes).norm(dim=2) > 0.3)
    assert float(far.double().mean()) < 0.02


def test_targets_that_rest_in_a_hole_are_approached_as_without_foresight(roadmap, through_holes):
    middle = through_holes[100].expand(260, -1, -1)
    targets = torch.cat([through_holes[:100], middle])
    lefts = []
    for foresight in (2.0, 0.0):
        tools, status = _followed(roadmap, targets, foresight)
        lefts.append((tools[-1] - targets[-1]).norm(dim=1))
        assert "holding" not in status[-1]
        assert float((tools[-40:].amax(0) - tools[-40:].amin(0)).max()) < 0.02, "it has come to rest"
    assert float((lefts[0] - lefts[1]).max()) < 0.02


def test_targets_that_can_be_followed_are_followed_all_the_same(roadmap):
    targets = draw_paths(roadmap, "circle_random", 20, seed=5).transpose(0, 1)
    with_, without = (_followed(roadmap, targets, foresight) for foresight in (2.0, 0.0))
    same = (with_[0] == without[0]).all(0).all(1)
    assert float(same.double().mean()) >= 0.9, "some may fall behind where the map is steep"
    assert _behind(with_[0], targets) <= _behind(without[0], targets) + 1e-4


def test_an_arm_that_has_caught_up_follows_its_target_again(roadmap, through_holes):
    """Behind the hole, targets go round in circles, and arms that have met them stay with them."""
    angles = torch.linspace(0.0, 30.0, 600, dtype=torch.float64)[:, None, None]
    ways = torch.cat([angles.cos() - 1.0, angles.sin(), torch.zeros_like(angles)], dim=2)
    circles = through_holes[-1] + 0.04 * ways
    open_ = roadmap.solve(circles).valid.all(0)
    targets = torch.cat([through_holes, circles])[:, open_]
    assert int(open_.sum()) >= 20
    tools, status = _followed(roadmap, targets, 2.0)
    expected, _ = _followed(roadmap, targets, 0.0)
    assert _behind(tools[-300:], targets[-300:]) <= _behind(expected[-300:], targets[-300:]) + 1e-3
    assert float((status[-300:] == "tracking").mean()) > 0.95


def test_targets_that_cross_later_than_they_turn_are_met_too(roadmap, through_holes):
    """A corner shortly before a hole: what is known to go straight for a moment only is followed all the same."""
    along = through_holes[1] - through_holes[0]
    away = torch.stack([-along[:, 1], along[:, 0], 0.0 * along[:, 0]], dim=1)
    before = through_holes[90] + away * torch.arange(60, 0, -1)[:, None, None]
    targets = torch.cat([before, through_holes[90:]])
    ahead, without = (_followed(roadmap, targets, foresight)[0] for foresight in (2.0, 0.0))
    assert _behind(ahead, targets) < 1.35 * _behind(without, targets)
    assert _behind(ahead[-1:], targets[-1:]) < _behind(without[-1:], targets[-1:]) + 0.02


@pytest.mark.parametrize("foresight", [0.3, 0.8, 2.0, 20.0])
def test_foresight_brings_no_arm_farther_behind(roadmap, through_holes, foresight):
    ahead, without = (_followed(roadmap, through_holes, seconds)[0] for seconds in (foresight, 0.0))
    assert _behind(ahead, through_holes) < 1.02 * _behind(without, through_holes)
    if foresight >= 2.0:
        assert _behind(ahead, through_holes) < 0.8 * _behind(without, through_holes)


def _watched(roadmap, targets, rate, seen):
    """Mean motions (steps, arms, 3) of targets (steps, arms, 3), of which some (steps,) are given."""
    follower = Follower(roadmap.robot, roadmap.task, DEFAULT_TOLERANCES, torch.full((7,), STEP, dtype=torch.float64))
    arms = Arms.at(follower, roadmap.configurations[some_vertices(roadmap, targets.shape[1])].numpy().copy())
    watching = Pursuit(follower, roadmap.solver, rate, 2.0)
    motions = []
    for target, given in zip(targets.numpy(), seen, strict=True):
        arms.meeting.unchanged += 1
        which = np.arange(targets.shape[1]) if given else np.arange(0)
        watching.aims(arms, which, target[which])
        motions.append(arms.meeting.velocity.copy())
    return np.stack(motions)


@pytest.mark.parametrize("every", [1, 2, 4], ids=lambda every: f"in every {every}. step")
@pytest.mark.parametrize("refused", [False, True], ids=["held", "refused"])
def test_the_motion_of_targets_that_are_given_seldom_is_known(roadmap, every, refused):
    motion = 1e-3 * torch.randn(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    steps = torch.arange(120)[:, None, None]
    held = steps - steps % every
    seen = ((steps % every == 0) | (not refused)).flatten().tolist()
    found = _watched(roadmap, 0.3 + held * motion, 100.0, seen)
    assert np.abs(found[-1] - motion.numpy()).max() < 0.01 * float(motion.abs().max())


def test_a_leap_after_a_rest_is_no_motion(roadmap):
    """However long it was: how fast a target went there is not known."""
    rest = torch.full((40, 3, 3), 0.2, dtype=torch.float64)
    targets = torch.cat([rest, rest[:3] + 0.3])
    assert not _watched(roadmap, targets, 50.0, [True] * len(targets)).any()


@pytest.mark.parametrize("leap", [0.0, 0.2], ids=["rests", "leaps"])
def test_a_target_that_rests_or_leaps_has_no_motion(roadmap, leap):
    motion = torch.full((3, 3), 2e-3, dtype=torch.float64)
    moving = 0.1 + torch.arange(50)[:, None, None] * motion
    targets = torch.cat([moving, (moving[-1] + leap).expand(9, -1, -1)])
    found = _watched(roadmap, targets, 50.0, [True] * len(targets))
    assert np.abs(found[49] - motion.numpy()).max() < 1e-4
    assert not found[50 if leap else 58].any()


def test_what_counts_as_open_is_mostly_what_can_be_solved(roadmap, through_holes):
    """Nearly all of what can be solved, and little of what cannot: nobody sets off for a place that is not there."""
    longest = torch.full((7,), STEP, dtype=torch.float64)
    looking = Pursuit(Follower(roadmap.robot, roadmap.task, DEFAULT_TOLERANCES, longest), roadmap.solver, 50.0, 2.0)
    points = through_holes.reshape(1, -1, 3)
    open_, needs = looking._needs(roadmap.configurations[some_vertices(roadmap, 1)].numpy(), points.numpy())
    solvable = roadmap.solve(points).valid.numpy()
    assert 0.2 < solvable.mean() < 0.8
    assert (open_ & ~solvable).mean() < 0.15
    assert (solvable & ~open_).mean() < 0.03
    assert (np.isfinite(needs) == open_).all()


@pytest.mark.parametrize(
    ("seconds", "there", "kept"),
    [
        (-0.2, False, True),
        (0.9 * _TOO_LATE, False, True),
        (1.1 * _TOO_LATE, False, False),
        (-0.2, True, True),
        (0.2, True, False),
    ],
)
def test_a_place_is_kept_until_its_target_has_long_come_past_it_or_the_arm_is_there(roadmap, seconds, there, kept):
    """The target has come past it so many seconds ago; before that, an arm that is there waits."""
    rate, motion = 50.0, torch.tensor([[4e-3, 2e-3, 0.0]], dtype=torch.float64)
    q = roadmap.configurations[some_vertices(roadmap, 2)]
    tools = roadmap.robot.forward_kinematics(q)[0]
    follower = Follower(roadmap.robot, roadmap.task, DEFAULT_TOLERANCES, torch.full((7,), STEP, dtype=torch.float64))
    arms = Arms.at(follower, q[:1].numpy().copy())
    place = tools[:1] if there else tools[1:]
    assert float((tools[0] - tools[1]).norm()) > 0.05
    arms.meeting.place[:], arms.meeting.velocity[:], arms.meeting.across[:] = place.numpy(), motion.numpy(), True
    pursuit = Pursuit(follower, roadmap.solver, rate, 2.0)
    target = (place + seconds * rate * motion).numpy()
    assert pursuit._goes_on(arms, np.arange(1), target).tolist() == [kept]
    # a target that comes past it at a distance has turned away
    aside = np.array([[0.0, 0.0, 0.2]])
    assert pursuit._goes_on(arms, np.arange(1), target + aside).tolist() == [False]


@pytest.mark.parametrize("rate", [25.0, 100.0])
def test_foresight_is_in_seconds(roadmap, through_holes, rate):
    """The same motion in fewer or more control steps is led as well."""
    count = int(200 * rate / 50.0)
    index = torch.linspace(0, 199, count).round().long()
    targets = through_holes[index]
    behind = []
    for foresight in (2.0, 0.0):
        arms = Teleoperator(
            roadmap, rate, start=starts(roadmap, targets[0]), max_step=STEP * 50.0 / rate, foresight=foresight
        )
        q, _ = follow_targets(arms, targets)
        behind.append(_behind(roadmap.robot.forward_kinematics(q)[0], targets))
    assert behind[0] < 0.85 * behind[1]


def test_detours_are_the_quickest_routes(roadmap):
    longest = torch.linspace(0.02, 0.06, 7, dtype=torch.float64)
    follower = Follower(roadmap.robot, roadmap.task, DEFAULT_TOLERANCES, longest)
    quick, short = Routes(roadmap, length=follower.duration), Routes(roadmap)
    vertices = some_vertices(roadmap, 40, 2).tolist()
    saved = []
    for a, b in zip(vertices[:20], vertices[20:], strict=True):
        steps = []
        for routes in (quick, short):
            q = roadmap.configurations[routes.between(a, b)]
            motion = difference(q[:-1], q[1:], roadmap.robot.continuous).numpy()
            assert float(np.abs(motion / longest.numpy()).max(1).sum()) <= follower.duration(motion).sum()
            steps.append(float(follower.duration(motion).sum()))
        assert steps[0] == pytest.approx(float(quick.towards(b)[0][a]))
        assert steps[0] <= steps[1] + 1e-9
        saved.append(steps[1] - steps[0])
    assert max(saved) > 1.0
