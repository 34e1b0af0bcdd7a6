"""Arms on the way to the other side of a hole, where they meet their targets, and from there on."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from teleoperated import STEP

import grr_torch
from grr_torch import Teleoperator
from grr_torch.applications import pursuit
from grr_torch.applications.lines import Follower
from grr_torch.applications.pursuit import Pursuit
from grr_torch.experiments.paths import draw_paths
from grr_torch.experiments.teleoperation import starts
from grr_torch.projection.project import DEFAULT_TOLERANCES
from grr_torch.spaces.configuration import difference


@pytest.fixture(scope="module")
def roadmap(kinova_roadmap) -> grr_torch.Roadmap:
    return kinova_roadmap


def _led(roadmap, targets):
    """Tools (steps, arms, 3), where arms meet targets (steps, arms, 3), and whether across a hole (steps, arms)."""
    teleoperator = Teleoperator(roadmap, start=starts(roadmap, targets[0]), max_step=STEP)
    tools, places, across = [], [], []
    for target in targets:
        teleoperator.step(target)
        arms = teleoperator._arms
        tools.append(arms.p.copy())
        places.append(arms.meeting.place.copy())
        across.append(arms.meeting.across & arms.meeting.planned(np.arange(targets.shape[1])))
    return np.stack(tools), np.stack(places), np.stack(across)


def test_where_arms_meet_their_targets_across_a_hole_stays_the_same(roadmap, through_holes):
    """As long as these go straight on: who heads elsewhere in the middle of a swing has come a longer way."""
    tools, places, across = _led(roadmap, through_holes)
    crossing = across.any(0).nonzero()[0]
    assert len(crossing) >= 30
    once = [len(np.unique(places[across[:, arm], arm].round(6), axis=0)) == 1 for arm in crossing]
    assert np.mean(once) >= 0.9
    came = [np.linalg.norm(tools[across[:, arm], arm] - places[across[:, arm], arm], axis=1)[-1] for arm in crossing]
    assert np.mean(np.array(came) < 0.03) >= 0.9
    # it is where the map has a configuration
    ends = np.stack([places[across[:, arm], arm][0] for arm in crossing])
    assert roadmap.solve(torch.from_numpy(ends)).valid.double().mean() >= 0.95


def test_who_is_behind_catches_up_along_the_way(roadmap):
    """From where an arm has met its target's way beyond a hole on, it does not leave it any more."""
    paths = torch.cat([draw_paths(roadmap, "line_random", 100, seed=seed) for seed in (1, 3)]).transpose(0, 1)
    targets = torch.cat([paths, paths[-1:].expand(60, -1, -1)])
    tools, _, across = _led(roadmap, targets)
    way = (paths[-1] - paths[0]).numpy()
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    offsets = tools - paths[0].numpy()
    aside = np.linalg.norm(offsets - (offsets * way).sum(2, keepdims=True) * way, axis=2)
    widest = []
    for arm in (across.any(0) & ~across[-1]).nonzero()[0]:
        after = int(across[:, arm].nonzero()[0][-1]) + 1
        met = after + (aside[after:, arm] < 0.01).argmax()
        widest.append(aside[met:, arm].max())
    assert len(widest) >= 30
    assert max(widest) < 0.03


def test_arms_stay_on_a_swing_to_its_end(roadmap, through_holes):
    """Though their tools could go straight to where they meet their targets before."""
    teleoperator = Teleoperator(roadmap, start=starts(roadmap, through_holes[0]), max_step=STEP)
    everyone, swinging = np.arange(through_holes.shape[1]), []
    for target in through_holes:
        teleoperator.step(target)
        arms = teleoperator._arms
        swinging.append(arms.detour.swinging(everyone) & arms.meeting.across & arms.meeting.planned(everyone))
    steps = np.stack(swinging).sum(0)
    # half a turn takes 78 steps
    assert np.median(steps[steps > 0]) > 70
    assert (steps > 0).sum() >= 30


@pytest.mark.parametrize("back_at", [110, 140])
def test_arms_turn_round_with_their_targets(roadmap, through_holes, back_at):
    """Targets that turn in the hole and go back, while arms are on their way to the other side."""
    targets = torch.cat([through_holes[:back_at], through_holes[:back_at].flip(0), through_holes[:1].repeat(150, 1, 1)])
    tools, _, across = _led(roadmap, targets)
    assert across[back_at - 1].any()
    assert not across[back_at + 10 : back_at + 20, across[back_at - 1]].any()
    assert np.linalg.norm(tools[-1] - targets[-1].numpy(), axis=1).max() < 0.01


@pytest.fixture
def ahead_of_holes(roadmap, through_holes):
    """A pursuit, and what its `_beyond` takes of arms at 40 steps whose targets are in holes at 60: rows, arguments."""
    longest = torch.full((7,), STEP, dtype=torch.float64)
    follower = Follower(roadmap.robot, roadmap.task, DEFAULT_TOLERANCES, longest)
    instance = Pursuit(follower, roadmap.solver, 50.0, 2.0)
    solution = roadmap.solve(through_holes[[40, 100]])
    inside = solution.valid[0] & ~solution.valid[1]
    q = solution.configurations[0][inside].numpy()
    points = (
        through_holes[60 + torch.from_numpy(instance._ahead).long()][:, inside].transpose(0, 1).contiguous().numpy()
    )
    assert len(q) >= 10
    open_, _ = instance._needs(q, points)
    out = (open_ & np.logical_or.accumulate(~open_, axis=1)).argmax(1)
    return instance, inside.nonzero()[:, 0], (q, points, np.ones_like(open_), out)


def test_targets_that_cross_the_middle_of_a_hole_are_met_later(roadmap, through_holes, ahead_of_holes, monkeypatch):
    """A quarter of a second beyond where the map can be followed again, if a joint has to make half a turn for it."""
    instance, inside, given = ahead_of_holes
    found = []
    for later in (0.0, pursuit._LATER):
        monkeypatch.setattr(pursuit, "_LATER", later)
        times, there, _ = instance._beyond(*given)
        found.append(times[there])
        rows = there.nonzero()[0]
        met = torch.from_numpy(np.rint(60 + times[there])).long()
        ends = roadmap.solve(through_holes[met, inside[rows]])
        assert ends.valid.double().mean() > 0.95
        if later == 0.0:
            start = torch.from_numpy(given[0][rows])
            turns = difference(start, ends.configurations, roadmap.robot.continuous).abs().amax(1)
    added = found[1] - found[0]
    half = (turns > pursuit._HALF_TURN + 0.1).numpy()
    assert half.sum() >= 10
    assert np.median(added[half]) == pytest.approx(50.0 * pursuit._LATER)
    assert (added >= 0.0).all()


def test_targets_are_met_where_the_map_solves_their_way_from_then_on(
    roadmap, through_holes, ahead_of_holes, monkeypatch
):
    instance, inside, given = ahead_of_holes
    monkeypatch.setattr(pursuit, "_LATER", 0.0)
    times, there, _ = instance._beyond(*given)
    rows = inside[there.nonzero()[0]]
    every = int(np.diff(instance._ahead)[0])
    met = torch.from_numpy(np.rint(60 + times[there])).long()
    before, here, after = (roadmap.solve(through_holes[met + steps, rows]).valid for steps in (-every, 0, every))
    assert bool((here & after).all())
    # and no later than that
    assert before.double().mean() < 0.1


@pytest.mark.parametrize("degrees", [20, 30])
def test_a_place_to_meet_is_given_up_when_the_target_bends_away_from_it(roadmap, through_holes, degrees):
    """Targets that bend in the hole, too little to have turned."""
    bend, steps = 100, np.arange(60)[:, None, None]
    way = (through_holes[1] - through_holes[0]).numpy()
    across = np.cross(way, [0.0, 0.0, 1.0])
    across *= np.linalg.norm(way, axis=1, keepdims=True) / np.linalg.norm(across, axis=1, keepdims=True)
    angle = np.radians(degrees)
    bent = np.cos(angle) * way + np.sin(angle) * across
    targets = torch.cat([through_holes[:bend], torch.from_numpy(through_holes[bend - 1].numpy() + (1 + steps) * bent)])
    _, places, meets = _led(roadmap, targets)
    speed = np.linalg.norm(bent, axis=1)
    kept = 0
    for arm in meets[bend - 1].nonzero()[0]:
        direction = bent[arm] / speed[arm]

        def aside(place, arm=arm, direction=direction):
            offset = place - targets[-1, arm].numpy()
            return np.linalg.norm(offset - (offset @ direction) * direction)

        kept += aside(places[bend - 1, arm]) > 0.06
        # by then its mean motion is the new one
        later = meets[bend + 25 :, arm].nonzero()[0] + bend + 25
        assert all(aside(places[step, arm]) < 0.06 for step in later)
    assert kept >= 5


def test_targets_beside_the_middle_are_met_as_soon_as_they_can_be(roadmap, monkeypatch):
    paths = draw_paths(roadmap, "line_random", 100, seed=3).transpose(0, 1)
    met = []
    for later in (0.0, pursuit._LATER):
        monkeypatch.setattr(pursuit, "_LATER", later)
        met.append(_led(roadmap, paths))
    crossing = met[0][2].any(0)
    assert crossing.sum() >= 10
    same = (met[0][0] == met[1][0]).all(axis=(0, 2))
    assert same[crossing].mean() > 0.7
