from __future__ import annotations

import dataclasses
import threading

import numpy as np
import pytest
import torch

import grr_torch
from grr_torch.applications import around, solve
from grr_torch.applications.solve import STATUSES
from grr_torch.errors import ParameterError
from grr_torch.spaces.cliques import triangles
from grr_torch.spaces.configuration import distance


@pytest.fixture(scope="module", params=["planar", "kinova"])
def roadmap(request, planar_roadmap, kinova_roadmap) -> grr_torch.Roadmap:
    return planar_roadmap if request.param == "planar" else kinova_roadmap


def _inside(roadmap: grr_torch.Roadmap, count: int) -> torch.Tensor:
    """Random points of the triangles whose edges are all connected."""
    corners = triangles(roadmap.edges[roadmap.connected], len(roadmap.points))
    generator = torch.Generator().manual_seed(0)
    chosen = corners[torch.randint(len(corners), (count,), generator=generator)]
    weights = -torch.rand(count, 3, 1, dtype=torch.float64, generator=generator).log()
    return (roadmap.points[chosen] * weights).sum(1) / weights.sum(1)


def test_what_is_valid_is_at_its_point_within_limits_and_free(roadmap):
    low, high = roadmap.points.amin(0) - 0.1, roadmap.points.amax(0) + 0.1
    points = low + (high - low) * torch.rand(
        2000, len(low), dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )
    solution = roadmap.solve(points)
    q = solution.configurations[solution.valid]
    robot, task = roadmap.robot, roadmap.task
    position, rotation = robot.forward_kinematics(q)
    residuals = task.residuals(task.error(points[solution.valid].T, position.T, rotation.permute(1, 2, 0)))
    assert 0 < len(q) < len(points)
    assert float(residuals[0].max()) <= 1e-4
    assert len(residuals[1]) == 0 or float(residuals[1].max()) <= 1e-3
    assert bool(robot.within_limits(q).all())
    assert not bool(robot.in_self_collision(q).any())
    assert bool(solution.configurations[~solution.valid].isnan().all())


def test_status_agrees_with_valid(roadmap):
    low, high = roadmap.points.amin(0) - 0.5, roadmap.points.amax(0) + 0.5
    points = low + (high - low) * torch.rand(
        500, len(low), dtype=torch.float64, generator=torch.Generator().manual_seed(2)
    )
    solution = roadmap.solve(points)
    assert set(np.unique(solution.status)) <= set(STATUSES)
    assert np.array_equal(np.isin(solution.status, STATUSES[:2]), solution.valid.numpy())
    outside = ((points < roadmap.points.amin(0)) | (points > roadmap.points.amax(0))).any(1).numpy()
    assert np.array_equal(solution.status == "outside", outside)


def test_at_a_vertex_it_is_the_vertexs_configuration(roadmap):
    vertices = roadmap.resolved.nonzero()[:, 0]
    solution = roadmap.solve(roadmap.points[vertices])
    wraps = roadmap.robot.continuous
    apart = grr_torch.spaces.configuration.distance(solution.configurations, roadmap.configurations[vertices], wraps)
    # but for vertices cut off from most of those around them
    assert float(solution.valid.double().mean()) > 0.95
    assert float((apart[solution.valid] < 1e-6).double().mean()) > 0.95


def test_nearly_all_points_inside_connected_cells_are_solved(roadmap):
    assert float(roadmap.solve(_inside(roadmap, 2000)).valid.double().mean()) >= 0.99


def test_small_moves_of_the_point_are_small_moves_of_the_arm(roadmap):
    points = _inside(roadmap, 1000)
    first, second = roadmap.solve(points), roadmap.solve(points + 1e-6)
    both = first.valid & second.valid & torch.from_numpy((first.status == "solved") & (second.status == "solved"))
    moved = grr_torch.spaces.configuration.distance(
        first.configurations[both], second.configurations[both], roadmap.robot.continuous
    )
    # a projection stops anywhere within its tolerance
    assert float(moved.median()) < 1e-3
    assert float(moved.max()) < 0.05


def test_joints_move_less_along_lines_than_with_weights_of_algorithm_3(roadmap, monkeypatch):
    ends = _inside(roadmap, 200).reshape(100, 2, 1, -1)
    along = torch.linspace(0.0, 1.0, 301, dtype=torch.float64)[:, None]
    lines = ends[:, 0] * (1.0 - along) + ends[:, 1] * along

    def motion() -> tuple[torch.Tensor, torch.Tensor]:
        solution = dataclasses.replace(roadmap).solve(lines)
        q = solution.configurations
        moved = distance(q[:, 1:], q[:, :-1], roadmap.robot.continuous)
        return moved, solution.valid.all(1)

    ours, valid = motion()
    with monkeypatch.context() as patch:
        patch.setattr(around, "_weights", lambda distances, k, _: 1.0 / np.square(np.maximum(distances[:, :k], 1e-12)))
        theirs, also = motion()
    both = valid & also
    assert int(both.sum()) > 10
    assert float(ours[both].sum()) < 0.97 * float(theirs[both].sum())
    assert float(ours[both].amax(1).mean()) < 0.5 * float(theirs[both].amax(1).mean())


@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2)])
def test_batch_shapes_give_the_same_as_one_at_a_time(planar_roadmap, shape):
    points = _inside(planar_roadmap, max(1, int(np.prod(shape)))).reshape(*shape, 2)
    solution = planar_roadmap.solve(points)
    assert solution.configurations.shape == (*shape, 5)
    assert solution.valid.shape == solution.status.shape == shape
    for index in np.ndindex(shape):
        alone = planar_roadmap.solve(points[index])
        assert torch.allclose(alone.configurations, solution.configurations[index], atol=1e-9, equal_nan=True)
        assert alone.status == solution.status[index]


def test_many_points_give_the_same_on_any_number_of_threads(roadmap, monkeypatch, generator):
    monkeypatch.setattr(solve, "_AT_ONCE", 500)
    whole, workers = solve.Solver.solve_columns, []

    def noted(self, columns):
        workers.append(threading.get_ident())
        return whole(self, columns)

    monkeypatch.setattr(solve.Solver, "solve_columns", noted)
    low, high = roadmap.positions.amin(0), roadmap.positions.amax(0)
    points = low + (high - low) * torch.rand(1777, roadmap.task.width, dtype=torch.float64, generator=generator)
    threads, seen, solutions, met = torch.get_num_threads(), [], [], []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            solutions.append(roadmap.solver(points, progress=lambda _, done, total: seen.append((done, total))))
            assert torch.get_num_threads() == count
            met.append(set(workers))
            workers.clear()
    finally:
        torch.set_num_threads(threads)
    assert threading.get_ident() not in met[1], "three threads of its own"
    assert 1 <= len(met[1]) <= 3
    assert seen == 2 * [(done, 1777) for done in (0, 500, 1000, 1500, 1777)]
    one, many = solutions
    assert torch.equal(one.configurations.nan_to_num(9.0), many.configurations.nan_to_num(9.0))
    assert (one.status == many.status).all()
    assert len(np.unique(one.status)) > 1


def test_an_error_in_a_part_of_many_points_is_not_lost(roadmap, monkeypatch):
    monkeypatch.setattr(solve, "_AT_ONCE", 10)
    whole = solve.Solver.solve_columns

    def fails(self, columns):
        if bool((columns == 0.25).all()):
            raise RuntimeError("of a part")
        return whole(self, columns)

    monkeypatch.setattr(solve.Solver, "solve_columns", fails)
    points = torch.full((60, roadmap.task.width), 0.3, dtype=torch.float64)
    points[20:30] = 0.25
    threads = torch.get_num_threads()
    with pytest.raises(RuntimeError, match="of a part"):
        roadmap.solve(points)
    assert torch.get_num_threads() == threads


def test_no_points_give_no_configurations(planar_roadmap):
    assert planar_roadmap.solve(torch.empty(0, 2, dtype=torch.float64)).configurations.shape == (0, 5)


def test_vertices_cut_off_from_the_others_do_not_count(planar_roadmap):
    """A neighbour with an unrelated configuration whose edges are all broken changes nothing."""
    from dataclasses import replace

    points = _inside(planar_roadmap, 300)
    vertex = planar_roadmap.solver.nearest(points[:1])[1][0, 0]
    configurations = planar_roadmap.configurations.clone()
    configurations[vertex] += 2.0
    away = planar_roadmap.connected & ~(planar_roadmap.edges == vertex).any(1)
    spoilt = replace(planar_roadmap, configurations=configurations, connected=away)
    removed = replace(planar_roadmap, connected=away)
    for point in points[(points - planar_roadmap.points[vertex]).norm(dim=1) > 1e-3][:5]:
        first, second = spoilt.solve(point), removed.solve(point)
        assert torch.allclose(first.configurations, second.configurations, atol=1e-9, equal_nan=True)


def test_points_in_uncertified_cells_say_so(kinova_roadmap):
    triangles_, _ = kinova_roadmap.uncertified
    assert len(triangles_)
    centres = kinova_roadmap.points[triangles_].mean(1)
    solution = kinova_roadmap.solve(centres)
    assert set(np.unique(solution.status[solution.valid.numpy()])) == {"uncertified"}
    certified = kinova_roadmap.cells()[0]
    inner = certified.corners[certified.certified]
    share = (kinova_roadmap.solve(kinova_roadmap.points[inner].mean(1)).status == "solved").mean()
    # a certified triangle may bound a pyramid that another cell spoils
    assert share > 0.9


def test_points_whose_cell_lacks_a_corner_are_uncertified(roadmap):
    """As the differentiable map has it, but where what it knows of parts counts."""
    missing = int(roadmap.resolved.nonzero()[len(roadmap.resolved.nonzero()) // 2])
    resolved = roadmap.resolved.clone()
    resolved[missing] = False
    broken = roadmap.connected & (roadmap.edges != missing).all(1)
    q = roadmap.configurations.clone()
    q[missing] = torch.nan
    without = dataclasses.replace(roadmap, resolved=resolved, configurations=q, connected=broken)
    ends = roadmap.edges[roadmap.connected & (roadmap.edges == missing).any(1)]
    beside = roadmap.points[ends].mean(1)
    before, after = roadmap.solve(beside), without.solve(beside)
    both = (before.valid & after.valid).numpy()
    assert both.sum() >= 2
    assert "solved" in before.status[both]
    assert set(after.status[both]) == {"uncertified"}
    far = (roadmap.points - roadmap.points[missing]).norm(dim=1) > 2.0 * roadmap.longest_edge
    vertices = roadmap.points[far & resolved]
    assert np.array_equal(roadmap.solve(vertices).status, without.solve(vertices).status)


def test_points_beside_a_broken_edge_are_uncertified(roadmap):
    """So are they in all that would be cells, were the edge not broken; far from it nothing changes."""
    corners = roadmap.cells()[0].corners
    centres = roadmap.points[corners].mean(1)
    before = roadmap.solve(centres)
    first, second = corners[(before.status == "solved").nonzero()[0][0]][:2]
    broken = (roadmap.edges == torch.stack([first, second])).all(1)
    after = dataclasses.replace(roadmap, connected=roadmap.connected & ~broken).solve(centres)
    at_edge = torch.isin(corners, torch.stack([first, second])).sum(1) == 2
    assert int(broken.sum()) == 1
    assert bool(at_edge.any())
    assert set(after.status[(at_edge & before.valid).numpy()]) == {"uncertified"}
    away = (centres - roadmap.points[first]).norm(dim=1) > 2.0 * roadmap.longest_edge
    assert (after.status == before.status)[away.numpy()].all()


def test_random_graphs_solve_too(planar_5):
    graph = grr_torch.random_graph([(-0.9, 0.9), (-0.9, 0.9)], 250, k=8, generator=torch.Generator().manual_seed(0))
    roadmap = grr_torch.build(planar_5, "position", points=graph, refine=False)
    assert float(roadmap.solve(_inside(roadmap, 300)).valid.double().mean()) > 0.95


@pytest.mark.parametrize(
    ("points", "what"),
    [
        (torch.tensor([float("nan"), 0.0]), "finite"),
        (torch.zeros(4, 3), "shape"),
        (torch.tensor(1.0), "shape"),
        ([0.1, 0.2], "tensor"),
    ],
)
def test_bad_points_are_refused(planar_roadmap, points, what):
    with pytest.raises(ParameterError, match=what):
        planar_roadmap.solve(points)


def test_a_roadmap_without_a_resolved_vertex_is_refused(planar_roadmap):
    from dataclasses import replace

    empty = replace(
        planar_roadmap,
        resolved=torch.zeros_like(planar_roadmap.resolved),
        connected=torch.zeros_like(planar_roadmap.connected),
        configurations=torch.full_like(planar_roadmap.configurations, torch.nan),
    )
    with pytest.raises(ParameterError, match="resolved vertex"):
        empty.solve(torch.zeros(2, dtype=torch.float64))


@pytest.mark.filterwarnings("error")
def test_points_beyond_all_numbers_are_outside(planar_roadmap):
    points = torch.tensor([[1e300, 0.0], [1e200, 1e308], [-1e154, 1e154]], dtype=torch.float64)
    solution = planar_roadmap.solve(points)
    assert solution.status.tolist() == ["outside"] * 3
    assert not bool(solution.valid.any())
