"""The same code on a GPU: kernels equal to tolerance, roadmaps of equal quality, few transfers.

It runs on a real GPU where there is one, and else on a device that stands in for it: what is done there is done on the
CPU, but tensors that are not where they belong are an error, and transfers are counted.
"""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest
import stand_in_device
import torch

import grr_torch
from grr_torch.errors import ParameterError
from grr_torch.learning.dataset import RoadmapDataset
from grr_torch.learning.export import export_dataset
from grr_torch.learning.neural_ik import NeuralIK
from grr_torch.learning.onnx import export_torch
from grr_torch.learning.options import TrainingOptions
from grr_torch.learning.train import train_ik
from grr_torch.projection.project import Tolerances
from grr_torch.resolution import repair
from grr_torch.resolution.verify import verify_file
from grr_torch.spaces.configuration import difference
from grr_torch.spaces.task import FixedRotation

STAND_IN = stand_in_device.NAME
without_cuda = pytest.mark.skipif(not stand_in_device.AVAILABLE, reason="a GPU is there, or torch has no stand-in")
needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device is available")


@pytest.fixture(params=[pytest.param("cuda", marks=needs_cuda), pytest.param(STAND_IN, marks=without_cuda)])
def gpu(request):
    """The name of a device that is not the CPU."""
    with stand_in_device.stand_in() if request.param == STAND_IN else nullcontext():
        yield request.param


@pytest.fixture
def arms(gpu):
    return grr_torch.load_robot("kinova"), grr_torch.load_robot("kinova", device=gpu)


@pytest.mark.parametrize("count", [1, 10, 5000])
def test_kernels_are_equal(gpu, arms, generator, count):
    cpu, there = arms
    q = cpu.sample(count, generator)
    for expected, found in zip(cpu.pose_and_jacobian(q), there.pose_and_jacobian(q.to(gpu)), strict=True):
        assert found.device.type == gpu
        torch.testing.assert_close(found.cpu(), expected, atol=1e-12, rtol=0)
    distances = cpu.self_collision_distance(q)
    torch.testing.assert_close(there.self_collision_distance(q.to(gpu)).cpu(), distances, atol=1e-12, rtol=0)
    clear = (distances - cpu.margin).abs() > 1e-9
    assert torch.equal(there.in_self_collision(q.to(gpu)).cpu()[clear], cpu.in_self_collision(q)[clear])


def test_projections_end_at_the_same_configurations(gpu, arms, generator):
    cpu, there = arms
    task = FixedRotation(3, (3.0, 0.0, 0.0))
    q = cpu.sample(500, generator)
    points = torch.tensor([0.4, 0.1, 0.3], dtype=torch.float64).expand(500, 3)
    expected, valid = grr_torch.project(cpu, task, points, q)
    found, also = grr_torch.project(there, task, points.to(gpu), q.to(gpu))
    assert (also.cpu() == valid).double().mean() > 0.99
    both = valid & also.cpu()
    difference = grr_torch.spaces.configuration.distance(found.cpu()[both], expected[both], cpu.continuous)
    assert (difference < 1e-6).double().mean() > 0.99


def _everywhere(*cases):
    """Cases of a device, a robot, a task and a size; a device that stands in for a GPU takes smaller ones."""
    marked = [pytest.param(*case, marks=needs_cuda if case[0] == "cuda" else without_cuda) for case in cases]
    return pytest.mark.parametrize(("gpu", "robot", "task", "size"), marked, indirect=["gpu"])


@_everywhere(
    *(("cuda", robot, task, {}) for robot in ("planar_5", "kinova") for task in ("position", "fixed-rotation")),
    (STAND_IN, "planar_5", "position", {"points": 100}),
    (STAND_IN, "kinova", "fixed-rotation", {"points": 300}),
)
def test_roadmaps_are_as_good_and_verified_anywhere(gpu, robot, task, size, tmp_path):
    expected = grr_torch.build(grr_torch.load_robot(robot), task, **size).quality()
    roadmap = grr_torch.build(grr_torch.load_robot(robot, device=gpu), task, **size)
    found = roadmap.quality()
    assert found.resolved_vertices == pytest.approx(expected.resolved_vertices, rel=0.005)
    assert found.connected_edges == pytest.approx(expected.connected_edges, rel=0.005)
    assert found.smoothness == pytest.approx(expected.smoothness, rel=0.01)
    assert found.self_collisions in (None, 0)
    roadmap.save(tmp_path / "roadmap.grr")
    assert all(check.passed for check in verify_file(tmp_path / "roadmap.grr"))
    loaded = grr_torch.Roadmap.load(tmp_path / "roadmap.grr")
    assert loaded.robot.device.type == loaded.configurations.device.type == "cpu"


@_everywhere(
    ("cuda", "planar_5", "pose", {"points": 300, "rotations": 6}),
    ("cuda", "kinova", "yaw", {"points": 500, "rotations": 6}),
    (STAND_IN, "planar_5", "pose", {"points": 40, "rotations": 3}),
    (STAND_IN, "kinova", "yaw", {"points": 80, "rotations": 4}),
)
@pytest.mark.filterwarnings("ignore:.*seeds are not used")
def test_roadmaps_of_turning_tools_are_as_good(gpu, robot, task, size):
    expected, found = (
        grr_torch.build(grr_torch.load_robot(robot, device=device), task, **size).quality() for device in ("cpu", gpu)
    )
    assert found.resolved_vertices == pytest.approx(expected.resolved_vertices, rel=0.01)
    assert found.connected_edges == pytest.approx(expected.connected_edges, rel=0.01)
    assert found.smoothness == pytest.approx(expected.smoothness, rel=0.02)


@without_cuda
def test_a_projection_moves_nothing(generator):
    with stand_in_device.stand_in() as transfers:
        arm = grr_torch.load_robot("kinova", device=STAND_IN)
        task = FixedRotation(3, (3.0, 0.0, 0.0))
        q = arm.sample(300, generator)
        points = torch.tensor([0.4, 0.1, 0.3], dtype=torch.float64).expand(300, 3).to(STAND_IN)
        # constants go to the device the first time
        grr_torch.project(arm, task, points, q)
        transfers.moved.clear()
        _, valid = grr_torch.project(arm, task, points, q)
        assert bool(valid.any())
    # but for how many of each pair of links are near
    assert transfers.outside("self_collision.py") == 0
    assert set(transfers.within("self_collision.py").values()) == {1}


@without_cuda
@pytest.mark.parametrize(
    ("task", "sizes", "options"),
    [("fixed-rotation", (200, 1200), {}), ("pose", (40, 90), {"rotations": 3, "refine": False})],
)
def test_expansion_and_relaxation_move_no_more_often_with_more_vertices(task, sizes, options):
    often = []
    for points in sizes:
        with stand_in_device.stand_in() as transfers:
            grr_torch.build(grr_torch.load_robot("planar_5", device=STAND_IN), task, points=points, **options)
        assert not transfers.within("step.py", "continuity.py", "columns.py", "relax.py", "hops.py", "certify.py")
        # a stencil or a ring goes there once
        assert not transfers.within("lattice.py", "task.py", "turning.py")
        often.append(sum(transfers.within("expand.py", "graph.py", "product.py", "devices.py").values()))
    assert often[0] == often[1] > 0


@without_cuda
@pytest.mark.parametrize("points", [40, 90])
def test_rounds_of_a_repair_move_nothing_but_random_starts(points, monkeypatch):
    rounds, find = [], repair.find_candidates
    monkeypatch.setattr(repair, "find_candidates", lambda *given: rounds.append(1) or find(*given))
    with stand_in_device.stand_in() as transfers:
        arm = grr_torch.load_robot("planar_5", device=STAND_IN)
        plain = grr_torch.build(arm, "pose", points=points, rotations=3, refine=False)
        transfers.moved.clear()
        repaired = repair.repair(plain, Tolerances(), 0)
    assert int(repaired.connected.sum()) > int(plain.connected.sum())
    assert len(rounds) > 3
    # points, edges and what is within reach, and what is beside configurations
    assert {way for way, _ in transfers.within("repair_candidates.py")} == {"to"}
    assert sum(transfers.within("repair_candidates.py").values()) == 3 + len(rounds)
    # configurations, flags and waves, there and back
    assert sum(transfers.within("repair.py").values()) == 6
    # which joints turn without limits, for the slopes on the CPU that say how steep edges may be
    assert sum(transfers.within("slopes.py").values()) == 1


@needs_cuda
def test_a_build_that_would_not_fit_the_gpu_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device=None: (100 << 20, 1 << 36))
    with pytest.raises(ParameterError, match="on the GPU"):
        grr_torch.build(grr_torch.load_robot("kinova", device="cuda"), "position", points=300_000)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("gpu") / "planar.grr"
    grr_torch.build(grr_torch.load_robot("planar_5"), "position", points=300).save(path)
    return path


@pytest.mark.parametrize("count", [1, 500, 5000])
def test_points_are_solved_alike(gpu, file, generator, count):
    cpu, there = (grr_torch.Roadmap.load(file, device=device) for device in ("cpu", gpu))
    points = cpu.points.amax(0) * (2.2 * torch.rand(count, 2, dtype=torch.float64, generator=generator) - 1.1)
    expected, found = cpu.solve(points), there.solve(points.to(gpu))
    assert found.configurations.device.type == found.valid.device.type == gpu
    assert (found.status == expected.status).mean() > 0.99
    both = expected.valid & found.valid.cpu()
    torch.testing.assert_close(
        found.configurations.cpu()[both], expected.configurations[both], atol=1e-6, rtol=0, check_device=False
    )
    assert bool(found.configurations[~found.valid].isnan().all())


@without_cuda
def test_solving_moves_as_often_however_many_points(file, generator):
    often = set()
    for count in (500, 5000):
        with stand_in_device.stand_in() as transfers:
            roadmap = grr_torch.Roadmap.load(file, device=STAND_IN)
            points = 0.5 * (torch.rand(count, 2, dtype=torch.float64, generator=generator) - 0.5)
            roadmap.solve(points.to(STAND_IN))
        often.add(transfers.moved.total())
    assert len(often) == 1


def test_points_of_turning_tools_are_solved_alike(gpu, tmp_path, generator):
    path = tmp_path / "pose.grr"
    grr_torch.build(grr_torch.load_robot("planar_5"), "pose", points=200, rotations=6).save(path)
    cpu, there = (grr_torch.Roadmap.load(path, device=device) for device in ("cpu", gpu))
    points = 0.8 * (torch.rand(1000, 3, dtype=torch.float64, generator=generator) - 0.5)
    expected, found = cpu.solve(points), there.solve(points)
    assert (found.status == expected.status).mean() > 0.99
    both = expected.valid & found.valid.cpu()
    assert int(both.sum()) > 100
    torch.testing.assert_close(found.configurations.cpu()[both], expected.configurations[both], atol=1e-6, rtol=0)


def test_training_ends_as_well_and_its_file_is_read_anywhere(gpu, file, tmp_path, generator):
    cpu, there = (grr_torch.Roadmap.load(file, device=device) for device in ("cpu", gpu))
    options = TrainingOptions(samples=5000, epochs=6, batch=256)
    expected, found = train_ik(cpu, options), train_ik(there, options, out=tmp_path / "ik.safetensors")
    assert found.network.last.weight.device.type == gpu
    assert found.origin.training["validation"] == pytest.approx(expected.origin.training["validation"], rel=0.5)
    points = RoadmapDataset(cpu, 2000).points
    again = NeuralIK.load(tmp_path / "ik.safetensors", cpu.robot)
    apart = difference(found(points.to(gpu)).cpu(), again(points), cpu.robot.continuous).abs()
    assert (apart < 1e-3).double().mean() > 0.99
    export_torch(found.network, found.origin, tmp_path / "ik.pt2")
    assert found.network.last.weight.device.type == gpu
    _, valid = found.refine(points.to(gpu), 3)
    assert valid.device.type == gpu
    assert (valid.cpu() == again.refine(points, 3)[1]).double().mean() > 0.99


def test_training_is_taken_up_on_the_device(gpu, file, tmp_path):
    there = grr_torch.Roadmap.load(file, device=gpu)
    options = TrainingOptions(samples=2000, epochs=4, batch=256)

    def stop(epoch):
        if epoch.epoch == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_ik(there, options, out=tmp_path / "ik.safetensors", on_epoch=stop)
    resumed = train_ik(there, options, out=tmp_path / "ik.safetensors", resume=True)
    whole = train_ik(there, options)
    assert resumed.origin.training["validation"] == pytest.approx(whole.origin.training["validation"], rel=0.2)


def test_data_sets_are_alike(gpu, file, tmp_path):
    tables = []
    for device in ("cpu", gpu):
        out = tmp_path / f"{device}.npz"
        export_dataset(grr_torch.Roadmap.load(file, device=device), out, 2000, jacobians=True)
        with np.load(out) as table:
            tables.append({name: table[name] for name in ("points", "configurations", "valid", "jacobians")})
    both = tables[0]["valid"] & tables[1]["valid"]
    assert both.mean() > 0.99
    for name in ("points", "configurations", "jacobians"):
        np.testing.assert_allclose(tables[0][name][both], tables[1][name][both], atol=1e-6)


def test_checkpoints_are_taken_up_on_the_device(gpu, tmp_path):
    robot = grr_torch.load_robot("planar_5", device=gpu)
    whole = grr_torch.build(robot, "position", points=300, checkpoint=tmp_path / "kept")
    resumed = grr_torch.build(robot, "position", points=300, checkpoint=tmp_path / "kept", resume=True)
    torch.testing.assert_close(resumed.configurations, whole.configurations, equal_nan=True, atol=0, rtol=0)
