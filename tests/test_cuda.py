"""The same code on a GPU: kernels equal to tolerance, roadmaps of equal quality. Skipped where there is none."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import grr_torch
from grr_torch.errors import ParameterError
from grr_torch.learning.dataset import RoadmapDataset
from grr_torch.learning.export import export_dataset
from grr_torch.learning.neural_ik import NeuralIK
from grr_torch.learning.onnx import export_torch
from grr_torch.learning.options import TrainingOptions
from grr_torch.learning.train import train_ik
from grr_torch.resolution.verify import verify_file
from grr_torch.spaces.configuration import difference
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


@pytest.mark.parametrize(("robot", "task"), [("planar_5", "fixed-rotation"), ("kinova", "position")])
def test_what_was_built_on_a_gpu_is_verified_anywhere(robot, task, tmp_path):
    path = tmp_path / "roadmap.grr"
    grr_torch.build(grr_torch.load_robot(robot, device="cuda"), task).save(path)
    assert all(check.passed for check in verify_file(path))
    loaded = grr_torch.Roadmap.load(path)
    assert loaded.robot.device.type == loaded.configurations.device.type == "cpu"


@pytest.mark.parametrize(
    ("robot", "task", "size"),
    [("planar_5", "pose", {"points": 300, "rotations": 6}), ("kinova", "yaw", {"points": 500, "rotations": 6})],
)
def test_roadmaps_of_turning_tools_are_as_good(robot, task, size):
    expected, found = (
        grr_torch.build(grr_torch.load_robot(robot, device=device), task, **size).quality()
        for device in ("cpu", "cuda")
    )
    assert found.resolved_vertices == pytest.approx(expected.resolved_vertices, rel=0.01)
    assert found.connected_edges == pytest.approx(expected.connected_edges, rel=0.01)
    assert found.smoothness == pytest.approx(expected.smoothness, rel=0.02)


def test_a_build_that_would_not_fit_the_gpu_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device=None: (100 << 20, 1 << 36))
    with pytest.raises(ParameterError, match="on the GPU"):
        grr_torch.build(grr_torch.load_robot("kinova", device="cuda"), "position", points=300_000)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("cuda") / "planar.grr"
    grr_torch.build(grr_torch.load_robot("planar_5"), "position", points=300).save(path)
    return path


@pytest.mark.parametrize("count", [1, 500, 5000])
def test_points_are_solved_alike(file, generator, count):
    cpu, cuda = (grr_torch.Roadmap.load(file, device=device) for device in ("cpu", "cuda"))
    points = cpu.points.amax(0) * (2.2 * torch.rand(count, 2, dtype=torch.float64, generator=generator) - 1.1)
    expected, found = cpu.solve(points), cuda.solve(points.cuda())
    assert found.configurations.device.type == found.valid.device.type == "cuda"
    assert (found.status == expected.status).mean() > 0.99
    both = expected.valid & found.valid.cpu()
    torch.testing.assert_close(
        found.configurations.cpu()[both], expected.configurations[both], atol=1e-6, rtol=0, check_device=False
    )
    assert bool(found.configurations[~found.valid].isnan().all())


def test_points_of_turning_tools_are_solved_alike(tmp_path, generator):
    path = tmp_path / "pose.grr"
    grr_torch.build(grr_torch.load_robot("planar_5"), "pose", points=200, rotations=6).save(path)
    cpu, cuda = (grr_torch.Roadmap.load(path, device=device) for device in ("cpu", "cuda"))
    points = 0.8 * (torch.rand(1000, 3, dtype=torch.float64, generator=generator) - 0.5)
    expected, found = cpu.solve(points), cuda.solve(points)
    assert (found.status == expected.status).mean() > 0.99
    both = expected.valid & found.valid.cpu()
    assert int(both.sum()) > 100
    torch.testing.assert_close(found.configurations.cpu()[both], expected.configurations[both], atol=1e-6, rtol=0)


def test_training_ends_as_well_and_its_file_is_read_anywhere(file, tmp_path, generator):
    cpu, cuda = (grr_torch.Roadmap.load(file, device=device) for device in ("cpu", "cuda"))
    options = TrainingOptions(samples=5000, epochs=6, batch=256)
    expected, found = train_ik(cpu, options), train_ik(cuda, options, out=tmp_path / "ik.safetensors")
    assert found.network.last.weight.device.type == "cuda"
    assert found.origin.training["validation"] == pytest.approx(expected.origin.training["validation"], rel=0.5)
    points = RoadmapDataset(cpu, 2000).points
    again = NeuralIK.load(tmp_path / "ik.safetensors", cpu.robot)
    apart = difference(found(points.cuda()).cpu(), again(points), cpu.robot.continuous).abs()
    assert (apart < 1e-3).double().mean() > 0.99
    export_torch(found.network, found.origin, tmp_path / "ik.pt2")
    assert found.network.last.weight.device.type == "cuda"
    _, valid = found.refine(points.cuda(), 3)
    assert valid.device.type == "cuda"
    assert (valid.cpu() == again.refine(points, 3)[1]).double().mean() > 0.99


def test_training_is_taken_up_on_the_device(file, tmp_path):
    cuda = grr_torch.Roadmap.load(file, device="cuda")
    options = TrainingOptions(samples=2000, epochs=4, batch=256)

    def stop(epoch):
        if epoch.epoch == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_ik(cuda, options, out=tmp_path / "ik.safetensors", on_epoch=stop)
    resumed = train_ik(cuda, options, out=tmp_path / "ik.safetensors", resume=True)
    whole = train_ik(cuda, options)
    assert resumed.origin.training["validation"] == pytest.approx(whole.origin.training["validation"], rel=0.2)


def test_data_sets_are_alike(file, tmp_path):
    tables = []
    for device in ("cpu", "cuda"):
        out = tmp_path / f"{device}.npz"
        export_dataset(grr_torch.Roadmap.load(file, device=device), out, 2000, jacobians=True)
        with np.load(out) as table:
            tables.append({name: table[name] for name in ("points", "configurations", "valid", "jacobians")})
    both = tables[0]["valid"] & tables[1]["valid"]
    assert both.mean() > 0.99
    for name in ("points", "configurations", "jacobians"):
        np.testing.assert_allclose(tables[0][name][both], tables[1][name][both], atol=1e-6)


def test_checkpoints_are_taken_up_on_the_device(tmp_path):
    robot = grr_torch.load_robot("planar_5", device="cuda")
    whole = grr_torch.build(robot, "position", points=300, checkpoint=tmp_path / "kept")
    resumed = grr_torch.build(robot, "position", points=300, checkpoint=tmp_path / "kept", resume=True)
    torch.testing.assert_close(resumed.configurations, whole.configurations, equal_nan=True, atol=0, rtol=0)
