"""Teleoperation where targets cannot be reached, or hardly."""

from __future__ import annotations

import pytest
import torch
from teleoperated import follow_targets, some_vertices

import grr_torch
from grr_torch import Teleoperator
from grr_torch.experiments.paths import draw_paths
from grr_torch.experiments.teleoperation import starts


@pytest.fixture(scope="module")
def roadmap(kinova_roadmap) -> grr_torch.Roadmap:
    return kinova_roadmap


def test_targets_out_of_reach_are_approached_and_slid_along(roadmap):
    centre, radius = torch.tensor([0.0, 0.0, 0.3], dtype=torch.float64), 1.6
    angles = torch.linspace(0.0, 1.0, 120, dtype=torch.float64)
    targets = centre + radius * torch.stack([angles.cos(), angles.sin(), torch.zeros_like(angles)], dim=1)
    vertex = roadmap.solver.nearest(targets[:1])[1][0, 0]
    teleoperator = Teleoperator(roadmap, start=roadmap.configurations[vertex])
    q, status = follow_targets(teleoperator, targets)
    tool = roadmap.robot.forward_kinematics(q)[0]
    assert set(status[20:]) <= {"unreachable", "detouring"}
    azimuth = torch.atan2(tool[:, 1], tool[:, 0])
    assert float((azimuth[40:] - angles[40:]).abs().max()) < 0.45
    # no freeze: at 50 Hz it does not stand still for half a second
    still = (q.diff(dim=0).abs().amax(1) < 1e-4).numpy()
    longest = max((len(run) for run in "".join("x" if s else " " for s in still[40:]).split()), default=0)
    assert longest < 25


def test_sliding_along_the_edge_of_reach_is_even(roadmap):
    """An arm that finds a nearer point every few steps goes there evenly, and does not stop and go."""
    start = roadmap.configurations[some_vertices(roadmap, 40, 5)]
    home = roadmap.robot.forward_kinematics(start)[0]
    angles = torch.linspace(0.0, 0.8, 160, dtype=torch.float64)[:, None] + torch.atan2(home[:, 1], home[:, 0])
    level = home[:, 2].expand_as(angles)
    targets = torch.stack([1.2 * angles.cos(), 1.2 * angles.sin(), level], dim=2)
    q, status = follow_targets(Teleoperator(roadmap, start=start, max_step=0.04), targets)
    steps = q.diff(dim=0)[60:]
    sliding = torch.from_numpy((status == "unreachable")[61:])
    assert float(sliding.double().mean()) > 0.9
    lengths, changes = steps.norm(dim=2), steps.diff(dim=0).norm(dim=2)
    assert float(changes.mean()) < 0.5 * float(lengths.mean())


@pytest.fixture(scope="module")
def on_circles(roadmap):
    """Targets (200, 100, 3) on circles that leave the reach, tools there and before, and what the arms were doing."""
    paths = draw_paths(roadmap, "circle_out", 100, seed=0)
    start = starts(roadmap, paths[:, 0])
    targets = paths.transpose(0, 1)
    q, status = follow_targets(Teleoperator(roadmap, start=start, max_step=0.04), targets)
    tools = roadmap.robot.forward_kinematics(torch.cat([start[None], q]))[0]
    return targets, tools, status


def test_an_arm_that_loses_its_target_holds_from_where_it_is(on_circles):
    targets, tools, status = on_circles
    lost = torch.from_numpy((status[1:-6] == "unreachable") & (status[:-7] == "tracking"))
    assert int(lost.sum()) > 80
    before, after, target = (part[lost] for part in (tools[1:-7], tools[8:], targets[7:]))
    retreated = (after - target).norm(dim=1) - (before - target).norm(dim=1)
    assert float((retreated > 1e-3).double().mean()) < 0.05


def test_an_arm_does_not_turn_round_for_a_target_next_to_it(roadmap):
    paths = draw_paths(roadmap, "line_random", 100, seed=0)
    start = starts(roadmap, paths[:, 0])
    targets = paths.transpose(0, 1)
    q, status = follow_targets(Teleoperator(roadmap, start=start, max_step=0.04), targets)
    tools = roadmap.robot.forward_kinematics(torch.cat([start[None], q]))[0]
    turned = torch.from_numpy((status[1:] == "detouring") & (status[:-1] == "tracking"))
    near = (tools[1:-1] - targets[1:]).norm(dim=2) < 0.02
    assert not (turned & near).any()


def test_arms_come_to_rest_where_they_are_stretched(roadmap):
    """There projections end here and there within the tolerance; no arm goes to and fro."""
    generator = torch.Generator().manual_seed(2)
    points = 2.0 * torch.rand(20_000, 3, dtype=torch.float64, generator=generator) - 1.0
    guesses, codes = roadmap.solver.guess(points, certified=False)
    solved = roadmap.solver.solve_columns(points.T.contiguous())[0].T
    off = grr_torch.spaces.configuration.distance(guesses, solved, roadmap.robot.continuous)
    targets = points[(codes <= 1) & (off > 0.5)][:150]
    assert len(targets) == 150
    start = roadmap.configurations[roadmap.solver.nearest(targets)[1][:, 0]]
    q, _ = follow_targets(Teleoperator(roadmap, start=start, max_step=0.04), targets.expand(260, -1, -1))
    steps = q[-60:].diff(dim=0)
    turned = (steps[1:] * steps[:-1]).sum(2) < -1e-6
    assert int(turned.sum(0).max()) <= 2


def test_an_arm_that_has_come_to_where_it_holds_stays_there(planar_5):
    """Nearly straight, it once went to and fro between two configurations at one point."""
    roadmap = grr_torch.build(planar_5, "fixed-rotation")
    start = torch.tensor([[-0.09705290, 0.04768368, 0.18119053, 0.03674411, -0.16856542]], dtype=torch.float64)
    near = torch.tensor([[0.499760894, 0.014794328]], dtype=torch.float64)
    out = torch.tensor([[0.501085176, 0.014576236]], dtype=torch.float64)
    assert not bool(roadmap.solve(out).valid)
    q, _ = follow_targets(Teleoperator(roadmap, max_step=0.05, start=start), torch.stack([near, *[out] * 200]))
    steps = q[-100:].diff(dim=0)
    assert not ((steps[1:] * steps[:-1]).sum(2) < -1e-6).any()


def _unreachable(roadmap, count, seed):
    """Points (count, 3) a little beyond the edge of reach, and configurations of arms that hold there."""
    vertices = some_vertices(roadmap, count, seed)
    points, q = roadmap.points[vertices], roadmap.configurations[vertices]
    return 1.5 * points / points.norm(dim=1, keepdim=True), q


@pytest.mark.parametrize("phase", [0, 1])
def test_input_that_is_refused_every_other_time_hides_no_target(roadmap, phase):
    """As from trackers at half the rate, in turn: arms hold out of reach, then their targets come back a little."""
    out, start = _unreachable(roadmap, 12, 11)
    teleoperator = Teleoperator(roadmap, start=start, max_step=0.1)
    arms = torch.arange(12)

    def follow(goals, steps):
        for step in range(steps):
            given = (arms + step) % 2 == phase
            command = teleoperator.step(torch.where(given[:, None], goals, torch.nan))
        return command

    follow(out, 120)
    held = torch.from_numpy(teleoperator._arms.held)
    assert bool(held.isfinite().all())
    # nearer to the held point than to any vertex
    goals = 0.97 * held
    solvable = roadmap.solve(goals).valid
    assert int(solvable.sum()) >= 6
    command = follow(goals, 40)
    apart = (roadmap.robot.forward_kinematics(command.configuration)[0] - goals).norm(dim=1)
    assert float(apart[solvable].max()) < 1e-3


def test_a_target_that_becomes_solvable_is_noticed_on_a_detour_too(roadmap):
    """Arms on the way to where they will hold, across the base, when each target comes back a little."""
    vertices = some_vertices(roadmap, 40, 13)
    start, points = roadmap.configurations[vertices], roadmap.points[vertices]
    out = points * torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)
    out = 1.3 * out / out.norm(dim=1, keepdim=True)
    teleoperator = Teleoperator(roadmap, start=start)
    for _ in range(13):
        command = teleoperator.step(out)
    arms = teleoperator._arms
    goals = 0.97 * torch.from_numpy(arms.held)
    changed = torch.from_numpy(command.status == "detouring") & roadmap.solve(goals).valid
    assert int(changed.sum()) >= 8
    for _ in range(6):
        teleoperator.step(goals)
    assert not arms.holds(changed.nonzero()[:, 0].numpy()).any()


def test_no_arm_stays_on_a_detour_that_leads_nowhere(roadmap):
    """Near the base's axis edges are connected that lead through long self-motions, and so cannot be followed."""
    target = torch.tensor([0.0, 0.05, 0.52], dtype=torch.float64)
    near = roadmap.resolved & ((roadmap.points - target).norm(dim=1) < 0.35)
    start = roadmap.configurations[near]
    assert len(start) > 20
    q, status = follow_targets(Teleoperator(roadmap, max_step=0.04, start=start), target.expand(260, len(start), 3))
    still = (q[-10:].diff(dim=0).abs().amax(dim=(0, 2)) < 1e-6).numpy()
    assert not (still & (status[-1] == "detouring")).any()
    away = (roadmap.robot.forward_kinematics(q[-1])[0] - target).norm(dim=1)
    assert float((away < 0.15).double().mean()) > 0.8


@pytest.mark.filterwarnings("error")
def test_targets_beyond_all_numbers_are_only_far_away(roadmap):
    start = roadmap.configurations[some_vertices(roadmap, 1)]
    teleoperator = Teleoperator(roadmap, start=start)
    for _ in range(5):
        command = teleoperator.step(torch.full((1, 3), 1e300, dtype=torch.float64))
    assert bool(command.configuration.isfinite().all())
    assert command.status[0] in ("unreachable", "detouring", "holding")
