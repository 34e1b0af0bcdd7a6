from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import torch

import grr_torch
from grr_torch.errors import ParameterError
from grr_torch.spaces.configuration import difference, distance
from grr_torch.spaces.pyramids import pyramid_corners, pyramid_weights


@pytest.fixture(scope="module")
def roadmaps(planar_roadmap, planar_5, kinova) -> dict[str, grr_torch.Roadmap]:
    return {
        "planar position": planar_roadmap,
        "planar fixed-rotation": grr_torch.build(planar_5, "fixed-rotation", points=400, refine=False),
        "kinova position": grr_torch.build(kinova, "position", points=1200, refine=False),
        "kinova fixed-rotation": grr_torch.build(kinova, "fixed-rotation", refine=False),
    }


@pytest.fixture(
    params=["planar position", "planar fixed-rotation", "kinova position", "kinova fixed-rotation"], scope="module"
)
def roadmap(request, roadmaps) -> grr_torch.Roadmap:
    return roadmaps[request.param]


def _drawn(roadmap: grr_torch.Roadmap, count: int, seed: int = 0) -> torch.Tensor:
    """Points of all that the vertices with a configuration span."""
    points = roadmap.points[roadmap.resolved]
    low, high = points.amin(0), points.amax(0)
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(count, len(low), dtype=torch.float64, generator=generator)


def _certified(roadmap: grr_torch.Roadmap, count: int) -> torch.Tensor:
    """Points inside certified cells, not at their borders."""
    points = _drawn(roadmap, 60 * count)
    lattice, offsets = roadmap.graph.lattice, points - roadmap.points.amin(0)
    inner = pyramid_weights(lattice, offsets, lattice.pyramids(offsets)).amin(1) > 1e-3
    points = points[inner]
    return points[roadmap.solve(points, differentiable=True).status == "solved"][:count]


def test_gradients_are_those_of_finite_differences_inside_certified_cells(roadmap):
    points = _certified(roadmap, 25).requires_grad_()
    assert len(points) == 25

    def configurations(p):
        return roadmap.solve(p, differentiable=True).configurations

    assert torch.autograd.gradcheck(configurations, points)


def test_the_tool_follows_the_point(roadmap):
    """J · ∂q/∂p is the identity, and above it the rotation stands still."""
    points = _certified(roadmap, 200).requires_grad_()
    q = roadmap.solve(points, differentiable=True).configurations
    rows = [torch.autograd.grad(q[:, j].sum(), points, retain_graph=True)[0] for j in range(q.shape[1])]
    moved = roadmap.robot.jacobian(q.detach()) @ torch.stack(rows, dim=1)
    moved = roadmap.task.jacobian(moved.permute(1, 2, 0))
    assert torch.allclose(
        moved, torch.eye(*moved.shape[:2], dtype=torch.float64)[..., None].expand_as(moved), atol=1e-8
    )


def test_what_is_valid_is_at_its_point_within_limits_and_free(roadmap):
    points = _drawn(roadmap, 3000)
    solution = roadmap.solve(points, differentiable=True)
    q = solution.configurations[solution.valid]
    position, rotation = roadmap.robot.forward_kinematics(q)
    error = roadmap.task.error(points[solution.valid].T, position.T, rotation.permute(1, 2, 0))
    assert 0 < len(q) < len(points)
    assert float(error.abs().max()) <= 1e-10
    assert bool(roadmap.robot.within_limits(q, 0.0).all())
    assert not bool(roadmap.robot.in_self_collision(q).any())
    assert bool(solution.configurations[~solution.valid].isnan().all())
    assert np.array_equal(np.isin(solution.status, ["solved", "uncertified"]), solution.valid.numpy())


def test_it_solves_nearly_all_that_the_map_solves_and_lies_near_it(roadmap):
    points = _drawn(roadmap, 4000)
    first, second = roadmap.solve(points), roadmap.solve(points, differentiable=True)
    assert float(second.valid[first.valid].double().mean()) > 0.97
    both = first.valid & torch.from_numpy(second.status == "solved")
    apart = distance(first.configurations[both], second.configurations[both], roadmap.robot.continuous)
    assert float(apart.median()) < 0.03
    assert float(apart.quantile(0.99)) < 0.4


def test_at_a_vertex_it_is_the_vertexs_configuration(roadmap):
    vertices = roadmap.resolved.nonzero()[:, 0]
    solution = roadmap.solve(roadmap.points[vertices], differentiable=True)
    certified = torch.from_numpy(solution.status == "solved")
    apart = distance(solution.configurations, roadmap.configurations[vertices], roadmap.robot.continuous)
    assert bool(certified.any())
    # as near as the vertices are to their points, but for a straight arm
    assert float((apart[certified] < 2e-3).double().mean()) > 0.98


def test_there_is_no_jump_between_certified_cells(roadmap):
    """Lines between points of different cells, bisected down to the border."""
    lattice, low = roadmap.graph.lattice, roadmap.points.amin(0)
    start = _drawn(roadmap, 4000, 1)
    end = start + 0.02 * (_drawn(roadmap, 4000, 2) - start)
    cell = lattice.pyramids(start - low)
    crossing = lattice.pyramids(end - low) != cell
    start, end, cell = start[crossing], end[crossing], cell[crossing]
    for _ in range(45):
        middle = 0.5 * (start + end)
        before = (lattice.pyramids(middle - low) == cell)[:, None]
        start, end = torch.where(before, middle, start), torch.where(before, end, middle)
    first, second = (roadmap.solve(p, differentiable=True) for p in (start, end))
    both = torch.from_numpy((first.status == "solved") & (second.status == "solved"))
    apart = distance(first.configurations[both], second.configurations[both], roadmap.robot.continuous)
    assert len(apart) > 30
    assert float(apart.max()) < 1e-8


def test_there_is_no_jump_inside_certified_cells(roadmap):
    """Half the step along a line inside a cell is half the step of the arm."""
    lattice, low, corners = roadmap.graph.lattice, roadmap.points.amin(0), pyramid_corners(roadmap.graph.lattice)
    points = _certified(roadmap, 40)
    start, end = (
        torch.lerp(points, roadmap.points[corners[lattice.pyramids(points - low)]].mean(1), at) for at in (0.05, 0.95)
    )
    longest = []
    for count in (65, 129):
        line = start + (end - start) * torch.linspace(0.0, 1.0, count, dtype=torch.float64)[:, None, None]
        q = roadmap.solve(line, differentiable=True).configurations
        longest.append(distance(q[:-1], q[1:], roadmap.robot.continuous).amax(0))
    assert float((longest[1] / longest[0]).max()) < 0.6


def test_points_that_are_not_valid_have_no_gradient_and_spoil_none(roadmaps):
    roadmap = roadmaps["planar position"]
    good = _certified(roadmap, 5)
    points = torch.cat([good, torch.full((1, 2), 9.0, dtype=torch.float64)]).requires_grad_()
    solution = roadmap.solve(points, differentiable=True)
    solution.configurations.square().sum().backward()
    alone = good.clone().requires_grad_()
    roadmap.solve(alone, differentiable=True).configurations.square().sum().backward()
    assert solution.status[-1] == "outside"
    assert torch.equal(points.grad[-1], torch.zeros(2, dtype=torch.float64))
    assert torch.allclose(points.grad[:-1], alone.grad)
    assert bool((alone.grad != 0.0).any())


@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2), (0,)])
def test_batch_shapes_give_the_same_as_one_at_a_time(planar_roadmap, shape):
    points = _drawn(planar_roadmap, int(np.prod(shape))).reshape(*shape, 2).requires_grad_()
    solution = planar_roadmap.solve(points, differentiable=True)
    solution.configurations.nansum().backward()
    assert solution.configurations.shape == (*shape, 5)
    assert solution.valid.shape == solution.status.shape == shape
    for index in np.ndindex(shape):
        point = points[index].detach().requires_grad_()
        alone = planar_roadmap.solve(point, differentiable=True)
        alone.configurations.nansum().backward()
        assert torch.allclose(alone.configurations, solution.configurations[index], atol=1e-9, equal_nan=True)
        assert torch.allclose(point.grad, points.grad[index], atol=1e-6)
        assert alone.status == solution.status[index]


def test_cells_that_are_not_whole_say_so(planar_roadmap):
    """A broken edge or a missing corner leaves a cell uncertified; where no corner counts there is none."""
    points = _certified(planar_roadmap, 300)
    edge = planar_roadmap.edges[planar_roadmap.connected][40]
    connected = planar_roadmap.connected & ~(planar_roadmap.edges == edge).all(1)
    broken = replace(planar_roadmap, connected=connected)
    middle = planar_roadmap.points[edge].mean(0)
    assert str(planar_roadmap.solve(middle, differentiable=True).status) == "solved"
    assert str(broken.solve(middle, differentiable=True).status) == "uncertified"
    vertex = edge[0]
    resolved = planar_roadmap.resolved.clone()
    resolved[vertex] = False
    configurations = torch.where(resolved[:, None], planar_roadmap.configurations, torch.nan)
    connected = planar_roadmap.connected & ~(planar_roadmap.edges == vertex).any(1)
    missing = replace(planar_roadmap, resolved=resolved, configurations=configurations, connected=connected)
    assert str(missing.solve(planar_roadmap.points[vertex], differentiable=True).status) == "no cell"
    beside = torch.lerp(planar_roadmap.points[vertex], planar_roadmap.points[edge[1]], 0.6)
    assert str(missing.solve(beside, differentiable=True).status) == "uncertified"
    assert (missing.solve(points, differentiable=True).status == "solved").sum() < len(points)


def test_a_second_derivative_is_refused(planar_roadmap):
    points = _certified(planar_roadmap, 3).requires_grad_()
    q = planar_roadmap.solve(points, differentiable=True).configurations
    (gradient,) = torch.autograd.grad(q.square().sum(), points, create_graph=True)
    with pytest.raises(ParameterError, match="differentiated once"):
        torch.autograd.grad(gradient.sum(), points)


@dataclass(frozen=True)
class _Turning(grr_torch.Position):
    """Another task, of which nothing is known."""

    kind: ClassVar[str] = "turning"


def test_what_cannot_be_differentiated_is_refused(planar_roadmap, planar_5):
    points = torch.zeros(2, dtype=torch.float64)
    graph = grr_torch.random_graph([(-0.9, 0.9), (-0.9, 0.9)], 120, k=8, generator=torch.Generator().manual_seed(0))
    scattered = grr_torch.build(planar_5, "position", points=graph, refine=False)
    with pytest.raises(ParameterError, match="staggered grid"):
        scattered.solve(points, differentiable=True)
    with pytest.raises(ParameterError, match="float64"):
        replace(planar_roadmap, robot=grr_torch.load_robot("planar_5", dtype=torch.float32)).solve(
            points, differentiable=True
        )
    with pytest.raises(ParameterError, match="fixed-rotation"):
        replace(planar_roadmap, task=_Turning(2)).solve(points, differentiable=True)
    with pytest.raises(ParameterError, match="finite"):
        planar_roadmap.solve(points * torch.nan, differentiable=True)


def _length(roadmap, points):
    """What the joints move along points (*batch, K, width), all of them valid [rad]."""
    solution = roadmap.solve(points, differentiable=True)
    assert bool(solution.valid.all())
    q = solution.configurations
    return distance(q[..., :-1, :], q[..., 1:, :], roadmap.robot.continuous).sum(-1)


def test_a_task_path_moves_to_where_its_joint_path_is_shorter(roadmaps):
    """A circle of the hand, moved as a whole by gradient descent."""
    roadmap = roadmaps["kinova position"]
    angle = torch.linspace(0.0, 2.0 * torch.pi, 41, dtype=torch.float64)
    circle = 0.1 * torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=1)
    centre = torch.tensor([0.35, 0.3, 0.35], dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([centre], lr=0.01)
    lengths = []
    for _ in range(25):
        optimizer.zero_grad()
        length = _length(roadmap, circle + centre)
        length.backward()
        optimizer.step()
        lengths.append(length.item())
    # once round, the arm is back at the first configuration
    q = roadmap.solve(circle + centre.detach(), differentiable=True).configurations
    assert float(difference(q[0], q[-1], roadmap.robot.continuous).norm()) < 1e-9
    assert lengths[-1] < 0.9 * lengths[0]


def test_a_base_moves_to_where_a_set_of_poses_is_cheap(roadmaps):
    """Joint travel on a tour, as a function of where the arm stands in the plane and how it is turned."""
    roadmap = roadmaps["planar position"]
    tour = torch.tensor([[0.25, 0.05], [0.3, 0.15], [0.2, 0.2], [0.15, 0.12]], dtype=torch.float64)
    tour = torch.cat([tour, tour[:1]])
    base = torch.tensor([0.05, 0.03, 0.1], dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([base], lr=0.01)
    costs = []
    for _ in range(25):
        optimizer.zero_grad()
        cosine, sine = base[2].cos(), base[2].sin()
        rotation = torch.stack([torch.stack([cosine, -sine]), torch.stack([sine, cosine])])
        cost = _length(roadmap, (tour - base[:2]) @ rotation)
        cost.backward()
        optimizer.step()
        costs.append(cost.item())
    assert costs[-1] < 0.9 * costs[0]
