"""Training a network on a roadmap: joints and tool at once, in epochs that can be taken up again."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from grr_torch.errors import OutputError, ParameterError, TrainingError, check_kind
from grr_torch.learning.checkpoint import Checkpoint, checkpoint_path
from grr_torch.learning.dataset import RoadmapDataset
from grr_torch.learning.loss import IkLoss, Loss
from grr_torch.learning.network import IkNetwork
from grr_torch.learning.neural_ik import NeuralIK, Origin
from grr_torch.learning.options import Epoch, TrainingOptions
from grr_torch.learning.sample import check_learnable
from grr_torch.output import check_writable
from grr_torch.pieces import one_thread
from grr_torch.progress import Progress, silent

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap

# the share of the training in which the loss of the pose sets in: it is only then that the joints are near the map's,
# and that they do not settle where the tool is right and the map is not
_POSE_BEGINS, _POSE_WHOLE = 0.15, 0.3
# steps in which the learning rate grows to its value, at most
_WARM_UP = 200
# resolved vertices without which there is no map to learn
_FEWEST_VERTICES = 10


def train_ik(
    roadmap: Roadmap,
    options: TrainingOptions | None = None,
    *,
    out: str | os.PathLike[str] | None = None,
    resume: bool = False,
    dataset: RoadmapDataset | None = None,
    on_epoch: Callable[[Epoch], None] | None = None,
    progress: Progress = silent,
) -> NeuralIK:
    """Trains a network to give the configurations of a roadmap.

    The loss is chordal in joint space, and the tool's distance and rotation through differentiable forward kinematics.
    What is kept is the network of the epoch with the least loss on the validation part. Training runs on the device of
    the roadmap's robot, of the CPU on one thread, and is repeatable there: the same options give the same network on
    the same machine, taken up again or not (on a GPU as far as its sums are in one order).

    Args:
        roadmap: The roadmap.
        options: How; `TrainingOptions()` by default.
        out: A .safetensors file for the result. After every epoch the state is kept beside it, until it is written.
        resume: Go on from that state.
        dataset: Samples, instead of those that the options say.
        on_epoch: Told how far training is, after every epoch.
        progress: Told how many points are solved.

    Raises:
        ParameterError: The roadmap has too few resolved vertices or no certified cells, a part has no samples, the
            dataset is of another roadmap, or `resume` without `out`.
        OutputError: `out` cannot be written, or the state of a training is there without `resume`.
        FileFormatError: The state to resume from is missing, or of another training.
        TrainingError: The loss is not finite.
    """
    check_learnable(roadmap)
    options = options or TrainingOptions()
    check_kind("options", options, TrainingOptions, "TrainingOptions()")
    resolved = int(roadmap.resolved.sum())
    if resolved < _FEWEST_VERTICES:
        raise ParameterError("roadmap", f"one with {resolved} resolved vertices", f"{_FEWEST_VERTICES} or more")
    if resume and out is None:
        raise ParameterError("resume", "no file", "the file that was to be written")
    if out is not None:
        check_weights_path("out", out)
    origin = Origin.of(roadmap, {})
    if dataset is not None and dataset.roadmap_hash != origin.roadmap_hash:
        raise ParameterError("dataset", f"one of roadmap {dataset.roadmap_hash}", f"of this one, {origin.roadmap_hash}")
    identity = {"options": options.to_dict(), "origin": origin.to_dict()}
    checkpoint = None if out is None else Checkpoint(checkpoint_path(out), identity)
    if checkpoint is not None and not resume and checkpoint.path.exists():
        valid = "another file to write; --resume to go on from there; or to remove it"
        raise OutputError(checkpoint.path, f"a state of a training is there; valid: {valid}")
    state = checkpoint.load() if checkpoint is not None and resume else None
    if dataset is None:
        dataset = RoadmapDataset(roadmap, options.samples, split=options.parted(), seed=options.seed, progress=progress)
    training = _Training(roadmap, options, dataset, checkpoint)
    if state is not None:
        training.resume(*state)
    with one_thread():
        network, record = training.run(on_epoch or (lambda epoch: None))
    ik = NeuralIK(network, roadmap.robot, Origin.of(roadmap, {"options": options.to_dict(), **record}))
    if out is not None and checkpoint is not None:
        ik.save(out)
        checkpoint.path.unlink(missing_ok=True)
    return ik


def check_weights_path(name: str, path: str | os.PathLike[str]) -> None:
    """Finds out before the work starts whether weights could be written.

    Raises:
        ParameterError: The file's name does not end in .safetensors.
        OutputError: It cannot be written.
    """
    if Path(path).suffix != ".safetensors":
        raise ParameterError(name, path, "a file that ends in .safetensors")
    check_writable(path)


class _Training:
    """The state of a training."""

    def __init__(
        self, roadmap: Roadmap, options: TrainingOptions, dataset: RoadmapDataset, checkpoint: Checkpoint | None
    ) -> None:
        device = roadmap.robot.device
        self.options, self.checkpoint = options, checkpoint
        self.parts = {part: dataset.indices(part).to(device) for part in ("train", "validation")}
        for part, rows in self.parts.items():
            if len(rows) == 0:
                given = f"{len(dataset)} samples of which none is for {part}"
                raise ParameterError("split", given, "more samples, or smaller blocks")
        state = torch.random.get_rng_state()
        torch.manual_seed(options.seed)
        self.network = IkNetwork(roadmap.robot.continuous.tolist(), roadmap.task.width, options.architecture)
        torch.random.set_rng_state(state)
        self.network.encoding.load_state_dict(dataset.encoding.state_dict())
        self.network.to(device)
        self.loss = IkLoss(roadmap.robot, roadmap.task, self.network.encoding)
        self.inputs, self.targets = dataset.inputs.to(device), dataset.targets.to(device)
        self.points = dataset.points.float().to(device)
        self.scale = float(dataset.encoding.scale)
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=options.learning_rate, betas=(0.9, 0.99))
        self.steps = -(-len(self.parts["train"]) // options.batch)
        # figures of the best epoch, and its weights
        self.epoch, self.best = 0, {"epoch": 0.0, "validation": math.inf}
        self.best_state = self._weights()

    def run(self, on_epoch: Callable[[Epoch], None]) -> tuple[IkNetwork, dict[str, float]]:
        """Trains to the end; gives the best network, and its figures."""
        begin, first = time.perf_counter(), self.epoch
        while self.epoch < self.options.epochs and self.epoch - self.best["epoch"] < self.options.patience:
            loss = self._train()
            figures = self._validate() if math.isfinite(loss) else {"validation": loss}
            if not math.isfinite(figures["validation"]):
                kept = self.checkpoint.path if self.checkpoint is not None and self.epoch else None
                raise TrainingError(self.epoch + 1, "the loss is not finite; a lower learning rate may help", kept)
            self.epoch += 1
            if figures["validation"] < self.best["validation"]:
                self.best = {"epoch": float(self.epoch), **figures}
                self.best_state = self._weights()
            if self.checkpoint is not None:
                self.checkpoint.save(self._state(), {"epoch": self.epoch, "best": self.best})
            seconds = time.perf_counter() - begin
            left = seconds / (self.epoch - first) * (self.options.epochs - self.epoch)
            best = int(self.best["epoch"])
            measured = (figures["validation"], figures["millimetres"], figures["degrees"])
            on_epoch(Epoch(self.epoch, self.options.epochs, loss, *measured, best, seconds, left))
        self.network.load_state_dict(self.best_state)
        return self.network, self.best

    def resume(self, metadata: dict[str, Any], tensors: dict[str, Tensor]) -> None:
        """Takes up the state of a checkpoint."""
        self.epoch, self.best = int(metadata["epoch"]), dict(metadata["best"])
        parts: dict[str, dict[str, Tensor]] = {name: {} for name in ("network", "best", "first", "second")}
        for name, tensor in tensors.items():
            part, _, rest = name.partition(".")
            parts[part][rest] = tensor
        self.network.load_state_dict(parts["network"])
        self.best_state = parts["best"]
        state = self.optimiser.state_dict()
        step = torch.tensor(float(self.epoch * self.steps))
        state["state"] = {
            k: {"step": step.clone(), "exp_avg": parts["first"][str(k)], "exp_avg_sq": parts["second"][str(k)]}
            for k in range(len(parts["first"]))
        }
        self.optimiser.load_state_dict(state)

    def _train(self) -> float:
        """One epoch; the mean loss, or the first one that is not finite."""
        generator = torch.Generator().manual_seed((self.options.seed << 20) % (1 << 62) + self.epoch)
        rows = self.parts["train"]
        rows = rows[torch.randperm(len(rows), generator=generator)]
        total = 0.0
        for step, batch in enumerate(rows.split(self.options.batch)):
            loss = self._step(self.epoch * self.steps + step, batch)
            if not math.isfinite(loss):
                return loss
            total += loss * len(batch)
        return total / len(rows)

    def _step(self, step: int, batch: Tensor) -> float:
        """One step of Adam; its loss."""
        done = step / (self.options.epochs * self.steps)
        rate = self.options.learning_rate * min(1.0, (step + 1) / min(_WARM_UP, self.steps))
        for group in self.optimiser.param_groups:
            group["lr"] = rate * (0.5005 + 0.4995 * math.cos(math.pi * done))
        loss = self._losses(batch, self._pose_weight(done)).mean()
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        return float(loss.detach())

    def _pose_weight(self, done: float) -> float:
        if self.options.joint_weight == 0.0:
            return self.options.pose_weight
        share = (done - _POSE_BEGINS) / (_POSE_WHOLE - _POSE_BEGINS)
        return self.options.pose_weight * min(1.0, max(0.0, share))

    def _loss(self, batch: Tensor) -> Loss:
        inputs, targets, points = self.inputs[batch], self.targets[batch], self.points[batch]
        return self.loss(self.network.encoded(inputs), targets, points)

    def _losses(self, batch: Tensor, pose_weight: float) -> Tensor:
        loss = self._loss(batch)
        pose = pose_weight * loss.pose(self.scale)
        # at weight 0 targets may be anything, NaN too
        return pose if self.options.joint_weight == 0.0 else pose + self.options.joint_weight * loss.joints

    def _validate(self) -> dict[str, float]:
        """Loss, millimetres and degrees on the validation part."""
        rows = self.parts["validation"]
        sums = torch.zeros(3, dtype=torch.float64, device=self.points.device)
        with torch.no_grad():
            for batch in rows.split(self.options.batch):
                loss = self._loss(batch)
                whole = self.options.pose_weight * loss.pose(self.scale)
                if self.options.joint_weight > 0.0:
                    whole = whole + self.options.joint_weight * loss.joints
                parts = (whole, 1e3 * loss.position.sqrt(), loss.rotation.sqrt().rad2deg())
                sums += torch.stack([part.double().sum() for part in parts])
        validation, millimetres, degrees = (sums / len(rows)).tolist()
        return {"validation": validation, "millimetres": millimetres, "degrees": degrees}

    def _weights(self) -> dict[str, Tensor]:
        return {name: tensor.detach().clone() for name, tensor in self.network.state_dict().items()}

    def _state(self) -> dict[str, Tensor]:
        """All tensors from which training goes on."""
        moments = self.optimiser.state_dict()["state"]
        tensors = {
            **{f"network.{name}": tensor for name, tensor in self._weights().items()},
            **{f"best.{name}": tensor for name, tensor in self.best_state.items()},
            **{f"first.{k}": moment["exp_avg"] for k, moment in moments.items()},
            **{f"second.{k}": moment["exp_avg_sq"] for k, moment in moments.items()},
        }
        return {name: tensor.cpu() for name, tensor in tensors.items()}
