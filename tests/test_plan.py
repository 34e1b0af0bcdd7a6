"""Path planning: what every path must satisfy, on the plane and with the Kinova, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import minimum_spanning_tree

import grr_torch
from grr_torch.applications.plan import Planner
from grr_torch.applications.retime import accelerations
from grr_torch.errors import ParameterError
from grr_torch.spaces.configuration import distance


@pytest.fixture(scope="module")
def kinova_roadmap(kinova):
    return grr_torch.build(kinova, "fixed-rotation", points=1500)


@pytest.fixture(scope="module", params=["planar_5", "kinova"])
def roadmap(request):
    return request.getfixturevalue({"planar_5": "planar_roadmap", "kinova": "kinova_roadmap"}[request.param])


def solved_points(roadmap, count, seed, spread=0.02):
    """Points near resolved vertices of the largest connected part, which the map solves."""
    generator = torch.Generator().manual_seed(seed)
    part = roadmap.routes.part[roadmap.solver.vertices]
    vertices = roadmap.solver.vertices[torch.from_numpy(part == torch.from_numpy(part).mode().values.item())]
    chosen = vertices[torch.randint(len(vertices), (8 * count,), generator=generator)]
    noise = torch.randn(8 * count, roadmap.task.width, generator=generator, dtype=torch.float64)
    points = roadmap.points[chosen] + spread * noise
    return points[roadmap.solve(points).valid][:count]


def between(q, pieces=16):
    fractions = torch.arange(pieces, dtype=q.dtype)[:, None, None] / pieces
    return (q[:-1] + fractions * (q[1:] - q[:-1])).flatten(0, 1)


def assert_is_a_path(roadmap, path, step=0.05, velocity=None):
    robot, d = roadmap.robot, roadmap.task.dimension
    q, times = path.configurations, path.times
    assert path.found
    assert len(q) == len(times) == len(path.points)
    assert times[0] == 0.0
    assert bool((times.diff() > 0.0).all())
    assert bool((q.diff(dim=0).norm(dim=1) < step).all())
    limits = robot.velocity_limits.clamp_max(1.0) if velocity is None else velocity
    assert bool(((q.diff(dim=0) / times.diff()[:, None]).abs() <= limits).all())
    assert not bool(robot.in_self_collision(between(q)).any())
    assert bool(robot.within_limits(q).all())
    position = robot.forward_kinematics(q)[0][:, :d]
    assert (position - path.points[:, :d]).norm(dim=1).max() <= 1.01e-4


@pytest.mark.parametrize("smooth", [False, True])
def test_a_path_is_continuous_timed_and_joins_its_ends(roadmap, smooth):
    points = solved_points(roadmap, 8, seed=1)
    for start, goal in zip(points[::2], points[1::2], strict=True):
        path = roadmap.plan(start, goal, smooth=smooth)
        assert_is_a_path(roadmap, path)
        torch.testing.assert_close(path.points[[0, -1]], torch.stack([start, goal]))
        turns = roadmap.robot.continuous
        ends = roadmap.solve(torch.stack([start, goal])).configurations
        assert distance(path.configurations[[0, -1]], ends, turns).max() < 1e-9
        assert 0.0 <= path.mean_deviation <= path.max_deviation < 0.002
        assert path.duration == path.times[-1]


def test_a_path_leads_along_connected_edges(roadmap):
    start, goal = solved_points(roadmap, 2, seed=2)
    path = roadmap.plan(start, goal)
    joined = {frozenset(edge) for edge in roadmap.edges[roadmap.connected].tolist()}
    steps = list(zip(path.vertices.tolist(), path.vertices.tolist()[1:], strict=False))
    assert steps
    assert {frozenset(pair) for pair in steps} <= joined
    # every waypoint lies on the straight lines start, vertices, goal
    corners = torch.cat([start[None], roadmap.points[path.vertices], goal[None]])
    line = corners.diff(dim=0)
    share = ((path.points[:, None] - corners[:-1]) * line).sum(2) / line.square().sum(1)
    apart = (path.points[:, None] - corners[:-1] - share.clamp(0.0, 1.0)[..., None] * line).norm(dim=2)
    assert apart.amin(1).max() < 1e-9


def test_between_vertices_no_route_is_shorter(roadmap):
    routes = roadmap.routes
    generator = torch.Generator().manual_seed(3)
    for _ in range(3):
        start, goal = solved_points(roadmap, 2, seed=int(torch.randint(1 << 30, (), generator=generator)), spread=0.0)
        path = roadmap.plan(start, goal)
        a, b = (int(roadmap.solver.nearest(end[None])[1]) for end in (start, goal))
        turns = roadmap.robot.continuous
        chosen = roadmap.configurations[path.vertices]
        assert distance(chosen[:-1], chosen[1:], turns).sum() <= routes.towards(b)[0][a] + 1e-9


def test_every_connected_edge_can_be_followed(roadmap):
    planner = Planner(roadmap)
    first, second = (planner._vertices(ends) for ends in roadmap.edges[roadmap.connected].T)
    missing = torch.tensor([way is None for way in planner.ways.on_lines(first, second)]).nonzero()[:, 0]
    # one in five hundred may graze the arm between the waypoints that the check of edges looked at
    assert len(missing) <= 2e-3 * len(first)
    again = Planner(replace(roadmap, robot=replace(roadmap.robot, margin=roadmap.robot.margin - 1e-3))).ways
    assert all(way is not None for way in again.on_lines(first.take(missing), second.take(missing)))


def test_where_the_averages_do_not_follow_the_edges_paths_do(roadmap):
    """Of a tree of edges alone, the map's averages are poor."""
    first, second = roadmap.edges.T
    lengths = distance(roadmap.configurations[first], roadmap.configurations[second], roadmap.robot.continuous)
    weights = np.where(roadmap.connected, lengths.numpy() + 1e-6, 0.0)
    size = len(roadmap.points)
    tree = minimum_spanning_tree(csr_matrix((weights, (first.numpy(), second.numpy())), shape=(size, size)))
    kept = {frozenset(pair) for pair in zip(*(index.tolist() for index in tree.nonzero()), strict=True)}
    inside = torch.tensor([frozenset(pair) in kept for pair in roadmap.edges.tolist()])
    thin = replace(roadmap, connected=roadmap.connected & inside)
    planner = Planner(thin)
    ends = [planner._vertices(vertices) for vertices in thin.edges[thin.connected].T]
    assert any(way is None for way in planner.ways.on_map(*ends))
    part = thin.routes.part
    generator = torch.Generator().manual_seed(17)
    vertices = thin.solver.vertices[torch.randint(len(thin.solver.vertices), (12,), generator=generator)]
    for a, b in vertices.reshape(-1, 2).tolist():
        if part[a] == part[b]:
            assert_is_a_path(thin, thin.plan(thin.points[a], thin.points[b]))


def test_the_deviation_is_that_of_the_tool_from_its_straight_lines(roadmap):
    start, goal = solved_points(roadmap, 2, seed=4)
    path = roadmap.plan(start, goal)
    d = roadmap.task.dimension
    corners = torch.cat([start[None], roadmap.points[path.vertices], goal[None]])[:, :d]
    position = roadmap.robot.forward_kinematics(between(path.configurations, 8))[0][:, :d]
    line = corners.diff(dim=0)
    share = ((position[:, None] - corners[:-1]) * line).sum(2) / line.square().sum(1)
    apart = (position[:, None] - corners[:-1] - share.clamp(0.0, 1.0)[..., None] * line).norm(dim=2).amin(1)
    # at a corner, the line after it may be nearer by part of a projection's tolerance
    assert path.max_deviation == pytest.approx(apart.max().item(), rel=0.05, abs=2e-5)
    assert path.mean_deviation == pytest.approx(apart.mean().item(), rel=0.02)
    coarse = roadmap.plan(start, goal, step=0.1)
    assert_is_a_path(roadmap, coarse, step=0.1)
    assert len(coarse.times) < len(path.times)


def test_there_is_a_path_back_and_it_is_as_long(roadmap):
    points = solved_points(roadmap, 6, seed=5)
    for start, goal in zip(points[::2], points[1::2], strict=True):
        there, back = roadmap.plan(start, goal), roadmap.plan(goal, start)
        assert there.found == back.found
        assert there.joint_length == pytest.approx(back.joint_length, rel=1e-3)


def test_a_smoothed_path_is_not_longer_and_mostly_shorter(roadmap):
    points = solved_points(roadmap, 10, seed=6)
    shorter = 0
    for start, goal in zip(points[::2], points[1::2], strict=True):
        plain, smooth = roadmap.plan(start, goal), roadmap.plan(start, goal, smooth=True)
        assert smooth.joint_length <= plain.joint_length + 1e-9
        assert smooth.task_length <= plain.task_length + 1e-9
        shorter += smooth.joint_length < 0.99 * plain.joint_length
    assert shorter >= 3


def test_a_path_to_where_it_starts_is_a_single_waypoint(roadmap):
    (point,) = solved_points(roadmap, 1, seed=7)
    path = roadmap.plan(point, point, smooth=True, acceleration_limits=1.0)
    assert path.found
    assert len(path.times) == 1
    assert (path.duration, path.joint_length, path.task_length) == (0.0, 0.0, 0.0)


def test_paths_start_at_the_very_configuration_that_is_given(roadmap):
    robot = roadmap.robot
    free = robot.sample(200, torch.Generator().manual_seed(8))
    free = free[~robot.in_self_collision(free)]
    (goal,) = solved_points(roadmap, 1, seed=9)
    # measured values of continuous joints may have turned
    turned = torch.where(robot.continuous, free + 4.0 * math.pi, free)
    found = 0
    for q in turned[:6]:
        path = roadmap.plan(start_configuration=q, goal=goal)
        back = roadmap.plan(goal, goal_configuration=q)
        assert path.found == back.found
        if path.found:
            found += 1
            assert_is_a_path(roadmap, path)
            torch.testing.assert_close(path.configurations[0], q, rtol=0.0, atol=1e-12)
            assert distance(back.configurations[-1], q, robot.continuous) < 1e-9
            assert path.joint_length == pytest.approx(back.joint_length, rel=0.05)
    assert found >= 3


def test_a_configuration_on_the_map_goes_straight_on(roadmap):
    start, goal = solved_points(roadmap, 2, seed=10)
    q = roadmap.solve(start).configurations
    plain, given = roadmap.plan(start, goal), roadmap.plan(start_configuration=q, goal=goal)
    assert given.joint_length == pytest.approx(plain.joint_length, rel=0.01)


def test_parts_that_no_edge_connects_are_a_clear_answer(roadmap):
    x = roadmap.points[:, 0]
    middle = float(x[roadmap.resolved].median())
    across = (x[roadmap.edges] > middle).sum(1) == 1
    cut = replace(roadmap, connected=roadmap.connected & ~across)
    points = solved_points(cut, 400, seed=11, spread=0.0)
    everywhere = roadmap.points[roadmap.resolved]
    left, right = everywhere[everywhere[:, 0].argmin()], everywhere[everywhere[:, 0].argmax()]
    path = cut.plan(left, right)
    assert not path.found
    assert "start and goal lie in parts of the roadmap that no edge connects" in path.reason
    assert path.points.shape == (0, roadmap.task.width)
    assert path.configurations.shape == (0, roadmap.robot.n)
    assert len(path.times) == len(path.vertices) == 0
    assert math.isnan(path.duration)
    assert cut.plan(points[0], points[1]).found


def test_ends_that_do_not_serve_are_a_clear_answer(roadmap):
    robot = roadmap.robot
    (point,) = solved_points(roadmap, 1, seed=12)
    far = torch.full_like(point, 9.0)
    assert roadmap.plan(far, point).reason == "the start cannot be solved: outside"
    assert roadmap.plan(point, far).reason == "the goal cannot be solved: outside"
    every = robot.sample(3000, torch.Generator().manual_seed(13))
    for hit in every[robot.in_self_collision(every)][:1]:
        assert roadmap.plan(point, goal_configuration=hit).reason == "the goal configuration is in self-collision"
    if bool(robot.upper.isfinite().any()):
        beyond = torch.where(robot.upper.isfinite(), robot.upper + 0.1, 0.0)
        limited = ", ".join(n for n, end in zip(robot.joint_names, robot.upper, strict=True) if end < math.inf)
        assert roadmap.plan(start_configuration=beyond, goal=point).reason.endswith(f"beyond joint limits ({limited})")


def test_edges_in_collision_are_gone_round(kinova_roadmap):
    """With a margin that the roadmap was not built with, some of its edges are closed."""
    strict = replace(kinova_roadmap, robot=kinova_roadmap.robot.with_margin(0.02))
    points = solved_points(strict, 24, seed=14)
    found = 0
    for start, goal in zip(points[::2], points[1::2], strict=True):
        path = strict.plan(start, goal)
        if path.found:
            found += 1
            assert_is_a_path(strict, path)
        else:
            assert path.reason
    assert found


@pytest.mark.parametrize("smooth", [False, True])
def test_acceleration_limits_hold_from_rest_to_rest(roadmap, smooth):
    start, goal = solved_points(roadmap, 2, seed=15)
    limits = torch.linspace(1.0, 3.0, roadmap.robot.n, dtype=torch.float64)
    path = roadmap.plan(start, goal, smooth=smooth, velocity_limits=0.7, acceleration_limits=limits)
    assert_is_a_path(roadmap, path, velocity=torch.tensor(0.7))
    assert bool((accelerations(path.configurations, path.times).abs() <= limits * (1.0 + 1e-6)).all())
    assert path.duration >= roadmap.plan(start, goal, smooth=smooth, velocity_limits=0.7).duration


def test_bad_input_is_refused(roadmap):
    n, width = roadmap.robot.n, roadmap.task.width
    (point,) = solved_points(roadmap, 1, seed=16)
    q = roadmap.solve(point).configurations
    for arguments, complaint in [
        ({"start": point}, "goal: got neither of a point and a configuration; valid: goal or goal_configuration"),
        ({"goal": point}, "start: got neither"),
        ({"start": point, "start_configuration": q, "goal": point}, "start: got both"),
        ({"start": point[:-1], "goal": point}, "point shape"),
        ({"start": point, "goal": point[None]}, "goal shape"),
        ({"start": point * math.nan, "goal": point}, "NaN"),
        ({"start": point, "goal": point * math.inf}, "NaN or infinite"),
        ({"start": point, "goal_configuration": torch.zeros(n + 1)}, "configuration shape"),
        ({"start": point, "goal_configuration": torch.zeros(1, n)}, "goal configuration shape"),
        ({"start": point, "goal_configuration": torch.full((n,), math.nan)}, "goal configuration: got NaN"),
        ({"start": [0.0] * width, "goal": point}, "a real torch tensor"),
        ({"start": point, "goal": point, "step": 0.0}, "step: got 0.0"),
        ({"start": point, "goal": point, "step": 1.0}, "step: got 1.0"),
        ({"start": point, "goal": point, "step": math.nan}, "step: got nan"),
        ({"start": point, "goal": point, "velocity_limits": 0.0}, "velocity_limits: got 0.0"),
        ({"start": point, "goal": point, "velocity_limits": math.inf}, "velocity_limits: got inf"),
        ({"start": point, "goal": point, "acceleration_limits": torch.ones(n + 1)}, "acceleration_limits"),
    ]:
        with pytest.raises(ParameterError, match=complaint):
            roadmap.plan(**arguments)


def test_a_roadmap_without_a_resolved_vertex_is_refused(planar_roadmap):
    empty = replace(
        planar_roadmap,
        resolved=torch.zeros_like(planar_roadmap.resolved),
        connected=torch.zeros_like(planar_roadmap.connected),
        configurations=planar_roadmap.configurations * math.nan,
    )
    with pytest.raises(ParameterError, match="one without a resolved vertex"):
        empty.plan(planar_roadmap.points[0], planar_roadmap.points[1])
