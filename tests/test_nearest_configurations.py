"""What the differentiable map is made of: nearest configurations, derivatives of forces, weights in pyramids."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from random_robots import random_urdf

import grr_torch
from grr_torch.applications.nearest import Manifolds, MovedBy
from grr_torch.robots.curvature import force_derivative
from grr_torch.spaces.configuration import distance
from grr_torch.spaces.pyramids import pyramid_corners, pyramid_weights, whole_pyramids


@pytest.mark.parametrize("mimic", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_force_derivative_is_that_of_finite_differences(tmp_path, seed, mimic):
    (tmp_path / "arm.urdf").write_text(random_urdf(np.random.default_rng(seed), 7, branches=True, mimic=mimic))
    robot = grr_torch.load_robot(tmp_path / "arm.urdf", tool="tool")
    generator = torch.Generator().manual_seed(seed)
    q = robot.sample(5, generator).T.contiguous()
    wrench = torch.randn(6, 5, dtype=torch.float64, generator=generator)
    found = force_derivative(robot.tree, robot.tree.frames(q), wrench)

    def torques(q):
        return (robot.tree.jacobian(robot.tree.frames(q)) * wrench[:, None]).sum(0)

    for joint, step in enumerate(1e-6 * torch.eye(robot.n, dtype=torch.float64)[..., None]):
        torch.testing.assert_close(found[:, joint], (torques(q + step) - torques(q - step)) / 2e-6, atol=1e-7, rtol=0)


def _nearest(robot, task, generator, spread=0.15):
    """Random configurations, the points of others beside them, and what is nearest to them there."""
    aims = robot.sample(200, generator)
    averages = aims + spread * torch.randn(aims.shape, dtype=torch.float64, generator=generator)
    averages = averages.clamp(robot.lower, robot.upper)
    targets = robot.forward_kinematics(aims)[0].T[: task.dimension].contiguous()
    start, reached = grr_torch.project(robot, task, targets.T, averages, check_collision=False)
    kept = reached & (distance(start, averages, robot.continuous) < 1.0)
    averages, targets, start = averages[kept], targets[:, kept], start[kept]
    found = Manifolds(robot, task).nearest(averages.T.contiguous(), targets, start.T.contiguous())
    return averages, targets, found


@pytest.mark.parametrize("narrow", [False, True])
@pytest.mark.parametrize("name", ["planar_5", "kinova"])
def test_no_configuration_beside_the_nearest_is_nearer(name, narrow, generator):
    """On its self-motion manifold, and within limits; with narrow ones many joints are held there."""
    robot = grr_torch.load_robot(name)
    if narrow:
        robot = replace(robot, lower=torch.full_like(robot.lower, -1.0), upper=torch.full_like(robot.upper, 1.2))
        robot = replace(robot, continuous=torch.zeros_like(robot.continuous))
    task = grr_torch.Position(2 if name == "planar_5" else 3)
    averages, targets, found = _nearest(robot, task, generator)
    averages, targets = averages[found.valid], targets[:, found.valid]
    q, held = found.q.T[found.valid], found.held.T[found.valid]
    assert float(found.valid.double().mean()) > 0.9
    assert bool(held.any(1).double().mean() > 0.1) == narrow
    assert bool(robot.within_limits(q, 0.0).all())
    for _ in range(10):
        beside = q + 0.03 * torch.randn(q.shape, dtype=torch.float64, generator=generator)
        tight = grr_torch.Tolerances(position=1e-10)
        beside, reached = grr_torch.project(
            robot, task, targets.T, beside.clamp(robot.lower, robot.upper), tolerances=tight, check_collision=False
        )
        farther = distance(averages, beside, robot.continuous) - distance(averages, q, robot.continuous)
        assert float(reached.double().mean()) > 0.9
        assert float(farther[reached].min()) > -1e-8


def test_gradients_are_right_where_joints_are_held_at_limits(kinova, generator):
    narrow = replace(kinova, lower=torch.full_like(kinova.lower, -1.0), upper=torch.full_like(kinova.upper, 1.2))
    narrow = replace(narrow, continuous=torch.zeros_like(kinova.continuous))
    task = grr_torch.Position(3)
    averages, targets, found = _nearest(narrow, task, generator)
    # not where the set of held joints changes
    manifolds = Manifolds(narrow, task)
    room = torch.minimum(narrow.upper[:, None] - found.q, found.q - narrow.lower[:, None]).where(~found.held, torch.inf)
    kept = (found.valid & found.held.any(0) & (room.amin(0) > 1e-3)).nonzero()[:10, 0]
    assert len(kept) == 10

    def moved(averages, targets):
        nearest = manifolds.nearest(averages.detach(), targets.detach(), found.q[:, kept].clone())
        return MovedBy.apply(averages, targets, manifolds, nearest)

    inputs = averages.T[:, kept].contiguous().requires_grad_(), targets[:, kept].contiguous().requires_grad_()
    assert torch.autograd.gradcheck(moved, inputs)


@pytest.mark.parametrize("bounds", [[(-1.0, 1.0), (-1.0, 0.5)], [(-1.0, 1.0), (-1.0, 0.5), (0.0, 1.0)]])
def test_weights_of_pyramids_give_back_the_point(bounds):
    graph = grr_torch.staggered_grid(bounds, 400)
    lattice, low = graph.lattice, graph.points.amin(0)
    sides = torch.tensor(bounds, dtype=torch.float64)
    drawn = torch.rand(500, len(bounds), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    points = torch.cat([sides[:, 0] + (sides[:, 1] - sides[:, 0]) * drawn, graph.points])
    pyramids = lattice.pyramids(points - low)
    weights = pyramid_weights(lattice, points - low, pyramids)
    corners = pyramid_corners(lattice)
    some = torch.randperm(len(corners), generator=torch.Generator().manual_seed(1))[:50]
    assert torch.equal(pyramid_corners(lattice, some), corners[some])
    counts = torch.rand(len(graph.points), generator=torch.Generator().manual_seed(2)) < 0.8
    assert torch.equal(whole_pyramids(lattice, counts), counts[corners].all(1))
    assert corners.shape == (2 * len(bounds) * math.prod(lattice.cells), 3 if len(bounds) == 2 else 5)
    assert float(weights.min()) > -1e-12
    torch.testing.assert_close(weights.sum(1), torch.ones_like(weights[:, 0]))
    torch.testing.assert_close((graph.points[corners[pyramids]] * weights[..., None]).sum(1), points)
