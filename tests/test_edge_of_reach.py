"""Teleoperation where targets cannot be reached, or hardly."""

from __future__ import annotations

import math

import numpy as np
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
    # to go there at once and to wait for the next would be more than 1
    assert float(changes.mean()) < 0.6 * float(lengths.mean())


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


@pytest.fixture(scope="module")
def stretched(roadmap):
    """Points (150, 3) where the map's configurations are far from their guesses, arms near full stretch."""
    generator = torch.Generator().manual_seed(2)
    points = 2.0 * torch.rand(20_000, 3, dtype=torch.float64, generator=generator) - 1.0
    guesses, codes = roadmap.solver.guess(points, certified=False)
    solved = roadmap.solver.solve_columns(points.T.contiguous())[0].T
    off = grr_torch.spaces.configuration.distance(guesses, solved, roadmap.robot.continuous)
    found = points[(codes <= 1) & (off > 0.5)][:150]
    assert len(found) == 150
    return found


def _beside(roadmap, points):
    """Arms at the vertices nearest to points."""
    start = roadmap.configurations[roadmap.solver.nearest(points)[1][:, 0]]
    return Teleoperator(roadmap, start=start, max_step=0.04)


def test_arms_come_to_rest_where_they_are_stretched(roadmap, stretched):
    """There projections end here and there within the tolerance; no arm goes to and fro."""
    q, _ = follow_targets(_beside(roadmap, stretched), stretched.expand(260, -1, -1))
    steps = q[-60:].diff(dim=0)
    turned = (steps[1:] * steps[:-1]).sum(2) < -1e-6
    assert int(turned.sum(0).max()) <= 2


@pytest.mark.parametrize("lost_before", [0, 100])
def test_what_was_expected_of_another_target_is_forgotten(roadmap, stretched, lost_before):
    """Stretched arms whose targets leap back, at once or after they were out of reach, go there as any arm would."""
    teleoperator = _beside(roadmap, stretched)
    follow_targets(teleoperator, stretched.expand(200, -1, -1))
    out = 1.6 * stretched / stretched.norm(dim=1, keepdim=True)
    for _ in range(lost_before):
        teleoperator.step(out)
    fresh = Teleoperator(roadmap, start=teleoperator.configuration, max_step=0.04)
    command, expected = (arms.step(0.85 * stretched) for arms in (teleoperator, fresh))
    assert (command.status == expected.status).all()
    assert float((command.configuration - expected.configuration).abs().max()) < 2e-3


def test_arms_that_are_pulled_out_of_reach_straighten_evenly_and_rest(roadmap, stretched):
    """Their targets go slowly through where they are stretched to beyond, and stay there."""
    share = torch.linspace(0.9, 1.1, 150, dtype=torch.float64)[:, None, None]
    targets = torch.cat([share * stretched, (1.1 * stretched).expand(110, -1, -1)])
    q, status = follow_targets(_beside(roadmap, targets[0]), targets)
    assert (status[-60:] == "unreachable").mean() > 0.95
    steps = q.diff(dim=0)
    turned = (steps[1:] * steps[:-1]).sum(2) < -1e-6
    assert float(turned.double().sum(0).mean()) < 0.7
    assert float(steps.diff(dim=0).norm(dim=2).flatten().quantile(0.99)) < 0.016
    assert float(steps[-60:].abs().max()) < 1e-3


def test_many_arms_of_single_precision_hold_too():
    robot = grr_torch.load_robot("planar_5", dtype=torch.float32)
    roadmap = grr_torch.build(robot, "position", points=300)
    points, start = _unreachable(roadmap, 100, 3)
    q, status = follow_targets(Teleoperator(roadmap, start=start, max_step=0.1), points.expand(80, -1, -1))
    assert q.dtype == torch.float32
    assert (status[-10:] == "unreachable").all()
    assert float(q[-10:].diff(dim=0).abs().max()) < 1e-3


def test_arms_in_contact_do_not_wait_before_they_leave_it(roadmap):
    """Others do, where a target next to the tool is reached by a detour only."""
    q = roadmap.robot.sample(20_000, torch.Generator().manual_seed(3))
    points = roadmap.robot.forward_kinematics(q)[0]
    start, _ = grr_torch.project(roadmap.robot, roadmap.task, points, q, check_collision=False)
    solvable = roadmap.solve(points).valid & start.isfinite().all(1)
    touching = solvable & roadmap.robot.in_self_collision(start.nan_to_num())
    start, points = start[touching][:60], points[touching][:60]
    assert len(start) > 20
    teleoperator = Teleoperator(roadmap, start=start, max_step=0.04)
    waiting = torch.from_numpy(teleoperator.step(points).status == "holding")
    for _ in range(3):
        status = teleoperator.step(points).status
    # who holds has found no way on, and still has none
    assert (status[waiting.numpy()] == "holding").all()


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
    held = torch.from_numpy(teleoperator._arms.hold.point)
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
    goals = 0.97 * torch.from_numpy(arms.hold.point)
    changed = torch.from_numpy(command.status == "detouring") & roadmap.solve(goals).valid
    assert int(changed.sum()) >= 8
    for _ in range(6):
        teleoperator.step(goals)
    assert not arms.hold.known(changed.nonzero()[:, 0].numpy()).any()


def test_arms_do_not_go_to_and_fro_beside_a_hole(roadmap):
    """While targets go slowly past the base, joints seldom turn round from one step to the next, or tools set off."""
    generator = torch.Generator().manual_seed(0)
    angle, beside, height = torch.rand(3, 24, dtype=torch.float64, generator=generator)
    angle, beside, height = 2.0 * math.pi * angle, 0.3 * beside - 0.15, 0.6 * height - 0.1
    along = torch.linspace(-0.2, 0.2, 1000, dtype=torch.float64)[:, None]
    across = (along * angle.cos() - beside * angle.sin(), along * angle.sin() + beside * angle.cos())
    q, status = follow_targets(Teleoperator(roadmap), torch.stack([*across, height.expand(1000, -1)], dim=2))
    speed = q.diff(dim=0) / (roadmap.robot.velocity_limits / 50.0)
    turned = (speed[1:] * speed[:-1] < 0.0) & (speed[1:].abs() > 0.2) & (speed[:-1].abs() > 0.2)
    assert (status == "unreachable").mean() > 0.3
    assert float(turned.any(2).double().sum(0).mean()) < 2.0
    away = torch.from_numpy(status == "detouring")
    assert float((away[1:] & ~away[:-1]).double().sum(0).mean()) < 1.0


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


def test_who_has_no_way_to_where_it_was_to_hold_holds_elsewhere(roadmap):
    """An arm at the end of a route, from which no line leads on, does not try the same way for ever."""
    vertex = some_vertices(roadmap, 1, 3)
    point, q = roadmap.points[vertex].numpy(), roadmap.configurations[vertex].numpy()
    teleoperator = Teleoperator(roadmap, start=roadmap.configurations[vertex])
    arms, detours = teleoperator._arms, teleoperator._pilot.detours
    arms.hold.point[:], arms.hold.q[:], arms.detour.last_goal[:] = point + 0.1, q + 0.5, point + 0.1
    arms.detour.last_vertex[:] = arms.detour.next_vertex[:] = int(vertex)
    target = point + 0.3
    assert detours.give_up_ended(arms, np.array([0]), q, target).all()
    assert not arms.hold.known(np.array([0])).any()
    # and not even a jump leads there again
    assert (arms.hold.barred == target).all()
