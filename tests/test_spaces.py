"""Laws of configuration space, rotations, task spaces and grids."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as stnp
from scipy.spatial.transform import Rotation, Slerp

from grr_torch.errors import ParameterError, UnknownNameError
from grr_torch.spaces import configuration as cspace
from grr_torch.spaces.graph import TaskGraph, random_graph, staggered_grid
from grr_torch.spaces.rotation import (
    matrix_from_rpy,
    quaternion_distance,
    quaternion_from_matrix,
    rotation_error,
    slerp,
)
from grr_torch.spaces.task import Axis, FixedRotation, Pose, Position, Yaw, make_task, task_from_json

CONTINUOUS = torch.tensor([True, False, True])
angles = stnp.arrays(np.float64, 3, elements=st.floats(-20.0, 20.0))


def tensors(*arrays):
    return [torch.from_numpy(array) for array in arrays]


@given(angles, angles)
def test_distance_is_symmetric_and_blind_to_full_turns_of_continuous_joints(a, b):
    a, b = tensors(a, b)
    turns = torch.tensor([4 * math.pi, 0.0, -2 * math.pi], dtype=torch.float64)
    d = cspace.distance(a, b, CONTINUOUS)
    torch.testing.assert_close(d, cspace.distance(b, a, CONTINUOUS), atol=1e-12, rtol=0)
    torch.testing.assert_close(d, cspace.distance(a + turns, b, CONTINUOUS), atol=1e-12, rtol=0)


def test_differences_of_other_joints_are_not_wrapped():
    a = torch.zeros(3, dtype=torch.float64)
    assert float(cspace.distance(a, a + 2 * math.pi, CONTINUOUS)) == pytest.approx(2 * math.pi)


@given(angles, angles, angles)
def test_the_triangle_inequality_holds(a, b, c):
    a, b, c = tensors(a, b, c)
    way_round = cspace.distance(a, b, CONTINUOUS) + cspace.distance(b, c, CONTINUOUS)
    assert cspace.distance(a, c, CONTINUOUS) <= way_round + 1e-9


@given(angles, angles)
def test_the_middle_is_half_way_on_both_sides(a, b):
    a, b = tensors(a, b)
    middle = cspace.interpolate(a, b, 0.5, CONTINUOUS)
    half = 0.5 * cspace.distance(a, b, CONTINUOUS)
    torch.testing.assert_close(cspace.distance(a, middle, CONTINUOUS), half, atol=1e-9, rtol=0)
    torch.testing.assert_close(cspace.distance(middle, b, CONTINUOUS), half, atol=1e-9, rtol=0)


@given(stnp.arrays(np.float64, (4, 3), elements=st.floats(-0.7, 0.7)), angles)
def test_the_average_turns_with_its_inputs(near, shift):
    near, shift = tensors(near, shift)
    weights = torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=torch.float64)
    turned, plain = (
        cspace.average((weights[:, None] * cspace.embed(q, CONTINUOUS)).sum(0), CONTINUOUS)
        for q in (near + shift, near)
    )
    plain = plain + shift
    assert cspace.distance(turned, plain, CONTINUOUS) < 1e-9


def test_the_average_of_configurations_across_the_seam_stays_there():
    q = torch.tensor([[3.1, 1.0, -3.1], [-3.1, 3.0, 3.1]], dtype=torch.float64)
    average = cspace.average(cspace.embed(q, CONTINUOUS).sum(0), CONTINUOUS)
    torch.testing.assert_close(average.abs(), torch.tensor([math.pi, 2.0, math.pi], dtype=torch.float64))


def rotations(count, seed=0):
    return Rotation.random(count, random_state=seed)


def test_quaternions_agree_with_scipy():
    r = Rotation.concatenate([rotations(200), Rotation.from_rotvec(np.pi * np.eye(3)), Rotation.identity(1)])
    ours = quaternion_from_matrix(torch.from_numpy(r.as_matrix()))
    theirs = torch.from_numpy(r.as_quat(scalar_first=True))
    assert float(quaternion_distance(ours, theirs).max()) < 1e-12
    assert bool((ours[:, 0] >= 0).all())


def test_rpy_is_about_fixed_axes():
    expected = Rotation.from_euler("xyz", [0.3, -1.1, 2.0]).as_matrix()
    np.testing.assert_allclose(matrix_from_rpy(0.3, -1.1, 2.0).numpy(), expected, atol=1e-15)


@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.5, 1.0])
def test_slerp_agrees_with_scipy(fraction):
    a, b = rotations(50, 1), rotations(50, 2)
    ours = slerp(*(torch.from_numpy(r.as_quat(scalar_first=True)) for r in (a, b)), fraction)
    for k in range(50):
        expected = Slerp([0, 1], Rotation.concatenate([a[k], b[k]]))(fraction).as_quat(scalar_first=True)
        assert abs(float(ours[k] @ torch.from_numpy(expected))) == pytest.approx(1.0, abs=1e-12)


def test_slerp_between_equal_rotations_stays():
    q = torch.tensor([[0.5, 0.5, 0.5, 0.5]], dtype=torch.float64)
    torch.testing.assert_close(slerp(q, -q, 0.4), q)


def test_rotation_error_turns_one_rotation_into_the_other_up_to_half_a_turn():
    a, b = rotations(300, 3), rotations(300, 4)
    half = Rotation.from_rotvec(np.pi * rotations(20, 5).as_matrix()[:, 0])
    tiny = Rotation.from_rotvec(1e-9 * np.ones((1, 3)))
    a = Rotation.concatenate([a, half * b[:20], tiny, b[:1]])
    b = Rotation.concatenate([b, b[:20], Rotation.identity(1), b[:1]])
    target, rotation = (torch.from_numpy(r.as_matrix()).permute(1, 2, 0) for r in (a, b))
    error = rotation_error(target, rotation).T.numpy()
    assert np.isfinite(error).all()
    assert ((Rotation.from_rotvec(error) * b).inv() * a).magnitude().max() < 1e-6
    np.testing.assert_allclose(np.linalg.norm(error, axis=1), (a * b.inv()).magnitude(), atol=1e-7)


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2)])
def test_task_distance_is_the_paper_s_metric(batch):
    a, b = torch.rand(*batch, 3, dtype=torch.float64), torch.rand(*batch, 3, dtype=torch.float64)
    for task in (Position(3), FixedRotation(3, (0.1, 0.2, 0.3))):
        torch.testing.assert_close(task.distance(a, b), (a - b).norm(dim=-1))
        torch.testing.assert_close(task.interpolate(a, b, 0.5), 0.5 * (a + b))


def test_tasks_survive_json():
    fixed = (Position(2), Position(3), FixedRotation(2, (0, 0, 1.0)), FixedRotation(3, (1.0, 2.0, 3.0)))
    for task in (*fixed, Pose(2), Pose(3), Yaw(3, (0.0, 2.0, 0.0), (1.0, 0, 0)), Axis(3, (1.0, 0.0, 0.0))):
        assert task_from_json(task.to_json()) == task


@pytest.mark.parametrize(
    ("kind", "dimension", "rpy"),
    [
        ("position", 4, None),
        ("position", 3, (0, 0, 0)),
        ("fixed-rotation", 3, (0, 0)),
        ("fixed-rotation", 3, ()),
        ("fixed-rotation", 3, 0.0),
        ("fixed-rotation", 3, ("a", "b", "c")),
        ("fixed-rotation", 3, (0, 0, math.nan)),
        ("fixed-rotation", 3, (180.0, 0, 90.0)),
        ("fixed-rotation", 2, (1.0, 0, 0)),
    ],
)
def test_bad_tasks_are_errors(kind, dimension, rpy):
    with pytest.raises(ParameterError):
        make_task(kind, dimension, rpy)


def test_an_unknown_task_lists_the_known():
    with pytest.raises(UnknownNameError, match="Did you mean 'position'"):
        make_task("positon", 3)


@pytest.mark.parametrize(
    ("bounds", "n", "vertices", "edges"),
    [([(-0.5, 0.5)] * 2, 1000, 1013, 2948), ([(-1.1, 1.1), (-1.1, 1.1), (-0.75, 1.35)], 3100, 3299, 16642)],
)
def test_the_paper_s_grids(bounds, n, vertices, edges):
    graph = staggered_grid(bounds, n)
    assert (len(graph.points), len(graph.edges)) == (vertices, edges)


@given(st.integers(2, 3), st.integers(1, 3000), st.floats(0.1, 10.0))
def test_grids_have_enough_vertices_within_bounds_and_are_connected(dimension, n, stretch):
    bounds = [(-1.0, 1.0), (0.0, stretch), (2.0, 3.0)][:dimension]
    graph = staggered_grid(bounds, n)
    assert len(graph.points) >= n
    low, high = torch.tensor(bounds, dtype=torch.float64).T
    assert torch.equal(graph.points.amin(0), low)
    assert torch.equal(graph.points.amax(0), high)
    assert len(torch.unique(graph.points, dim=0)) == len(graph.points)
    assert len(torch.unique(graph.edges, dim=0)) == len(graph.edges)
    assert bool((graph.edges[:, 0] < graph.edges[:, 1]).all())
    assert len(torch.unique(graph.edges)) == len(graph.points)


def test_centres_are_in_the_middle_of_their_corners():
    graph = staggered_grid([(0.0, 1.0), (0.0, 1.0), (0.0, 1.0)], 300)
    first, second = graph.edges.T
    is_centre = torch.zeros(len(graph.points), dtype=torch.bool)
    is_centre[second[torch.bincount(second, minlength=len(graph.points))[second] == 8]] = True
    for centre in is_centre.nonzero()[:5, 0]:
        corners = graph.points[first[second == centre]]
        torch.testing.assert_close(corners.mean(0), graph.points[centre])


def test_neighbours_are_the_nearest(generator):
    graph = random_graph([(0.0, 1.0)] * 3, 200, k=5, generator=generator)
    indices, distances = graph.neighbours(torch.arange(200), 9)
    full = torch.cdist(graph.points, graph.points).fill_diagonal_(torch.inf)
    expected = full.topk(9, largest=False)
    torch.testing.assert_close(distances, expected.values)
    assert torch.equal(indices, expected.indices)
    assert bool((torch.bincount(graph.edges.flatten(), minlength=200) >= 5).all())
    assert torch.equal(graph.nearest(graph.points + 1e-9)[:, 0], torch.arange(200))


@given(st.integers(2, 3), st.integers(1, 200), st.floats(0.3, 3.0), st.integers(1, 70))
def test_a_grid_s_arithmetic_finds_what_a_search_finds(dimension, n, stretch, k):
    graph = staggered_grid([(-1.0, 1.0), (0.0, stretch), (2.0, 3.0)][:dimension], n)
    count = len(graph.points)
    indices, distances = graph.neighbours(torch.arange(count), k)
    found = torch.full((count, count), torch.inf, dtype=torch.float64)
    rows = torch.arange(count)[:, None].expand_as(indices)
    there = distances.isfinite()
    found[rows[there], indices[there]] = distances[there]
    assert int(there.sum()) == int(found.isfinite().sum()), "a neighbour was listed twice"
    everything = torch.cdist(graph.points, graph.points, compute_mode="donot_use_mm_for_euclid_dist")
    everything.fill_diagonal_(torch.inf)
    near = everything <= distances[there].amax() * (1.0 + 1e-12) if there.any() else everything < 0.0
    torch.testing.assert_close(found, torch.where(near, everything, torch.inf))


def test_a_thin_grid_finds_neighbours_within_it():
    graph = staggered_grid([(0.2, 1.0), (-0.5, 0.5), (0.3, 0.3001)], 3000)
    distances = graph.neighbours(torch.arange(len(graph.points)), 64)[1]
    assert int(distances.isfinite().sum(1).min()) >= 8


def test_an_inner_vertex_of_a_grid_has_all_its_neighbours():
    graph = staggered_grid([(-1.0, 1.0)] * 3, 3000)
    middle = graph.nearest(torch.zeros(1, 3, dtype=torch.float64))[0]
    for k in (1, 8, 14, 30, 64):
        distances = graph.neighbours(middle, k)[1]
        assert int(distances.isfinite().sum()) >= k


def test_adjacency_lists_both_directions():
    graph = TaskGraph(torch.rand(3, 2, dtype=torch.float64), torch.tensor([[0, 2], [1, 2]]))
    assert [part.tolist() for part in graph.adjacency] == [[0, 1, 2, 4], [2, 2, 0, 1]]


@pytest.mark.parametrize(
    ("points", "edges"),
    [
        (torch.zeros(0, 2, dtype=torch.float64), torch.empty(0, 2, dtype=torch.long)),
        (torch.zeros(1, 2), torch.empty(0, 2, dtype=torch.long)),
        (torch.tensor([[0.0, torch.nan]], dtype=torch.float64), torch.empty(0, 2, dtype=torch.long)),
        (torch.zeros(2, 2, dtype=torch.float64), torch.empty(0, 2, dtype=torch.long)),
        (torch.eye(2, dtype=torch.float64), torch.tensor([[0, 2]])),
        (torch.eye(2, dtype=torch.float64), torch.tensor([0, 1])),
        (torch.eye(2, dtype=torch.float64), torch.tensor([[1, 1]])),
        (torch.eye(2, dtype=torch.float64), torch.tensor([[1, 0]])),
        (torch.eye(3, dtype=torch.float64), torch.tensor([[0, 1], [1, 2], [0, 1]])),
    ],
)
def test_a_bad_graph_is_an_error(points, edges):
    with pytest.raises(ParameterError, match="of a graph"):
        TaskGraph(points, edges)


@pytest.mark.parametrize(
    "bounds",
    [
        [0, 1, 0, 1],
        [(0, 1, 2), (0, 1)],
        [(1, -1), (0, 1)],
        [(0, 0), (0, 1)],
        [(0, math.nan), (0, 1)],
        [(0, math.inf), (0, 1)],
        [(0, 1)],
        [],
    ],
)
def test_bad_bounds_are_errors(bounds):
    with pytest.raises(ParameterError, match="low < high"):
        staggered_grid(bounds, 100)


@pytest.mark.parametrize("n", [0, -5, 10**12, True, 2.5, "100"])
def test_bad_counts_are_errors(n):
    with pytest.raises(ParameterError, match="points: got"):
        staggered_grid([(0, 1), (0, 1)], n)


def test_around_and_edge_between_agree_with_the_edges(generator):
    graph = random_graph([(0.0, 1.0)] * 2, 40, k=5, generator=generator)
    vertices = torch.tensor([7, 0, 7, 39])
    rank, others = graph.around(vertices)
    for k, vertex in enumerate(vertices.tolist()):
        touching = graph.edges[(graph.edges == vertex).any(1)]
        expected = touching.sum(1) - vertex
        assert sorted(others[rank == k].tolist()) == sorted(expected.tolist())
    edges = graph.edge_between(vertices[rank], others)
    assert torch.equal(graph.edges[edges], torch.stack([vertices[rank], others], dim=1).sort(dim=1).values)
    nothing = graph.around(vertices[:0])
    assert [len(part) for part in nothing] == [0, 0]
