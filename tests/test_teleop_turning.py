"""Teleoperation where rotation varies: its laws, turning, and ways round what cannot be followed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from teleoperated import follow_targets, some_vertices

import grr_torch
from grr_torch.applications.example_paths import example_path
from grr_torch.applications.replay import replay
from grr_torch.applications.steps import STATUSES
from grr_torch.applications.teleoperate import Teleoperator
from grr_torch.errors import ParameterError
from grr_torch.interactive.session import Session
from grr_torch.projection.project import project, tool_points
from grr_torch.spaces.task import Axis, FixedRotation, Pose, Position, Yaw

TASKS = [Position(2), Position(3), FixedRotation(3), Pose(2), Yaw(3), Yaw(3, (1.0, 0.0, 1.0)), Axis(3), Pose(3)]


@pytest.fixture(scope="module")
def planar_pose(planar_5) -> grr_torch.Roadmap:
    return grr_torch.build(planar_5, "pose", points=200)


@pytest.fixture(scope="module")
def yaw(kinova) -> grr_torch.Roadmap:
    return grr_torch.build(kinova, "yaw", points=600, rotations=8, refine=False)


@pytest.fixture(scope="module")
def axis(kinova) -> grr_torch.Roadmap:
    return grr_torch.build(kinova, "axis", points=200, rotations=16, refine=False)


@pytest.fixture(params=["planar_pose", "yaw", "axis"])
def roadmap(request) -> grr_torch.Roadmap:
    return request.getfixturevalue(request.param)


def _points(task, count, generator):
    """Random points of a task space, whose rotations have some length."""
    return task.unit(torch.randn(count, task.width, dtype=torch.float64, generator=generator))


def _gaps(roadmap, q, targets):
    """How far the tools of configurations (*batch, n) are from targets (*batch, width)."""
    tools = tool_points(roadmap.robot, roadmap.task, q.reshape(-1, roadmap.robot.n))
    return roadmap.task.gap_of_few(tools.numpy(), targets.expand(*q.shape[:-1], -1).reshape(len(tools), -1).numpy())


@pytest.mark.parametrize("task", TASKS, ids=lambda task: f"{task.kind} in {task.name}")
def test_gaps_add_a_turn_to_a_way(task, generator):
    """0.3 m for a radian; as much there as back, and halfway half as much."""
    first, second = (_points(task, 40, generator) for _ in range(2))
    d = task.dimension
    turned = torch.cat([first[:, :d], second[:, d:]], dim=1)
    gap = task.gap_of_few(first.numpy(), second.numpy())
    way = (first - second)[:, :d].norm(dim=1).numpy()
    turn = task.gap_of_few(first.numpy(), turned.numpy())
    assert gap == pytest.approx(np.hypot(way, turn), abs=1e-7)
    assert gap == pytest.approx(task.gap_of_few(second.numpy(), first.numpy()), abs=1e-7)
    middle = task.interpolate_few(first.numpy(), second.numpy(), 0.5)
    assert task.gap_of_few(first.numpy(), middle) == pytest.approx(0.5 * gap, abs=1e-6)
    if (rotations := task.matrices(first.T)) is not None and task.rotations is not None:
        error = task.error(turned.T, first[:, :3].T if d == 3 else first[:, :2].T, rotations)
        assert turn == pytest.approx(0.3 * task.residuals(error)[1].numpy(), abs=1e-6)


@pytest.mark.parametrize("seed", [0, 1])
def test_no_step_is_too_long_or_through_a_collision_whatever_the_targets(roadmap, seed):
    robot, task = roadmap.robot, roadmap.task
    generator = torch.Generator().manual_seed(seed)
    start = roadmap.configurations[some_vertices(roadmap, 6, seed)]
    leaps = roadmap.positions.abs().max() * _points(task, 36, generator).reshape(6, 6, -1)
    targets = leaps.repeat_interleave(15, dim=0) + 0.02 * torch.randn(90, 6, task.width, generator=generator)
    teleoperator = Teleoperator(roadmap, start=start, max_step=0.05)
    q, status = follow_targets(teleoperator, targets)
    q = torch.cat([start[None], q])
    assert bool((q.diff(dim=0).abs() <= 0.05).all())
    fractions = torch.arange(1, 9, dtype=q.dtype).reshape(-1, 1, 1) / 8.0
    assert not bool(robot.in_self_collision(q[:-1, None] + fractions * q.diff(dim=0)[:, None]).any())
    assert bool(robot.within_limits(q).all())
    assert set(np.unique(status)) <= set(STATUSES)


@pytest.mark.parametrize("name", ["planar_pose", "yaw"])
def test_a_vertex_is_reached_from_any_other(request, name):
    roadmap = request.getfixturevalue(name)
    vertices = some_vertices(roadmap, 24, 3)
    start, goals = roadmap.configurations[vertices[:12]], roadmap.points[vertices[12:]]
    q, status = follow_targets(Teleoperator(roadmap, start=start, max_step=0.1), goals.expand(250, -1, -1))
    assert float(_gaps(roadmap, q[-1], goals).max()) < 1e-3
    assert (status[-1] == "tracking").all()


def test_arms_meet_targets_that_cross_the_base_with_a_turned_tool(yaw):
    """They are less far behind than arms that head for where their targets are."""
    generator = torch.Generator().manual_seed(0)
    angle, height, turn = torch.rand(3, 30, 1, dtype=torch.float64, generator=generator)
    across = torch.cat([(2.0 * math.pi * angle).cos(), (2.0 * math.pi * angle).sin()], dim=1)
    way = torch.linspace(0.5, -0.5, 200, dtype=torch.float64)[:, None, None] * across
    rest = torch.cat([0.1 + 0.3 * height, 2.0 * math.pi * turn], dim=1)
    targets = torch.cat([way, rest.expand(200, -1, -1)], dim=2)
    targets = targets[:, yaw.solve(targets[[0, -1]]).valid.all(0)]
    assert targets.shape[1] >= 20
    behind = []
    for foresight in (2.0, 0.0):
        arms = Teleoperator(yaw, start=yaw.solve(targets[0]).configurations, max_step=0.04, foresight=foresight)
        behind.append(_gaps(yaw, follow_targets(arms, targets)[0], targets).reshape(200, -1))
    assert behind[0].mean() < 0.85 * behind[1].mean()
    assert behind[0][-1].mean() < 0.5 * behind[1][-1].mean()


def test_arms_meet_targets_that_turn_while_they_cross_the_base(yaw):
    """Where they meet, they are turned as the targets are, and not as these were when they set off."""
    vertices = some_vertices(yaw, 60, 4)
    start = yaw.points[vertices]
    end = start * start.new_tensor([-1.0, -1.0, -1.0, 1.0])
    inside = yaw.solve(end).valid
    share = torch.linspace(0.0, 1.0, 200, dtype=torch.float64)[:, None, None]
    targets = start[inside] + share * (end - start)[inside]
    targets[..., 3] += 1.2 * ((share[..., 0] - 0.4) / 0.4).clamp(0.0, 1.0)
    teleoperator = Teleoperator(yaw, start=yaw.configurations[vertices][inside], max_step=0.04)
    across = 0
    for target in targets:
        teleoperator.step(target)
        meeting = teleoperator._arms.meeting
        rows = meeting.across & meeting.planned(np.arange(target.shape[0]))
        across += int(rows.sum())
        assert np.abs(np.sin(0.5 * (meeting.place[rows, 3] - target.numpy()[rows, 3]))).max(initial=0.0) < 1e-9
    assert across > 100


@pytest.mark.parametrize("name", ["planar_pose", "yaw"])
def test_a_tool_turned_once_round_is_back_where_it_was(request, name):
    """On the spot, where all rotations are resolved; its joints end where they began."""
    roadmap = request.getfixturevalue(name)
    size = len(roadmap.graph.positions.points)
    everywhere = roadmap.resolved.reshape(-1, size).all(0)
    place = roadmap.positions[:size][everywhere]
    place = place[place.norm(dim=1).argsort()][len(place) // 2]
    turns = torch.linspace(0.0, 2.0 * math.pi, 400, dtype=torch.float64)[:, None]
    targets = torch.cat([place.expand(400, -1), turns], dim=1)
    q, status = follow_targets(Teleoperator(roadmap, max_step=0.2), targets)
    assert (status == "tracking").mean() > 0.95
    assert float(_gaps(roadmap, q[-1], targets[-1]).max()) < 1e-3
    ends = grr_torch.spaces.configuration.distance(q[0], q[-1], roadmap.robot.continuous)
    assert float(ends) < 1e-3


def test_a_whole_turn_more_is_the_same_target(yaw):
    vertex = some_vertices(yaw, 1)[0]
    first, second = (Teleoperator(yaw, start=yaw.configurations[vertex]) for _ in range(2))
    goal = yaw.points[some_vertices(yaw, 2)[1]]
    more = goal + torch.tensor([0.0, 0.0, 0.0, 2.0 * math.pi], dtype=torch.float64)
    for _ in range(20):
        assert torch.allclose(first.step(goal).configuration, second.step(more).configuration, atol=1e-9)


def test_a_direction_without_length_is_refused_and_one_of_any_length_is_not(axis):
    vertex = some_vertices(axis, 1)[0]
    q, point = axis.configurations[vertex], axis.points[vertex]
    teleoperator = Teleoperator(axis, start=q)
    longer = torch.cat([point[:3], 5.0 * point[3:]])
    assert str(teleoperator.step(longer).status) == "tracking"
    for wrong in (torch.cat([point[:3], torch.zeros(3)]), torch.cat([point[:3], torch.full((3,), torch.nan)])):
        command = teleoperator.step(wrong)
        assert str(command.status) == "holding"
        assert float((command.configuration - q).abs().max()) < 1e-3
    with pytest.raises(ParameterError, match="first target"):
        Teleoperator(axis).step(torch.zeros(6))


def test_a_leap_in_rotation_is_refused_as_one_in_position_is(yaw):
    vertex = some_vertices(yaw, 1)[0]
    teleoperator = Teleoperator(yaw, start=yaw.configurations[vertex], max_jump=0.1)
    point = yaw.points[vertex]
    assert str(teleoperator.step(point).status) == "tracking"
    for turn, status in ((0.3, "tracking"), (1.0, "holding")):
        target = point + torch.tensor([0.0, 0.0, 0.0, turn], dtype=torch.float64)
        assert str(teleoperator.step(target).status) == status


def test_an_unreachable_rotation_is_approached(planar_pose):
    """Near full reach a planar hand cannot point inwards: the arm goes as near to it as it can and says so."""
    reach = planar_pose.positions[planar_pose.resolved].norm(dim=1)
    vertex = planar_pose.resolved.nonzero()[reach.argmax(), 0]
    point = planar_pose.points[vertex]
    target = point + torch.tensor([0.0, 0.0, math.pi], dtype=torch.float64)
    teleoperator = Teleoperator(planar_pose, start=planar_pose.configurations[vertex], max_step=0.1)
    q, status = follow_targets(teleoperator, target.expand(200, -1))
    gaps = _gaps(planar_pose, q, target)
    assert status[-1] == "unreachable"
    assert gaps[-1] < 0.9 * gaps[0]
    assert gaps[-1] < gaps.min() + 1e-2


def test_arms_go_round_what_cannot_be_followed(planar_pose):
    """A fifth of the vertices have unrelated configurations, their edges counted as connected all the same.

    Where the straight way along such an edge comes to nothing, steps become shorter and shorter: another route is
    taken.
    """
    generator = torch.Generator().manual_seed(6)
    robot, vertices = planar_pose.robot, planar_pose.resolved.nonzero()[:, 0]
    chosen = vertices[torch.randperm(len(vertices), generator=generator)[: len(vertices) // 5]]
    random = robot.sample(len(chosen), generator)
    unrelated, valid = project(robot, planar_pose.task, planar_pose.points[chosen], random)
    configurations, good = planar_pose.configurations.clone(), planar_pose.resolved.clone()
    configurations[chosen[valid]] = unrelated[valid]
    good[chosen] = False
    spoilt = replace(planar_pose, configurations=configurations)
    generator = torch.Generator().manual_seed(1)
    start, end = (good.nonzero()[torch.randint(int(good.sum()), (40,), generator=generator), 0] for _ in range(2))
    goals = spoilt.points[end]
    fractions = torch.linspace(0.0, 1.0, 100, dtype=torch.float64)[:, None, None]
    way = spoilt.task.interpolate(spoilt.points[start], goals, fractions)
    targets = torch.cat([way, goals.expand(1000, -1, -1)])
    q, _ = follow_targets(Teleoperator(spoilt, max_step=0.1), targets)
    assert (_gaps(spoilt, q[-1], goals) < 1e-3).all()


@pytest.mark.parametrize("name", ["planar_pose", "yaw"])
def test_a_replay_tells_how_far_the_tool_was_turned(request, name):
    roadmap = request.getfixturevalue(name)
    path = example_path(roadmap, "circle")
    assert path.shape[1] == roadmap.task.width
    log = replay(Teleoperator(roadmap), path)
    summary = log.summary()
    assert summary.final_deviation < 2e-3
    assert summary.final_turn < 1e-2
    target, q = log.targets[-1], log.configurations[-1]
    position, rotation = roadmap.robot.forward_kinematics(q[None])
    error = roadmap.task.error(target[:, None], position.T, rotation.permute(1, 2, 0))
    assert float(log.turns[-1]) == pytest.approx(float(roadmap.task.residuals(error)[1]), abs=1e-9)
    with pytest.raises(ParameterError, match="waypoints"):
        replay(Teleoperator(roadmap), path[:, :-1])


def test_a_session_turns_its_arm(yaw):
    session = Session(Teleoperator(yaw))
    assert session.tick().status == "tracking"
    session.nudge(3, 0.2)
    assert session.target[3] == pytest.approx(float(session.home[3]) + 0.2)
    for _ in range(60):
        step = session.tick()
    assert session.residuals(step) == (pytest.approx(0.0, abs=1e-3), pytest.approx(0.0, abs=1e-2))
    with pytest.raises(ParameterError, match="x, y, z, yaw"):
        session.move([0.1, 0.2, 0.3])


@pytest.mark.parametrize("name", ["planar_pose", "yaw", "axis"])
def test_the_handle_of_a_page_is_where_the_target_is(request, name):
    pytest.importorskip("viser", reason="viser is not installed")
    from grr_torch.interactive.page import Page

    roadmap = request.getfixturevalue(name)
    session = Session(Teleoperator(roadmap))
    page = Page(session, port=0)
    try:
        page.show(session.tick())
        assert len(page._sliders) == {"planar_pose": 3, "yaw": 4, "axis": 3}[name]
        assert not page._handle.controls.disable_rotations
        here = np.array(session.target)
        assert roadmap.task.gap_of_few(np.array(page._handle.point()), here) < 1e-6
        moved = roadmap.points[some_vertices(roadmap, 1, 4)[0]]
        session.move(moved.tolist())
        page._show_target()
        assert roadmap.task.gap_of_few(np.array(page._handle.point()), moved.numpy()) < 1e-6
        assert "turned" in page._status(session.tick(), 0.0)
    finally:
        page.close()
