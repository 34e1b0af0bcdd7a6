"""Maps over spaces in which rotation varies: built, stored, solved, planned on; and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

import grr_torch
from grr_torch.errors import GrrError, ParameterError, SeedError
from grr_torch.projection.project import project, tool_points
from grr_torch.resolution.objectives import measure_objective
from grr_torch.resolution.slices import fullest_slice
from grr_torch.resolution.verify import verify_file
from grr_torch.spaces.graph import TaskGraph, random_graph, staggered_grid
from grr_torch.spaces.product import product_graph
from grr_torch.spaces.task import Axis, Pose, TaskSpace, Yaw


def antipode(task: TaskSpace, points: torch.Tensor) -> torch.Tensor:
    """The same points, written otherwise."""
    return torch.cat([points[:, :3], -points[:, 3:]], dim=1) if task.width == 7 else points


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


def test_every_resolved_vertex_is_solved_at_its_own_point(kinova):
    """On a coarse map with many broken edges, in which some vertices lie in the smaller part of what is around them."""
    roadmap = grr_torch.build(kinova, "axis", points=150, rotations=12, refine=False)
    points = roadmap.points[roadmap.resolved]
    solution = roadmap.solve(points)
    assert bool(solution.valid.all())
    first = roadmap.solver.solve_from(points.T.contiguous(), *roadmap.solver.guess(points))[1]
    failed = first.numpy() > 1
    assert failed.any()
    assert set(solution.status[failed]) == {"uncertified"}


def test_poses_beside_a_broken_edge_are_uncertified(planar_pose):
    first, second = planar_pose.edges[planar_pose.connected][60]
    broken = (planar_pose.edges == torch.stack([first, second])).all(1)
    beside = planar_pose.task.interpolate(planar_pose.points[first], planar_pose.points[second], 0.1)
    assert str(planar_pose.solve(beside).status) == "solved"
    spoilt = replace(planar_pose, connected=planar_pose.connected & ~broken)
    assert str(spoilt.solve(beside).status) == "uncertified"


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


def test_points_beyond_all_numbers_are_outside_at_every_rotation(planar_5):
    roadmap = grr_torch.build(planar_5, "pose", points=100, refine=False)
    yaws = roadmap.points[:, 2].unique()
    far = torch.stack([torch.full_like(yaws, 1e300), torch.zeros_like(yaws), yaws], dim=1)
    assert set(roadmap.solve(far).status.tolist()) == {"outside"}
