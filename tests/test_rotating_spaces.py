"""Task spaces in which rotation varies: their metric, their errors, their grids and their graphs."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from grr_torch.errors import ParameterError
from grr_torch.projection.project import project, tool_points
from grr_torch.spaces.cliques import triangles
from grr_torch.spaces.graph import TaskGraph, staggered_grid
from grr_torch.spaces.product import find_product, product_graph
from grr_torch.spaces.rotation import matrix_from_quaternion, quaternion_from_matrix
from grr_torch.spaces.task import Axis, Pose, TaskSpace, Yaw, make_task, task_from_json

TASKS = [Pose(2), Pose(3), Yaw(3, (0.0, 0.6, 0.8), (0.3, -1.0, 2.0)), Yaw(3), Axis(3), Axis(3, (1.0, -2.0, 0.5))]
BATCHES = [(), (1,), (3, 1, 2)]


def draw(task: TaskSpace, *batch: int, seed: int = 0) -> torch.Tensor:
    points = torch.randn(*batch, task.width, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return task.unit(points)


def antipode(task: TaskSpace, points: torch.Tensor) -> torch.Tensor:
    """The same points, written otherwise."""
    other = points.clone()
    if task.width == 7:
        other[..., 3:] *= -1.0
    elif task.width == task.dimension + 1:
        other[..., -1] += 2.0 * math.pi
    return other


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("batch", BATCHES)
def test_the_metric_is_symmetric_and_zero_only_between_equals(task, batch):
    a, b = draw(task, *batch, seed=1), draw(task, *batch, seed=2)
    d = task.distance(a, b)
    assert d.shape == batch
    assert bool((d > 0.0).all())
    torch.testing.assert_close(d, task.distance(b, a))
    torch.testing.assert_close(d, task.distance(antipode(task, a), b))
    assert not bool(task.distance(a, antipode(task, a)).gt(1e-15).any())


@pytest.mark.parametrize("task", [task for task in TASKS if not isinstance(task, Axis)])
def test_the_metric_is_the_paper_s_of_the_orientations(task):
    a, b = draw(task, 50, seed=1), draw(task, 50, seed=2)
    quaternions = [quaternion_from_matrix(task.matrices(p.T).permute(2, 0, 1)) for p in (a, b)]
    expected = (a - b)[:, : task.dimension].norm(dim=1) + 0.3 * (1.0 - (quaternions[0] * quaternions[1]).sum(1).abs())
    torch.testing.assert_close(task.distance(a, b), expected)


def test_the_distance_of_directions_is_the_smallest_over_all_rolls():
    """Of all rotations that take one axis to the other, the nearest to none."""
    task, generator = Axis(3), torch.Generator().manual_seed(3)
    a, b = draw(task, 1, seed=1)[0, 3:], draw(task, 1, seed=2)[0, 3:]
    raw = torch.randn(200_000, 4, dtype=torch.float64, generator=generator)
    rotations = matrix_from_quaternion((raw / raw.norm(dim=1, keepdim=True)).T).permute(2, 0, 1)
    near = (rotations @ a - b).norm(dim=1) < 0.05
    assert int(near.sum()) > 20
    cosine = quaternion_from_matrix(rotations[near])[:, 0].abs()
    apart = float(task.rotations.distance(a, b))
    assert float(1.0 - cosine.max()) == pytest.approx(apart, abs=0.05)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("batch", BATCHES)
def test_interpolation_goes_evenly_from_end_to_end(task, batch):
    a, b = draw(task, *batch, seed=1), draw(task, *batch, seed=2)
    for fraction, end in ((0.0, a), (1.0, b)):
        assert bool((task.distance(task.interpolate(a, b, fraction), end) < 1e-12).all())
    quarter, half = task.interpolate(a, b, 0.25), task.interpolate(a, b, 0.5)
    torch.testing.assert_close(task.unit(half), half)
    assert bool((task.distance(task.interpolate(a, half, 0.5), quarter) < 1e-12).all())
    torch.testing.assert_close(task.distance(a, half), task.distance(half, b))


def test_between_opposite_directions_there_is_a_way():
    task = Axis(3)
    a = draw(task, 20)
    b = torch.cat([a[:, :3], -a[:, 3:]], dim=1)
    half = task.interpolate(a, b, 0.5)
    torch.testing.assert_close((half[:, 3:] * a[:, 3:]).sum(1), torch.zeros(20, dtype=torch.float64))
    torch.testing.assert_close(half[:, 3:].norm(dim=1), torch.ones(20, dtype=torch.float64))


@pytest.mark.parametrize("task", TASKS)
def test_the_centre_of_equals_is_where_they_are_and_does_not_depend_on_signs(task):
    a = draw(task, 20)
    torch.testing.assert_close(task.centre(a[:, None].expand(-1, 3, -1)), a)
    b = task.interpolate(a, draw(task, 20, seed=5), 0.05)
    middle = task.centre(torch.stack([a, antipode(task, b)], dim=1))
    assert bool((task.distance(middle, task.interpolate(a, b, 0.5)) < 1e-4).all())


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("far", [False, True])
def test_the_error_vanishes_at_the_point_and_falls_as_the_jacobian_says(kinova, planar_5, task, far):
    robot = planar_5 if task.dimension == 2 else kinova
    q = robot.sample(40, torch.Generator().manual_seed(1))
    if isinstance(task, Yaw):
        # only some configurations are at a point of the task
        q, valid = project(robot, task, tool_points(robot, task, q), q, check_collision=False)
        q = q[valid]
        assert len(q) > 5
    points = tool_points(robot, task, q)
    position, rotation = robot.forward_kinematics(q)
    here = task.error(points.T, position.T, rotation.permute(1, 2, 0))
    assert here.shape == (task.constraints, len(q))
    assert float(here.abs().max()) < 2e-3
    if far:
        points = task.interpolate(points, draw(task, len(q)), 0.02)
    jacobian = task.jacobian(robot.tree.jacobian(robot.tree.frames(q.T.contiguous())), points.T)
    step = 1e-6 * torch.randn(q.shape, dtype=q.dtype, generator=torch.Generator().manual_seed(2))
    errors = []
    for moved in (q - step, q + step):
        position, rotation = robot.forward_kinematics(moved)
        errors.append(task.error(points.T, position.T, rotation.permute(1, 2, 0)))
    expected = -(jacobian * step.T).sum(1)
    torch.testing.assert_close(0.5 * (errors[1] - errors[0]), expected, atol=2e-7 if far else 3e-9, rtol=0.0)


def test_an_opposite_axis_is_half_a_turn_away():
    task = Axis(3)
    targets = draw(task, 30)
    rotation = torch.zeros(3, 3, 30, dtype=torch.float64)
    rotation[:, 2] = -targets[:, 3:].T
    error = task.error(targets.T, targets[:, :3].T, rotation)
    assert bool(error.isfinite().all())
    torch.testing.assert_close(error[3:].norm(dim=0), torch.full((30,), math.pi, dtype=torch.float64))


@pytest.mark.parametrize(("task", "count"), [(Pose(2), 8), (Yaw(3), 5), (Axis(3), 100), (Pose(3), 200)])
def test_grids_of_rotations_are_even_connected_and_have_no_double(task, count):
    grid = task.rotations.grid(count)
    assert len(grid.values) == count
    torch.testing.assert_close(task.rotations.unit(grid.values), grid.values)
    apart = task.rotations.distances(grid.values, grid.values)
    apart.fill_diagonal_(torch.inf)
    nearest = apart.amin(1).sqrt()
    assert float(nearest.min()) > 0.3 * float(nearest.max())
    assert bool((grid.edges[:, 0] < grid.edges[:, 1]).all())
    assert len(grid.edges.unique(dim=0)) == len(grid.edges)
    joined = {tuple(edge) for edge in grid.edges.tolist()}
    closest = {tuple(sorted((k, int(row.argmin())))) for k, row in enumerate(apart)}
    assert closest <= joined, "a rotation is not joined to its nearest"
    # on a triangulated sphere, Euler: E = 3 V − 6
    if isinstance(task, Axis):
        assert len(grid.edges) == 3 * count - 6
        assert len(triangles(grid.edges, count)) >= 2 * count - 4


@given(st.sampled_from(TASKS), st.integers(1, 9))
def test_small_grids_of_rotations_are_grids_too(task, count):
    grid = task.rotations.grid(count)
    assert len(grid.values) == count
    assert bool((grid.edges < count).all())
    assert (len(grid.edges) > 0) == (count > 1)


def test_the_planar_pose_has_the_known_graph(planar_5):
    problem = planar_5.preset.problems["pose"]
    graph = product_graph(Pose(2), staggered_grid(problem.bounds, problem.points), problem.rotations)
    assert (len(graph.points), len(graph.edges)) == (8104, 31688)


@pytest.mark.parametrize(("task", "count"), [(Pose(2), 6), (Axis(3), 12), (Pose(3), 20)])
def test_a_product_has_the_edges_of_both_graphs_and_is_found_again(task, count):
    places = staggered_grid([(0.0, 1.0), (0.0, 0.7), (0.2, 0.9)][: task.dimension], 30)
    graph = product_graph(task, places, count)
    size, grid = len(places.points), task.rotations.grid(count)
    expected = {(r * size + a, r * size + b) for r in range(count) for a, b in places.edges.tolist()}
    expected |= {(r * size + p, s * size + p) for p in range(size) for r, s in grid.edges.tolist()}
    assert set(map(tuple, graph.edges.tolist())) == expected
    assert len(graph.edges) == len(expected)
    again = find_product(task, graph.points, graph.edges)
    assert again.positions.lattice == places.lattice
    assert torch.equal(again.rotations.values, grid.values)
    assert torch.equal(again.rotations.edges, grid.edges)
    with pytest.raises(ParameterError, match="positions times rotations"):
        find_product(task, graph.points.flip(0)[1:], graph.edges[:5])


@pytest.mark.parametrize(("task", "count"), [(Pose(2), 6), (Axis(3), 12)])
def test_cells_of_a_product_are_those_of_its_edges(task, count):
    graph = product_graph(task, staggered_grid([(0.0, 1.0)] * task.dimension, 20), count)
    every = torch.ones(len(graph.edges), dtype=torch.bool)
    found = {tuple(sorted(corners)) for corners in graph.triangles(every).tolist()}
    assert found == {tuple(corners) for corners in triangles(graph.edges, len(graph.points)).tolist()}
    faces = graph.faces(every)
    sides = torch.stack([faces, faces.roll(-1, dims=1)], dim=-1).sort(dim=-1).values.reshape(-1, 2)
    edges = {tuple(edge) for edge in graph.edges.tolist()}
    assert {tuple(side) for side in sides.tolist()} <= edges
    flat = 0 if graph.positions.lattice is None else len(graph.positions.lattice.faces()) * count
    assert len(faces) == flat + len(graph.positions.edges) * len(graph.rotations.edges)
    assert len(graph.faces(~every)) == len(graph.triangles(~every)) == 0


@pytest.mark.parametrize(("task", "count"), [(Pose(2), 8), (Yaw(3), 1), (Axis(3), 30), (Pose(3), 24)])
@pytest.mark.parametrize("hops", [1, 2])
def test_neighbours_are_those_so_many_edges_away_with_their_distances(task, count, hops):
    # cubic cells: the shells of a grid are then the vertices so many edges away, and some more
    graph = product_graph(task, staggered_grid([(0.0, 1.0)] * task.dimension, 91 if task.dimension == 3 else 61), count)
    vertices = torch.arange(0, len(graph.points), 37)
    indices, distances = graph.neighbours(vertices, hops)
    there = distances.isfinite()
    rows = vertices[:, None].expand_as(indices)[there]
    torch.testing.assert_close(distances[there], task.distance(graph.points[rows], graph.points[indices[there]]))
    starts, ends = graph.adjacency
    for k, vertex in enumerate(vertices.tolist()):
        mine = indices[k][there[k]].tolist()
        assert len(set(mine)) == len(mine)
        assert vertex not in mine
        near = {vertex}
        for _ in range(hops):
            near |= {int(end) for v in near for end in ends[starts[v] : starts[v + 1]]}
        assert near - {vertex} <= set(mine)


@pytest.mark.parametrize(("task", "count"), [(Pose(2), 1), (Pose(2), 8), (Axis(3), 30), (Pose(3), 24)])
def test_around_a_vertex_are_the_other_ends_of_its_edges(task, count):
    graph = product_graph(task, staggered_grid([(0.0, 1.0)] * task.dimension, 40), count)
    vertices = torch.arange(0, len(graph.points), 7).flip(0)
    rank, others = graph.around(vertices)
    expected = TaskGraph.around(graph, vertices)
    assert torch.equal(rank, expected[0])
    size = len(graph.points)
    assert torch.equal((rank * size + others).sort().values, (expected[0] * size + expected[1]).sort().values)


@pytest.mark.parametrize(("task", "count"), [(Pose(2), 8), (Axis(3), 30), (Pose(3), 24)])
def test_the_nearest_vertices_are_those_by_the_metric(task, count):
    graph = product_graph(task, staggered_grid([(-1.0, 1.0)] * task.dimension, 60), count)
    points = draw(task, 2, 15)
    found = graph.nearest(points, 5)
    every = task.distance(points[..., None, :], graph.points)
    torch.testing.assert_close(every.gather(-1, found), every.topk(5, largest=False).values)


@pytest.mark.parametrize(
    ("kind", "dimension", "options", "message"),
    [
        ("yaw", 2, {}, "in the plane"),
        ("axis", 2, {}, "in the plane"),
        ("axis", 3, {"axis": (0.0, 0.0, 0.0)}, "not all zero"),
        ("yaw", 3, {"axis": (0.0, 0.0, 0.0)}, "not all zero"),
        ("yaw", 3, {"axis": (0.0, math.nan, 0.0)}, "not all zero"),
        ("yaw", 3, {"rpy": (9.0, 0.0, 0.0)}, "full turn"),
        ("pose", 3, {"axis": (0.0, 0.0, 1.0)}, "which has none"),
        ("axis", 3, {"rpy": (0.0, 0.0, 1.0)}, "leaves it free"),
        ("axis", 3, {"axis": (0.0, 1.0)}, "three finite"),
    ],
)
def test_bad_spaces_are_errors(kind, dimension, options, message):
    with pytest.raises(ParameterError, match=message):
        make_task(kind, dimension, **options)


@pytest.mark.parametrize("task", TASKS)
def test_spaces_survive_json(task):
    assert task_from_json(task.to_json()) == task
