"""Task spaces in which rotation varies: their metric, their errors, their graphs, and the maps built over them."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import grr_torch
from grr_torch.errors import GrrError, ParameterError, SeedError
from grr_torch.projection.project import project, tool_points
from grr_torch.resolution.objectives import measure_objective
from grr_torch.resolution.slices import fullest_slice
from grr_torch.resolution.verify import verify_file
from grr_torch.spaces.cliques import triangles
from grr_torch.spaces.graph import TaskGraph, random_graph, staggered_grid
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


@pytest.fixture(scope="module")
def planar_pose(planar_5) -> grr_torch.Roadmap:
    return grr_torch.build(planar_5, "pose", points=200, reachability=8)


def test_every_reachable_pose_of_the_plane_is_resolved(planar_pose):
    """The wrist, one link behind the tool, has to lie in the disc that four links reach."""
    x, y, yaw = planar_pose.points.T
    wrist = torch.hypot(x - 0.1 * yaw.cos(), y - 0.1 * yaw.sin())
    assert torch.equal(planar_pose.resolved, wrist <= 0.4 + 1e-9)
    assert torch.equal(planar_pose.resolved, planar_pose.reachable)
    quality = planar_pose.quality()
    assert quality.coverage == 1.0
    assert quality.connectivity > 0.99
    assert quality.max_position_error <= 1e-4
    assert quality.max_rotation_error <= 1e-3
    assert quality.squares > 0


@pytest.mark.parametrize(
    ("kind", "options"), [("yaw", {"rotations": 4}), ("axis", {"rotations": 12}), ("pose", {"rotations": 16})]
)
def test_kinova_s_spaces_are_built_verified_and_solved(kinova, tmp_path, kind, options):
    roadmap = grr_torch.build(kinova, kind, points=300, refine=kind == "yaw", **options)
    quality = roadmap.quality()
    assert quality.resolved_vertices > 0.02 * quality.vertices
    assert quality.connectivity_resolved > 0.5
    assert quality.max_position_error <= 1e-4
    assert quality.max_rotation_error <= 1e-3
    assert quality.self_collisions == 0
    file = tmp_path / "map.grr"
    roadmap.save(file)
    assert all(check.passed for check in verify_file(file))
    again = grr_torch.Roadmap.load(file)
    assert again.task == roadmap.task
    assert torch.equal(again.configurations.nan_to_num(), roadmap.configurations.nan_to_num())
    some = roadmap.points[roadmap.resolved][::7]
    solution = again.solve(antipode(roadmap.task, some))
    assert float(solution.valid.double().mean()) > 0.6
    found = solution.configurations[solution.valid]
    reached = tool_points(kinova, roadmap.task, found)
    assert float(roadmap.task.distance(reached, some[solution.valid]).max()) < 2e-4


def test_a_point_between_vertices_is_solved_and_agrees_with_them(planar_pose):
    """On an edge of the map the solver gives a configuration between those of its ends."""
    edges = planar_pose.edges[planar_pose.connected][::5]
    a, b = (planar_pose.points[end] for end in edges.T)
    middle = planar_pose.task.interpolate(a, b, 0.5)
    solution = planar_pose.solve(middle)
    assert float(solution.valid.double().mean()) > 0.9
    position, rotation = planar_pose.robot.forward_kinematics(solution.configurations[solution.valid])
    error = planar_pose.task.error(middle[solution.valid].T, position.T, rotation.permute(1, 2, 0))
    assert float(error.abs().max()) <= 1e-3


def test_what_cannot_be_reached_is_said_so(planar_pose):
    points = torch.tensor([[0.45, 0.0, math.pi], [0.0, 0.9, 0.0], [0.2, 0.1, 0.5]], dtype=torch.float64)
    status = planar_pose.solve(points).status.tolist()
    assert status[0] in ("too far", "not converged")
    assert status[1] == "outside"
    assert status[2] in ("solved", "uncertified")


def test_a_way_is_planned_that_turns(planar_pose):
    start, goal = torch.tensor([[0.25, 0.1, 0.0], [0.1, 0.25, 2.0]], dtype=torch.float64)
    path = planar_pose.plan(start, goal)
    assert path.found
    reached = tool_points(planar_pose.robot, planar_pose.task, path.configurations)
    for end, point in ((0, start), (-1, goal)):
        assert float(planar_pose.task.distance(reached[end], point)) < 2e-4
    assert float(path.configurations.diff(dim=0).norm(dim=1).max()) <= 0.05 + 1e-9
    assert path.task_length == pytest.approx(float(path.points[:, :2].diff(dim=0).norm(dim=1).sum()))
    measured = planar_pose.plan(start_configuration=path.configurations[3], goal=goal)
    assert measured.found
    torch.testing.assert_close(measured.configurations[0], path.configurations[3])


def test_a_slice_is_a_roadmap(planar_pose):
    part = fullest_slice(planar_pose)
    assert len(part.points) * 8 == len(planar_pose.points)
    assert len(part.points[:, 2].unique()) == 1
    assert int(part.connected.sum()) > 0
    assert torch.equal(part.wave >= 0, part.resolved)
    assert part.wave[part.resolved].unique().tolist() == list(range(int(part.wave.max()) + 1))
    position, _ = part.robot.forward_kinematics(part.configurations[part.resolved])
    assert float((position[:, :2] - part.positions[part.resolved]).norm(dim=1).max()) <= 1e-4


def test_seeds_are_found_where_none_are_given(planar_5, kinova):
    planar = grr_torch.build(planar_5, "pose", points=100, seeds="auto", candidates=12, refine=False)
    quality = planar.quality()
    assert quality.resolved_vertices > 0.4 * quality.vertices
    drill = grr_torch.build(
        kinova, "axis", points=60, rotations=12, seeds="auto", candidates=6, refine=False, bounds=[(0.2, 0.6)] * 3
    )
    assert int(drill.resolved.sum()) > 100


def test_self_motion_of_an_axis_has_two_dimensions(kinova):
    manifold = grr_torch.self_motion_manifold(kinova, Axis(3), [0.4, 0.1, 0.3, 0.0, 0.0, -2.0], samples=60)
    assert manifold.dimension == 2
    _, rotation = kinova.forward_kinematics(manifold.configurations)
    torch.testing.assert_close(
        rotation[:, :, 2],
        torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand(len(rotation), 3),
        atol=1e-4,
        rtol=0,
    )


def test_manipulability_of_an_axis_does_not_depend_on_the_basis(kinova):
    q = kinova.sample(30, torch.Generator().manual_seed(0))
    jacobian = kinova.tree.jacobian(kinova.tree.frames(q.T.contiguous())).permute(2, 0, 1)
    _, rotation = kinova.forward_kinematics(q)
    # in the tool frame, the axis is z: the first two rows of rotation
    turned = rotation.mT @ jacobian[:, 3:]
    rows = torch.cat([jacobian[:, :3], turned[:, :2]], dim=1)
    expected = torch.linalg.det(rows @ rows.mT).sqrt()
    torch.testing.assert_close(measure_objective(kinova, Axis(3), "manipulability", q), expected, atol=1e-6, rtol=1e-4)


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


@pytest.mark.parametrize("count", [0, -3, 10**7, 2.5, True])
def test_bad_counts_of_rotations_are_errors(planar_5, count):
    with pytest.raises(ParameterError, match="rotations: got"):
        grr_torch.build(planar_5, "pose", rotations=count)


def test_what_does_not_fit_is_refused_with_a_reason(planar_5, kinova, planar_pose, box_arm):
    with pytest.raises(ParameterError, match="in which rotation does not vary"):
        grr_torch.build(planar_5, "position", rotations=8)
    with pytest.raises(ParameterError, match="up to"):
        grr_torch.build(planar_5, "pose", points=1_000_000)
    with pytest.raises(ParameterError, match="edges, as rotation varies"):
        grr_torch.build(planar_5, "pose", points=20, neighbours=24)
    bare = grr_torch.load_robot(box_arm)
    with pytest.raises(ParameterError, match="how many rotations"):
        grr_torch.build(bare, Pose(3), points=random_graph([(0.2, 0.5)] * 3, 20, k=3))
    for zero, task in ((Pose(3), "quaternion"), (Axis(3), "direction")):
        with pytest.raises(ParameterError, match=task):
            project(kinova, zero, torch.zeros(1, zero.width, dtype=torch.float64), kinova.sample(1))
    with pytest.raises(ParameterError, match="rotation is not teleoperated"):
        grr_torch.Teleoperator(planar_pose)


def test_an_orientation_that_no_arm_of_this_kind_has_is_an_error(planar_5):
    """The planar arm's tool cannot point out of its plane, nor can it be asked to."""
    graph = product_graph(Yaw(3), staggered_grid([(0.0, 0.3), (0.0, 0.3), (0.0, 0.1)], 20), 4)
    with pytest.raises(ParameterError, match="two axes"):
        grr_torch.build(planar_5, Yaw(3), points=graph)


def test_orientations_out_of_reach_are_an_error(kinova):
    """Within reach of the tool, but not of the last joint behind it."""
    places = TaskGraph(torch.tensor([[0.0, 0.0, 1.30], [0.01, 0.0, 1.30]], dtype=torch.float64), torch.tensor([[0, 1]]))
    down = product_graph(Yaw(3, rpy=(math.pi, 0.0, 0.0)), places, 2)
    with pytest.raises(GrrError):
        grr_torch.build(kinova, Yaw(3, rpy=(math.pi, 0.0, 0.0)), points=down, seeds="auto", candidates=6)


def test_seeds_far_from_every_orientation_are_named(kinova):
    places = TaskGraph(torch.tensor([[0.0, 0.0, 1.0], [0.01, 0.0, 1.0]], dtype=torch.float64), torch.tensor([[0, 1]]))
    task = Yaw(3, rpy=(math.pi, 0.0, 0.0))
    with pytest.raises((SeedError, ParameterError)):
        grr_torch.build(kinova, task, points=product_graph(task, places, 2), seeds=[[0.0] * 7], refine=False)


@pytest.mark.parametrize("task", TASKS)
def test_spaces_survive_json(task):
    assert task_from_json(task.to_json()) == task
