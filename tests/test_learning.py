"""Learning from a roadmap: the loss, training, and what its networks are worth."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

import grr_torch
from grr_torch import NeuralIK, RoadmapDataset, Split, TrainingOptions, train_ik
from grr_torch.errors import FileFormatError, OutputError, ParameterError, TrainingError, UnknownNameError
from grr_torch.learning.checkpoint import checkpoint_path
from grr_torch.learning.encoding import Encoding
from grr_torch.learning.evaluate import draw_part, evaluate_ik, pose_errors
from grr_torch.learning.loss import IkLoss
from grr_torch.learning.network import Architecture
from grr_torch.learning.refine import newton_steps
from grr_torch.learning.region import certified_region
from grr_torch.projection.project import Tolerances
from grr_torch.spaces.configuration import difference

SMALL = TrainingOptions(samples=4000, epochs=8, batch=256, architecture=Architecture(width=48, depth=2, waves=8))


@pytest.fixture(scope="module")
def kinova_roadmap(kinova) -> grr_torch.Roadmap:
    return grr_torch.build(kinova, "fixed-rotation", refine=False)


@pytest.fixture(scope="module")
def trained(planar_roadmap) -> NeuralIK:
    return train_ik(planar_roadmap, replace(SMALL, epochs=30))


def same_weights(first: NeuralIK, second: NeuralIK) -> bool:
    others = second.network.state_dict()
    return all(torch.equal(tensor, others[name]) for name, tensor in first.network.state_dict().items())


# loss


def test_the_pose_part_of_the_loss_is_that_of_the_robot(kinova_roadmap, generator):
    robot, task = kinova_roadmap.robot, kinova_roadmap.task
    encoding = Encoding.of(kinova_roadmap).float()
    q = robot.sample(50, generator)
    points = torch.rand(50, 3, dtype=torch.float64, generator=generator)
    encoded = encoding.encode(q.float()).requires_grad_()
    loss = IkLoss(robot, task, encoding)(encoded, encoding.encode(q.float()), points.float())
    position, rotation = robot.forward_kinematics(q)
    errors = task.residuals(task.error(points.T, position.T, rotation.permute(1, 2, 0)))
    assert torch.allclose(loss.position.double(), errors[0].square(), atol=1e-4)
    assert torch.allclose(loss.rotation.double(), 2.0 * (1.0 - errors[1].cos()), atol=1e-4)
    assert float(loss.joints.detach().max()) == 0.0
    loss.pose(1.0).sum().backward()
    assert bool(encoded.grad.isfinite().all())
    assert float(encoded.grad.abs().max()) > 0.0


def test_newton_steps_reach_the_point_within_limits(kinova, kinova_roadmap):
    dataset = RoadmapDataset(kinova_roadmap, 500)
    guesses = dataset.configurations + 0.01
    task = kinova_roadmap.task
    q, valid = newton_steps(kinova, task, dataset.points, guesses, 3, Tolerances(1e-6, 1e-6))
    assert float(valid.double().mean()) > 0.98
    assert bool(kinova.within_limits(q).all())
    again, _ = newton_steps(kinova, task, dataset.points, q, 5, Tolerances())
    assert float(difference(q, again, kinova.continuous).abs()[valid].max()) < 1e-5


# training


def test_training_learns_the_map(planar_roadmap, trained, generator):
    evaluation = evaluate_ik(trained, planar_roadmap, points=2000)
    points = draw_part(planar_roadmap, certified_region(planar_roadmap), Split(), "test", 2000, generator)
    begun = train_ik(planar_roadmap, replace(SMALL, epochs=1))(points)
    raw = [errors.millimetres.mean for errors in evaluation.errors]
    assert raw[0] < 0.2 * pose_errors(planar_roadmap, points, begun).millimetres.mean
    assert raw[0] > raw[1] > raw[2]
    assert evaluation.errors[2].exact > 0.9
    assert evaluation.from_map < 0.2
    assert evaluation.continuity.closure < 1e-6
    assert evaluation.newton_closure > evaluation.continuity.closure


def test_what_is_refined_is_at_its_point_or_not_valid(planar_roadmap, trained):
    region = certified_region(planar_roadmap)
    points = draw_part(planar_roadmap, region, Split(), "test", 300, torch.Generator().manual_seed(0))
    points = torch.cat([points, points + 3.0])
    q, valid = trained.refine(points.reshape(2, 300, 2))
    assert q.shape == (2, 300, 5)
    assert float(valid[0].double().mean()) > 0.9
    assert not bool(valid[1].any())
    assert bool(q[~valid].isnan().all())
    position, _ = planar_roadmap.robot.forward_kinematics(q[valid])
    assert float((position[:, :2] - points.reshape(2, 300, 2)[valid]).norm(dim=1).max()) <= 1e-4


@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2)])
def test_a_batch_gives_the_same_as_one_at_a_time(trained, shape, generator):
    points = 0.5 * torch.rand(*shape, 2, dtype=torch.float64, generator=generator) - 0.25
    q = trained(points)
    assert q.shape == (*shape, 5)
    assert q.dtype == torch.float64
    alone = torch.stack([trained(point) for point in points.reshape(-1, 2)]).reshape(q.shape)
    assert torch.allclose(q, alone, atol=1e-5)


def test_training_taken_up_again_ends_at_the_same_network(planar_roadmap, tmp_path):
    whole = train_ik(planar_roadmap, SMALL)
    out = tmp_path / "ik.safetensors"

    def stop(epoch):
        if epoch.epoch == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_ik(planar_roadmap, SMALL, out=out, on_epoch=stop)
    assert not out.exists()
    assert checkpoint_path(out).exists()
    epochs = []
    resumed = train_ik(planar_roadmap, SMALL, out=out, resume=True, on_epoch=epochs.append)
    assert [epoch.epoch for epoch in epochs] == [4, 5, 6, 7, 8]
    assert same_weights(whole, resumed)
    assert same_weights(NeuralIK.load(out, planar_roadmap), whole)
    assert not checkpoint_path(out).exists()


def test_the_best_epoch_is_kept_and_training_stops_without_progress(planar_roadmap):
    epochs = []
    options = replace(SMALL, learning_rate=0.5, epochs=30, patience=2)
    ik = train_ik(planar_roadmap, options, on_epoch=epochs.append)
    best = min(epochs, key=lambda epoch: epoch.validation)
    assert ik.origin.training["epoch"] == best.epoch
    assert ik.origin.training["validation"] == best.validation
    assert len(epochs) == best.epoch + 2 < 30


def test_a_loss_that_is_not_finite_stops_with_the_last_good_state(planar_roadmap, tmp_path):
    dataset = RoadmapDataset(planar_roadmap, SMALL.samples)
    out = tmp_path / "ik.safetensors"

    def spoil(epoch):
        if epoch.epoch == 2:
            dataset.targets[dataset.indices("train")[0]] = torch.nan

    with pytest.raises(TrainingError, match="not finite") as caught:
        train_ik(planar_roadmap, SMALL, out=out, dataset=dataset, on_epoch=spoil)
    assert caught.value.epoch == 3
    assert caught.value.checkpoint == checkpoint_path(out)
    assert not out.exists()
    resumed = train_ik(planar_roadmap, SMALL, out=out, resume=True)
    assert same_weights(resumed, train_ik(planar_roadmap, SMALL))


# bad input


def test_roadmaps_with_too_little_to_learn_are_refused(planar_roadmap):
    few = torch.zeros_like(planar_roadmap.resolved)
    few[planar_roadmap.resolved.nonzero()[:4, 0]] = True
    q = torch.where(few[:, None], planar_roadmap.configurations, torch.nan)
    connected = planar_roadmap.connected & few[planar_roadmap.edges].all(1)
    scarce = replace(planar_roadmap, resolved=few, configurations=q, connected=connected)
    with pytest.raises(ParameterError, match="4 resolved vertices"):
        train_ik(scarce, SMALL)
    with pytest.raises(ParameterError, match="certified"):
        RoadmapDataset(replace(planar_roadmap, connected=torch.zeros_like(connected)), 100)
    with pytest.raises(ParameterError, match="resolved vertex"):
        RoadmapDataset(replace(scarce, resolved=torch.zeros_like(few)))


def test_weights_of_another_robot_or_roadmap_are_refused(planar_roadmap, trained, tmp_path):
    trained.save(tmp_path / "ik.safetensors")
    with pytest.raises(ParameterError, match="planar_5"):
        NeuralIK.load(tmp_path / "ik.safetensors", grr_torch.load_robot("planar_3"))
    other = replace(planar_roadmap, configurations=planar_roadmap.configurations + 0.1)
    with pytest.raises(ParameterError, match="trained on"):
        evaluate_ik(trained, other)
    with pytest.raises(ParameterError, match="dataset: got one of roadmap .*; valid: of this one"):
        train_ik(planar_roadmap, SMALL, dataset=RoadmapDataset(other))


def test_what_is_no_roadmap_or_no_options_is_refused(planar_roadmap):
    for call in (RoadmapDataset, train_ik):
        with pytest.raises(ParameterError, match="roadmap: got 'planar.grr'; valid: a Roadmap"):
            call("planar.grr")
    with pytest.raises(ParameterError, match="valid: a TrainingOptions"):
        train_ik(planar_roadmap, {"epochs": 2})


def test_damaged_weights_are_refused(planar_roadmap, trained, tmp_path):
    path = tmp_path / "ik.safetensors"
    trained.save(path)
    whole = path.read_bytes()
    for damaged in (whole[: len(whole) // 2], whole[:4], b"", whole[:-3] + b"\x00\x11\x22", b"\x80\x04K\x01."):
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError):
            NeuralIK.load(path, planar_roadmap)
    planar_roadmap.save(path)
    with pytest.raises(FileFormatError, match="not a file of neural IK weights"):
        NeuralIK.load(path, planar_roadmap)
    with pytest.raises(FileFormatError, match="does not exist"):
        NeuralIK.load(tmp_path / "none.safetensors", planar_roadmap)


def test_a_state_of_another_training_is_not_resumed(planar_roadmap, tmp_path):
    out = tmp_path / "ik.safetensors"
    with pytest.raises(FileFormatError, match="is not a file"):
        train_ik(planar_roadmap, SMALL, out=out, resume=True)

    def stop(epoch):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_ik(planar_roadmap, SMALL, out=out, on_epoch=stop)
    state = checkpoint_path(out).read_bytes()
    with pytest.raises(OutputError, match="a state of a training is there; valid: another file .*; --resume"):
        train_ik(planar_roadmap, SMALL, out=out)
    assert checkpoint_path(out).read_bytes() == state
    with pytest.raises(FileFormatError, match="learning rate"):
        train_ik(planar_roadmap, replace(SMALL, learning_rate=1e-4), out=out, resume=True)
    with pytest.raises(ParameterError, match="resume"):
        train_ik(planar_roadmap, SMALL, resume=True)


def test_places_that_cannot_be_written_are_found_before_the_work(planar_roadmap, trained, tmp_path):
    def fail(*_):
        raise AssertionError("work has begun")

    with pytest.raises(OutputError):
        train_ik(planar_roadmap, SMALL, out=tmp_path / "none" / "ik.safetensors", progress=fail)
    with pytest.raises(ParameterError, match="safetensors"):
        train_ik(planar_roadmap, SMALL, out=tmp_path / "ik.pt", progress=fail)
    with pytest.raises(OutputError):
        trained.save(tmp_path / "none" / "ik.safetensors")


def test_values_outside_their_range_are_refused(planar_roadmap, trained):
    for wrong in ({"epochs": 0}, {"samples": -1}, {"batch": 1.5}, {"learning_rate": math.nan}, {"pose_weight": -1.0}):
        with pytest.raises(ParameterError):
            TrainingOptions(**wrong)
    for wrong in ({"test": 1.0}, {"validation": 0.5, "test": 0.5}, {"block": 0.0}, {"seed": -1}):
        with pytest.raises(ParameterError):
            Split(**wrong)
    with pytest.raises(ParameterError, match="at least one"):
        TrainingOptions(joint_weight=0.0, pose_weight=0.0)
    with pytest.raises(UnknownNameError):
        Split("blocks")
    with pytest.raises(ParameterError, match="block: got 0.1; valid: none for a split that is random"):
        Split("random", block=0.1)
    with pytest.raises(ParameterError, match="blocks"):
        Split(block=1e-6).of(planar_roadmap)
    with pytest.raises(ParameterError, match="none is for"):
        train_ik(planar_roadmap, replace(SMALL, split=Split(block=9.0)))
    with pytest.raises(UnknownNameError):
        RoadmapDataset(planar_roadmap).indices("holdout")
    with pytest.raises(ParameterError, match="finite"):
        trained(torch.tensor([math.nan, 0.0]))
    with pytest.raises(ParameterError, match="shape"):
        trained(torch.zeros(3))
    with pytest.raises(ParameterError, match="steps"):
        trained.refine(torch.zeros(2), -1)
