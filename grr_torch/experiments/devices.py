"""The same work on several devices: how long it takes, and whether what comes out is as good."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from grr_torch.errors import ParameterError, UnknownNameError
from grr_torch.experiments.roadmaps import PROBLEMS
from grr_torch.experiments.use_speed import points_in_cells
from grr_torch.learning.dataset import RoadmapDataset
from grr_torch.learning.export import export_dataset
from grr_torch.learning.options import TrainingOptions
from grr_torch.learning.train import train_ik
from grr_torch.progress import Progress, silent
from grr_torch.resolution.build import build
from grr_torch.resolution.quality import Quality
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.robots.load import load_robot

WORK = ("roadmaps", "solve", "export", "train", "large")
# positions and rotations of a million vertices
_LARGE = (4_580, 203)


@dataclass(frozen=True)
class Result:
    """One piece of work on one device.

    Attributes:
        work: What was done.
        device: Where.
        seconds: How long it took: of roadmaps and of solving the median of several runs; of an export all of one run,
            of training all of one by its epochs.
        outcome: Figures of what came out.
    """

    work: str
    device: str
    seconds: float
    outcome: dict[str, float]

    def to_dict(self) -> dict[str, Any]:
        """All of it, for JSON."""
        return asdict(self)


def measure_devices(
    devices: Sequence[str],
    *,
    work: Sequence[str] | None = None,
    solves: int = 1_000_000,
    samples: int = 100_000,
    epochs: int = 3,
    repeats: int = 3,
    progress: Progress = silent,
) -> list[Result]:
    """Does everything on each device, by turns.

    Args:
        devices: Names of devices, such as cpu and cuda.
        work: Of `WORK`; all by default.
        solves: Points to solve.
        samples: Rows to export, and to train from.
        epochs: Epochs to train.
        repeats: Times of roadmaps and of solving are medians of so many.
        progress: Told what is done.

    Raises:
        UnknownNameError: No such work.
        ParameterError: No such device, or none, or a number below 1.
    """
    if not devices:
        raise ParameterError("devices", "none", "one or more, such as cpu and cuda")
    for name, number in {"solves": solves, "samples": samples, "epochs": epochs, "repeats": repeats}.items():
        if number < 1:
            raise ParameterError(name, number, "1 or more")
    chosen = WORK if work is None else tuple(work)
    for name in chosen:
        if name not in WORK:
            raise UnknownNameError("work", name, WORK)
    for device in devices:
        build(load_robot("planar_5", device=device), "position", refine=False)  # the device starts up
    results: list[Result] = []
    tasks: list[tuple[str, Callable[[str], Result]]] = []
    if "roadmaps" in chosen:
        tasks += [(f"{robot} {task}", _builds(robot, task, repeats)) for robot, task in PROBLEMS]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "kinova.grr"
        if {"solve", "export", "train"} & set(chosen):
            build(load_robot("kinova"), "position").save(path)
        tasks += [
            (name, function)
            for name, function in (
                ("solve", lambda device: _solve(path, device, solves, repeats)),
                ("export", lambda device: _export(path, device, samples)),
                ("train", lambda device: _train(path, device, samples, epochs)),
                ("large", lambda device: _build("kinova", "pose", device, 1, *_LARGE)),
            )
            if name in chosen
        ]
        for index, (name, function) in enumerate(tasks):
            progress(f"measuring {name}", index, len(tasks))
            results += [function(device) for device in devices]
    progress("measuring", len(tasks), len(tasks))
    return results


def _builds(robot: str, task: str, repeats: int) -> Callable[[str], Result]:
    return lambda device: _build(robot, task, device, repeats)


def _build(
    robot: str, task: str, device: str, repeats: int, points: int | None = None, rotations: int | None = None
) -> Result:
    arm = load_robot(robot, device=device)
    roadmaps = [build(arm, task, points=points, rotations=rotations) for _ in range(repeats)]
    seconds = statistics.median(roadmap.build_seconds for roadmap in roadmaps)
    name = f"build {robot} {task}, {len(roadmaps[0].points):,} vertices"
    return Result(name, device, seconds, _figures(roadmaps[0].quality()))


def _figures(quality: Quality) -> dict[str, float]:
    names = ("resolved_vertices", "connected_edges", "smoothness")
    return {name.replace("_", " "): float(getattr(quality, name)) for name in names}


def _solve(path: Path, device: str, count: int, repeats: int) -> Result:
    roadmap = Roadmap.load(path, device=device)
    points = points_in_cells(roadmap, count, seed=0)
    roadmap.solve(points[: min(count, 1000)])
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        solution = roadmap.solve(points)
        valid = float(solution.valid.double().mean())
        solution.configurations.cpu()
        times.append(time.perf_counter() - begin)
    return Result(f"solve {count:,} points", device, statistics.median(times), {"solved": valid})


def _export(path: Path, device: str, samples: int) -> Result:
    roadmap = Roadmap.load(path, device=device)
    begin = time.perf_counter()
    counts = export_dataset(roadmap, path.with_suffix(".safetensors"), samples, jacobians=True)
    return Result(
        f"export {samples:,} rows with Jacobians",
        device,
        time.perf_counter() - begin,
        {"solved": 1.0 - counts["not valid"] / samples},
    )


def _train(path: Path, device: str, samples: int, epochs: int) -> Result:
    roadmap = Roadmap.load(path, device=device)
    options = TrainingOptions(samples=samples, epochs=epochs, patience=epochs)
    dataset = RoadmapDataset(roadmap, samples, split=options.parted(), seed=options.seed)
    begin = time.perf_counter()
    record = train_ik(roadmap, options, dataset=dataset).origin.training
    seconds = (time.perf_counter() - begin) / epochs
    return Result(f"train an epoch of {samples:,} samples", device, seconds, {"mm, best epoch": record["millimetres"]})
