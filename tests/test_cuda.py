"""The same code on a GPU: kernels equal to tolerance, roadmaps of equal quality. Skipped where there is none."""

from __future__ import annotations

import pytest
import torch

import grr_torch
from grr_torch.spaces.task import FixedRotation

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device is available")


@pytest.fixture(scope="module")
def arms():
    return grr_torch.load_robot("kinova"), grr_torch.load_robot("kinova", device="cuda")


@pytest.mark.parametrize("count", [1, 10, 5000])
def test_kernels_are_equal(arms, generator, count):
    cpu, cuda = arms
    q = cpu.sample(count, generator)
    for expected, found in zip(cpu.pose_and_jacobian(q), cuda.pose_and_jacobian(q.cuda()), strict=True):
        assert found.device.type == "cuda"
        torch.testing.assert_close(found.cpu(), expected, atol=1e-12, rtol=0)
    distances = cpu.self_collision_distance(q)
    torch.testing.assert_close(cuda.self_collision_distance(q.cuda()).cpu(), distances, atol=1e-12, rtol=0)
    clear = (distances - cpu.margin).abs() > 1e-9
    assert torch.equal(cuda.in_self_collision(q.cuda()).cpu()[clear], cpu.in_self_collision(q)[clear])


def test_projections_end_at_the_same_configurations(arms, generator):
    cpu, cuda = arms
    task = FixedRotation(3, (3.0, 0.0, 0.0))
    q = cpu.sample(500, generator)
    points = torch.tensor([0.4, 0.1, 0.3], dtype=torch.float64).expand(500, 3)
    expected, valid = grr_torch.project(cpu, task, points, q)
    found, also = grr_torch.project(cuda, task, points.cuda(), q.cuda())
    assert (also.cpu() == valid).double().mean() > 0.99
    both = valid & also.cpu()
    difference = grr_torch.spaces.configuration.distance(found.cpu()[both], expected[both], cpu.continuous)
    assert (difference < 1e-6).double().mean() > 0.99


@pytest.mark.parametrize("robot", ["planar_5", "kinova"])
@pytest.mark.parametrize("task", ["position", "fixed-rotation"])
def test_roadmaps_are_as_good(robot, task):
    expected, found = (
        grr_torch.build(grr_torch.load_robot(robot, device=device), task).quality() for device in ("cpu", "cuda")
    )
    assert found.resolved_vertices == pytest.approx(expected.resolved_vertices, rel=0.005)
    assert found.connected_edges == pytest.approx(expected.connected_edges, rel=0.005)
    assert found.smoothness == pytest.approx(expected.smoothness, rel=0.01)
    assert found.self_collisions in (None, 0)
