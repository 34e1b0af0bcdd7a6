"""Swings: joints go straight to a configuration, and the tool stays turned as the task asks."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from public_arms import PANDA, arm_urdf
from teleoperated import follow_targets, some_vertices

import grr_torch
from grr_torch import Teleoperator
from grr_torch.applications.lines import Follower, Lines
from grr_torch.applications.motions import SUBSTEPS
from grr_torch.projection.project import DEFAULT_TOLERANCES

STEP = 0.04
PAIRS = 60


@pytest.fixture(scope="module", params=["kinova_roadmap", "planar_roadmap"])
def roadmap(request) -> grr_torch.Roadmap:
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="module")
def follower(roadmap) -> Follower:
    longest = torch.full((roadmap.robot.n,), STEP, dtype=torch.float64)
    return Follower(roadmap.robot, roadmap.task, DEFAULT_TOLERANCES, longest)


@pytest.fixture(scope="module")
def pairs(roadmap) -> tuple[torch.Tensor, torch.Tensor]:
    """Vertices (PAIRS,) from where, and to where."""
    return some_vertices(roadmap, PAIRS, 1), some_vertices(roadmap, PAIRS, 2)


def _swing(roadmap, follower, q, p, goals, bounds=None, wholly=True) -> Lines:
    return follower.swing(q, p, goals, roadmap.solver.bounds if bounds is None else bounds, wholly=wholly)


def _at(roadmap, vertices):
    return roadmap.configurations[vertices].numpy().copy(), roadmap.points[vertices].numpy().copy()


def test_a_free_swing_arrives_in_time_on_its_task_and_never_collides(roadmap, follower, pairs):
    (q, p), (goals, _) = (_at(roadmap, vertices) for vertices in pairs)
    free = _swing(roadmap, follower, q, p, goals).direct
    assert free.mean() > 0.3
    q, p, goals = q[free], p[free], goals[free]
    lengths = np.abs(follower.difference(q, goals)).max(1) / STEP
    arrived = np.full(len(q), np.inf)
    fractions = torch.arange(1, SUBSTEPS + 1, dtype=torch.float64)[:, None, None] / SUBSTEPS
    for step in range(1, 200):
        lines = _swing(roadmap, follower, q, p, goals, wholly=False)
        assert lines.safe.all()
        assert not lines.direct.any(), "it is not looked at to its end"
        motion = torch.from_numpy(lines.steps - q)
        assert float(motion.abs().max()) <= STEP
        assert not bool(roadmap.robot.in_self_collision(torch.from_numpy(q) + fractions * motion).any())
        q = lines.steps
        position, rotation = roadmap.robot.forward_kinematics(torch.from_numpy(q))
        points = roadmap.task.at(position.T, rotation.permute(1, 2, 0))
        error = roadmap.task.residuals(roadmap.task.error(points, position.T, rotation.permute(1, 2, 0)))[1]
        assert float(error.max()) <= DEFAULT_TOLERANCES.rotation
        arrived = np.minimum(arrived, np.where(follower.distance(q, goals) < 1e-6, step, np.inf))
    # a little less than the longest step is asked for, and what the projection adds is cut off
    assert (arrived <= 1.1 * lengths + 3.0).all()


@pytest.mark.parametrize("roadmap", ["kinova_roadmap"], indirect=True)
def test_a_swing_that_jumps_or_collides_is_not_free(roadmap, follower, generator):
    """Between any postures, looked at in eight times as many places."""
    robot, task = roadmap.robot, roadmap.task
    points = roadmap.points[some_vertices(roadmap, 200)]
    q, valid = grr_torch.project(robot, task, points, robot.sample(200, generator))
    half = int(valid.sum()) // 2
    (q, goals), p = (part.numpy().copy() for part in q[valid][: 2 * half].split(half)), points[valid][:half].numpy()
    free = _swing(roadmap, follower, q, p, goals).direct
    motion = follower.difference(q, goals)
    count = int(8 * math.ceil(2.0 * np.linalg.norm(motion, axis=1).max() / follower.epsilon))
    along = torch.from_numpy(q + np.linspace(0.0, 1.0, count)[:, None, None] * motion).reshape(-1, robot.n)
    position, rotation = robot.forward_kinematics(along)
    tools = task.at(position.T, rotation.permute(1, 2, 0)).T
    low, high = (torch.from_numpy(bound) for bound in roadmap.solver.bounds)
    placed, valid = grr_torch.project(robot, task, tools, along)
    valid &= ((tools >= low) & (tools <= high)).all(1)
    placed, blocked = placed.reshape(count, half, -1).numpy(), ~valid.reshape(count, half).numpy()
    jumps = (follower.distance(placed[:-1], placed[1:]) > follower.epsilon).any(0)
    # between two places that a swing is looked at, a corner of a link may touch
    assert not (free & ((blocked[:-10] & blocked[10:]).any(0) | jumps)).any()
    assert 0 < free.sum() < half
    assert (free | blocked.any(0) | jumps).mean() > 0.95


def test_a_swing_does_not_leave_the_bounds(roadmap, follower, pairs):
    (q, p), (goals, ends) = (_at(roadmap, vertices) for vertices in pairs)
    free = _swing(roadmap, follower, q, p, goals).direct
    fractions = np.linspace(0.0, 1.0, 50)[:, None, None]
    along = torch.from_numpy(q + fractions * follower.difference(q, goals))
    tools = roadmap.robot.forward_kinematics(along)[0][..., : p.shape[1]].numpy()
    for axis in range(p.shape[1]):
        # between the higher of the ends and the highest point on the way
        limit = 0.5 * (np.maximum(p, ends)[:, axis] + tools[..., axis].max(0))
        rises = free & (tools[..., axis].max(0) > np.maximum(p, ends)[:, axis] + 0.02)
        assert rises.any()
        for row in rises.nonzero()[0]:
            bound = np.full(p.shape[1], np.inf)
            one = slice(row, row + 1)
            assert _swing(roadmap, follower, q[one], p[one], goals[one], (-bound, bound)).direct.all()
            beyond = bound.copy()
            beyond[axis] = limit[row]
            assert not _swing(roadmap, follower, q[one], p[one], goals[one], (-bound, beyond)).direct.any()


def test_a_goal_that_is_not_known_is_not_swung_to(roadmap, follower, pairs):
    q, p = _at(roadmap, pairs[0])
    for wholly in (True, False):
        lines = _swing(roadmap, follower, q, p, np.full_like(q, np.nan), wholly=wholly)
        assert not (lines.direct | lines.safe).any()


@pytest.mark.parametrize("height", [-0.46, -0.42, -0.38])
def test_an_arm_turns_on_the_spot_for_a_line_past_its_own_axis(kinova_roadmap, height):
    """Half a turn of the base within a centimetre: no way round over vertices that are 15 cm away."""
    x = torch.linspace(-0.3, 0.3, 200, dtype=torch.float64)
    angles = torch.arange(6, dtype=torch.float64)
    cos, sin, beside = angles.cos(), angles.sin(), 0.005
    line = torch.stack(
        [x[:, None] * cos - beside * sin, x[:, None] * sin + beside * cos, torch.full((200, 6), height)], dim=2
    )
    assert bool(kinova_roadmap.solve(line).valid.all())
    arms = Teleoperator(kinova_roadmap, max_step=STEP)
    q, status = follow_targets(arms, torch.cat([line, line[-1:].expand(80, -1, -1)]))
    tools = kinova_roadmap.robot.forward_kinematics(q)[0]
    away = torch.cdist(tools.transpose(0, 1), line.transpose(0, 1)).amin(2)
    assert float(away.max()) < 0.08
    assert (status == "detouring").any(0).all()
    assert float((tools[-1] - line[-1]).norm(dim=1).max()) < 1e-3


def test_a_swing_that_has_arrived_is_over(kinova_roadmap):
    """The arm does not stand at its end for a goal next to it."""
    arms = Teleoperator(kinova_roadmap, start=kinova_roadmap.configurations[some_vertices(kinova_roadmap, 1)])
    detours, state, which = arms._pilot.detours, arms._arms, np.arange(1)
    for start in (state.q, state.q + 0.01):
        state.detour.swing[0] = start[0]
        goal = start + 0.04
        steps, _, free = detours.swing(state, which, goal)
        moved = np.abs(steps - state.q).max()
        assert not free[0] or moved > 1e-3


def test_a_swing_that_leads_no_nearer_is_over_until_the_goal_is_another(kinova_roadmap, monkeypatch):
    """Where the tool has to be turned on the way, the arm may be led off for ever."""
    vertex, other, third = some_vertices(kinova_roadmap, 3)
    arms = Teleoperator(kinova_roadmap, start=kinova_roadmap.configurations[vertex][None])
    detours, state, which = arms._pilot.detours, arms._arms, np.arange(1)
    goal, goal_q = (part[other][None].numpy() for part in (kinova_roadmap.points, kinova_roadmap.configurations))
    swing = Follower.swing

    def astray(follower, q, p, ends, bounds, *, wholly):
        lines = swing(follower, q, p, ends, bounds, wholly=wholly)
        steps = q - 0.01 * np.sign(follower.difference(q, ends)) if not wholly else lines.steps
        free = np.ones_like(lines.direct)
        return replace(lines, steps=steps, safe=free, direct=free)

    monkeypatch.setattr(Follower, "swing", astray)

    def free() -> bool:
        return bool(detours.swing(state, which, goal_q)[2][0])

    detours.set_goals(state, which, goal)
    assert [free() for _ in range(4)] == [True, False, False, False]
    detours.set_goals(state, which, goal)
    assert not free()
    detours.set_goals(state, which, kinova_roadmap.points[third][None].numpy())
    assert free()


@pytest.fixture(scope="module")
def crowded(tmp_path_factory) -> grr_torch.Roadmap:
    """Of an arm whose joint limits refuse many swings."""
    path = tmp_path_factory.mktemp("arm") / "panda.urdf"
    path.write_text(arm_urdf(*PANDA))
    down = grr_torch.FixedRotation(dimension=3, rpy=(math.pi, 0.0, 0.0))
    bounds = [(-0.7, 0.7), (-0.7, 0.7), (0.1, 0.6)]
    return grr_torch.build(grr_torch.load_robot(path), down, points=1500, bounds=bounds, refine=False)


@pytest.mark.parametrize(("rate", "period"), [(10.0, 5.0), (10.0, 4.0), (50.0, 1.2)])
def test_an_arm_does_not_stay_where_a_swing_ended_however_its_target_leaps(kinova_roadmap, rate, period):
    """The target goes round a figure eight, by more than 3 cm from one step to the next."""
    turns = torch.arange(int(20.0 * rate), dtype=torch.float64) / rate * 2.0 * math.pi / period
    targets = torch.stack([0.5 * turns.sin(), 0.35 * (2.0 * turns).sin(), torch.full_like(turns, 0.1)], dim=1)
    assert float(targets.diff(dim=0).norm(dim=1).max()) > 0.03
    q, _ = follow_targets(Teleoperator(kinova_roadmap, rate), targets)
    moves = (q.diff(dim=0).abs().amax(1) > 1e-6).tolist()
    assert max(map(len, "".join(" " if move else "x" for move in moves).split()), default=0) < rate


def test_arms_whose_swings_are_refused_keep_to_their_routes(crowded, monkeypatch):
    """They neither stand still for ever nor go to and fro."""
    refused = []
    swing = Follower.swing

    def watched(*arguments, **options):
        lines = swing(*arguments, **options)
        refused.append(~lines.direct if options["wholly"] else ~lines.safe)
        return lines

    monkeypatch.setattr(Follower, "swing", watched)
    generator = torch.Generator().manual_seed(2)
    vertices = some_vertices(crowded, 30)
    arms = Teleoperator(crowded, start=crowded.configurations[vertices], max_step=STEP)
    for _ in range(3):
        goals = crowded.points[vertices[torch.randperm(30, generator=generator)]]
        q, status = follow_targets(arms, goals.expand(150, -1, -1))
        away = (crowded.robot.forward_kinematics(q)[0] - goals).norm(dim=2)
        still = torch.from_numpy(np.isin(status, ["detouring", "holding"]))[1:] & (away[1:] > 0.01)
        still &= q.diff(dim=0).abs().amax(2) < 1e-6
        assert not bool(still.unfold(0, 10, 1).all(2).any())
        motion = q.diff(dim=0)
        assert int(((motion[1:] * motion[:-1]).sum(2) < -1e-4).sum(0).max()) <= 30
        assert float((away[-1] > 0.01).double().mean()) < 0.1
    assert np.concatenate(refused).mean() > 0.1
