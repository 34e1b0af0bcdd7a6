"""What a roadmap is worth as a teacher: the same network and points, with other labels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch import Tensor

from grr_torch.errors import UnknownNameError
from grr_torch.learning.dataset import RoadmapDataset
from grr_torch.learning.evaluate import Evaluation, check_origin, draw_part, evaluate_ik, median_time, split_of
from grr_torch.learning.neural_ik import NeuralIK
from grr_torch.learning.options import Epoch, TrainingOptions
from grr_torch.learning.region import certified_region
from grr_torch.learning.train import train_ik
from grr_torch.progress import Progress, silent
from grr_torch.projection.project import Tolerances, project
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.spaces.configuration import difference

LABELS = {
    "roadmap": "the roadmap's configurations",
    "independent": "IK from random starts, each point by itself",
    "none": "forward kinematics alone",
    "roadmap-joints": "the roadmap's configurations, joint space alone",
    "independent-joints": "IK from random starts, joint space alone",
}
# others' figures, of other robots, tasks and networks
PUBLISHED = ("IKFlow, Panda, SE(3), many solutions a pose", 6.66, 2.03)
# random starts for a point until one leads there
_STARTS = 20


@dataclass(frozen=True)
class Outcome:
    """A network and what is measured of it.

    Attributes:
        labels: Of `LABELS`.
        seconds: How long it was trained.
        epochs: How many epochs.
        evaluation: What is measured.
        ik: The network.
    """

    labels: str
    seconds: float
    epochs: int
    evaluation: Evaluation
    ik: NeuralIK

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        figures = {"labels": self.labels, "seconds": self.seconds, "epochs": self.epochs}
        return {**figures, **self.evaluation.to_dict()}


@dataclass(frozen=True)
class WarmStart:
    """Exact solutions of held-out points in two ways.

    Attributes:
        method: What was done.
        points_per_second: How fast.
        valid: Share of valid ones.
        from_map: Largest joint difference to the roadmap's configuration, median where both are valid [rad or m].
    """

    method: str
    points_per_second: float
    valid: float
    from_map: float

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def measure_learning(
    roadmap: Roadmap,
    options: TrainingOptions | None = None,
    *,
    labels: Sequence[str] = tuple(LABELS),
    points: int = 20_000,
    on_epoch: Callable[[str, Epoch], None] = lambda labels, epoch: None,
    progress: Progress = silent,
) -> list[Outcome]:
    """Trains the same network on the same points with each kind of labels, and measures it.

    Args:
        roadmap: The roadmap.
        options: How to train.
        labels: Of `LABELS`.
        points: Held-out points that are measured.
        on_epoch: Told how far training is.
        progress: Told how many points are solved.

    Raises:
        UnknownNameError: No such labels.
        ParameterError: The roadmap cannot be learned.
    """
    options = options or TrainingOptions()
    for name in labels:
        if name not in LABELS:
            raise UnknownNameError("labels", name, tuple(LABELS))
    split = options.parted()
    dataset = RoadmapDataset(roadmap, options.samples, split=split, seed=options.seed, progress=progress)
    outcomes = []
    for name in labels:
        last: list[Epoch] = []

        def note(epoch: Epoch, name: str = name, last: list[Epoch] = last) -> None:
            last[:] = [epoch]
            on_epoch(name, epoch)

        given = dataset
        if name.startswith("independent"):
            given = dataset.relabelled(*independent_solutions(roadmap, dataset.points, options.seed, progress))
        ik = train_ik(roadmap, weighted(options, name), dataset=given, on_epoch=note)
        evaluation = evaluate_ik(ik, roadmap, points=points, seed=options.seed + 1)
        outcomes.append(Outcome(name, last[0].seconds, last[0].epoch, evaluation, ik))
    return outcomes


def weighted(options: TrainingOptions, labels: str) -> TrainingOptions:
    """Options of a training with some labels: without the loss in joint space, or without the tool's, or with both."""
    if labels == "none":
        return replace(options, joint_weight=0.0)
    return replace(options, pose_weight=0.0) if labels.endswith("-joints") else options


def independent_solutions(
    roadmap: Roadmap, points: Tensor, seed: int, progress: Progress = silent
) -> tuple[Tensor, Tensor]:
    """Configurations (N, n) of points (N, d) from random starts, and valid (N,): what IK gives that knows no map."""
    robot, tolerances = roadmap.robot, Tolerances(**roadmap.parameters["tolerances"])
    generator = torch.Generator().manual_seed(seed)
    q, valid = points.new_full((len(points), robot.n), torch.nan), torch.zeros(len(points), dtype=torch.bool)
    for start in range(_STARTS):
        progress("solving from random starts", start, _STARTS)
        left = (~valid).nonzero()[:, 0]
        if len(left) == 0:
            break
        guesses = robot.sample(len(left), generator)
        q[left], valid[left] = project(robot, roadmap.task, points[left], guesses, tolerances=tolerances)
    progress("solving from random starts", _STARTS, _STARTS)
    return q, valid


def compare_warm_starts(ik: NeuralIK, roadmap: Roadmap, *, points: int = 20_000, seed: int = 1) -> list[WarmStart]:
    """Solves held-out points exactly: by the roadmap, and from the network's configurations.

    Args:
        ik: A network that learned the roadmap.
        roadmap: The roadmap.
        points: How many.
        seed: Of their draw.

    Raises:
        ParameterError: The network learned another roadmap, or the number is not valid.
    """
    check_origin(ik, roadmap)
    robot, task, tolerances = roadmap.robot, roadmap.task, Tolerances(**roadmap.parameters["tolerances"])
    generator = torch.Generator().manual_seed(seed)
    held_out = draw_part(roadmap, certified_region(roadmap), split_of(ik), "test", points, generator)
    solution = roadmap.solve(held_out)

    def row(method: str, call: Callable[[], tuple[Tensor, Tensor]]) -> WarmStart:
        q, valid = call()
        both = valid & solution.valid
        apart = difference(q[both], solution.configurations[both], robot.continuous).abs().amax(1)
        median = float(apart.median()) if len(apart) else float("nan")
        return WarmStart(method, points / median_time(call), float(valid.double().mean()), median)

    def mapped() -> tuple[Tensor, Tensor]:
        found = roadmap.solve(held_out)
        return found.configurations, found.valid

    return [
        row("roadmap.solve", mapped),
        row("network, projection", lambda: project(robot, task, held_out, ik(held_out), tolerances=tolerances)),
        row("network, two Newton steps", lambda: ik.refine(held_out)),
    ]
