"""How builds and roadmaps grow: time, memory, file size and the time of opening, over the number of vertices."""

from __future__ import annotations

import math
import os
import statistics
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from grr_torch.errors import ParameterError
from grr_torch.experiments.timing import in_fresh_process, median_process_seconds
from grr_torch.progress import Progress, silent
from grr_torch.resolution.build import build
from grr_torch.resolution.problem import complete_task, pose_problem
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.robots.load import load_robot
from grr_torch.robots.robot import Robot
from grr_torch.spaces.graph import check_count

# vertices, about
SIZES = (1_000, 10_000, 100_000, 1_000_000)
# exponents are of sizes from here on: below, what does not grow counts
_LARGE = 10_000
# vertices of the build that torch starts up with, where rotation varies positions, and then the rotations of each
_WARM, _WARM_ROTATIONS = 200, 8


@dataclass(frozen=True)
class Build:
    """A build in a process of its own.

    Attributes:
        vertices: Of the task graph.
        edges: Of the task graph.
        resolved: Vertices that have a configuration.
        seconds: How long the build took.
        cpu_seconds: How much processor time the build took, that of the processes it forked included.
        peak_mib: The most memory that the process held. Those that it forked are not counted: most of what they hold is
            this process's memory, and what they hold besides does not grow with the vertices.
    """

    vertices: int
    edges: int
    resolved: int
    seconds: float
    cpu_seconds: float
    peak_mib: float


@dataclass(frozen=True)
class Size(Build):
    """A line of the table.

    Attributes:
        cell_seconds: How long its cells and the other figures took.
        save_seconds: How long it took to write the file.
        file_mib: How large the file is.
        load_seconds: How long `Roadmap.load` takes in a new process.
        first_seconds: How long the first point takes to solve there.
        next_seconds: How long one more point takes.
        process_seconds: How much longer `grr-torch solve` takes for a point than a process that imports torch.
    """

    cell_seconds: float
    save_seconds: float
    file_mib: float
    load_seconds: float
    first_seconds: float
    next_seconds: float
    process_seconds: float


def measure_scale(
    robot: str = "kinova",
    task: str | None = None,
    *,
    sizes: Sequence[int] = SIZES,
    refine: bool = True,
    repeats: int = 3,
    progress: Progress = silent,
) -> list[Size]:
    """Builds, writes, opens and solves with roadmaps of growing size, each in processes of their own.

    Args:
        robot: A bundled robot.
        task: A task of its preset; by default the preset's default.
        sizes: Vertices asked for; where rotation varies, positions, each in as many rotations as the preset has.
        refine: Whether roadmaps are refined.
        repeats: Times of opening and solving are medians of so many processes.
        progress: Told which size is measured.

    Raises:
        ParameterError: There is no size, one is not valid or would not fit the memory, or `repeats` is below 1.
        UnknownNameError: No such robot or task.
    """
    if not sizes:
        raise ParameterError("sizes", "none", "one or more numbers of vertices")
    if repeats < 1:
        raise ParameterError("repeats", repeats, "1 or more")
    arm = load_robot(robot)
    for points in sizes:
        check_count(points)
    pose_problem(arm, task, min(sizes))
    rows: list[Size] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "roadmap.grr"
        for index, points in enumerate(sizes):
            progress("measuring sizes", index, len(sizes))
            (grown, times), peak = in_fresh_process(_save, robot, task, points, refine, path)
            opened = [in_fresh_process(_open, path)[0] for _ in range(repeats)]
            load, first, following = (statistics.median(part) for part in zip(*opened, strict=True))
            rows.append(
                Size(
                    **{**grown, "peak_mib": peak, **times},
                    file_mib=path.stat().st_size / 2**20,
                    load_seconds=load,
                    first_seconds=first,
                    next_seconds=following,
                    process_seconds=_process_seconds(path, repeats),
                )
            )
    progress("measuring sizes", len(sizes), len(sizes))
    return rows


def measure_build(robot: str, task: str | None, points: int, *, refine: bool, device: str = "cpu") -> Build:
    """A build of about so many vertices, in a process of its own."""
    grown, peak = in_fresh_process(_grow, robot, task, points, refine, device)
    return Build(**grown, peak_mib=peak)


def exponents(rows: Sequence[Size]) -> dict[str, float]:
    """By figure, p of vertices to the power of p, fitted to sizes above 10,000; 1 is a straight line."""
    large = [row for row in rows if row.vertices >= _LARGE]
    if len({row.vertices for row in large}) < 2:
        return {}
    logs = np.log([row.vertices for row in large])
    return {
        name: float(np.polyfit(logs, np.log([max(getattr(row, name), 1e-9) for row in large]), 1)[0])
        for name in asdict(large[0])
        if name != "vertices"
    }


def plot(rows: Sequence[Size], path: Path) -> None:
    """Draws all figures over the number of vertices, on logarithmic axes, as a PNG."""
    from matplotlib.figure import Figure

    panels = {
        "time [s]": {"build": "seconds", "cells": "cell_seconds", "write": "save_seconds"},
        "memory, file [MiB]": {"peak of the process": "peak_mib", "file": "file_mib"},
        "opening [s]": {"load": "load_seconds", "whole process, beyond torch": "process_seconds"},
        "one point [s]": {"the first": "first_seconds", "one more": "next_seconds"},
    }
    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    vertices = [row.vertices for row in rows]
    for axes, (label, lines) in zip(figure.subplots(2, 2).flat, panels.items(), strict=True):
        for name, attribute in lines.items():
            axes.loglog(vertices, [getattr(row, attribute) for row in rows], marker="o", label=name)
        axes.set(xlabel="vertices", ylabel=label)
        axes.grid(True, which="major", alpha=0.3)
        axes.legend()
    figure.savefig(path, format="png", dpi=120)


def _grow(robot: str, task: str | None, points: int, refine: bool, device: str) -> dict[str, Any]:
    return _grown(robot, task, points, refine, device)[0]


def _grown(robot: str, task: str | None, points: int, refine: bool, device: str) -> tuple[dict[str, Any], Roadmap]:
    """Figures of a build, by name, and the roadmap."""
    arm = load_robot(robot, device=device)
    _warm_up(arm, task)
    begin = _processor_seconds()
    roadmap = build(arm, task, points=points, refine=refine)
    figures = {
        "vertices": len(roadmap.points),
        "edges": len(roadmap.edges),
        "resolved": int(roadmap.resolved.sum()),
        "seconds": roadmap.build_seconds,
        "cpu_seconds": _processor_seconds() - begin,
    }
    return figures, roadmap


def _warm_up(arm: Robot, task: str | None) -> None:
    """Lets torch start up, on so few vertices that the peak of memory is not theirs."""
    varies = complete_task(arm, task, None).rotations is not None
    build(arm, task, points=_WARM, rotations=_WARM_ROTATIONS if varies else None, refine=False)


def _processor_seconds() -> float:
    """Processor time of this process and of those it forked that have ended [s]."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _save(robot: str, task: str | None, points: int, refine: bool, path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Figures of a build, and of what comes after it."""
    figures, roadmap = _grown(robot, task, points, refine, "cpu")
    begin = time.perf_counter()
    roadmap.quality()
    measured = time.perf_counter()
    roadmap.save(path)
    return figures, {"cell_seconds": measured - begin, "save_seconds": time.perf_counter() - measured}


def _open(path: Path) -> tuple[float, float, float]:
    """Times of loading, of the first point, and of one more [s]."""
    begin = time.perf_counter()
    roadmap = Roadmap.load(path)
    loaded = time.perf_counter()
    point = _some_point(roadmap)
    chosen = time.perf_counter()
    roadmap.solve(point)
    first = time.perf_counter()
    repeats = 20
    for _ in range(repeats):
        roadmap.solve(point)
    return loaded - begin, first - chosen, (time.perf_counter() - first) / repeats


def _some_point(roadmap: Roadmap) -> torch.Tensor:
    """(1, width) a resolved point in the middle of their list."""
    resolved = roadmap.resolved.nonzero()[:, 0]
    if len(resolved) == 0:
        raise ParameterError("sizes", len(roadmap.points), "enough vertices that one can be resolved")
    return roadmap.points[resolved[len(resolved) // 2]][None]


def _process_seconds(path: Path, repeats: int) -> float:
    point = [str(value) for value in _some_point(Roadmap.load(path))[0].tolist()]
    seconds = median_process_seconds(
        {
            "solve": ["-P", "-m", "grr_torch.cli.main", "solve", str(path), "--point", *point],
            "torch": ["-c", "import torch"],
        },
        repeats,
    )
    return max(seconds["solve"] - seconds["torch"], math.ulp(1.0))
