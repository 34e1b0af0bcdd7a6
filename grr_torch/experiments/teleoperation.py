"""The paper's Table II: teleoperation on roadmaps and with IK solvers, all in one harness."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from grr_torch.applications.teleoperate import Teleoperator
from grr_torch.baselines.newton_ik import NewtonIk
from grr_torch.baselines.relaxed_ik import RelaxedIk
from grr_torch.errors import ParameterError, UnknownNameError
from grr_torch.experiments.metrics import Figures, measure, warping
from grr_torch.experiments.paths import CLOSED, KINDS, draw_paths
from grr_torch.output import atomic_write
from grr_torch.progress import Progress, silent
from grr_torch.resolution.build import build
from grr_torch.resolution.roadmap import Roadmap

METHODS = ("expansion", "random", "newton", "relaxed")
RATE = 50.0
# the most that a joint moves in a step, as in the paper's experiment [rad]
MAX_STEP = 0.04
# steps after the last waypoint, in which an arm may still arrive
MORE_STEPS = 100

# an arm has arrived when its tool is so near its goal [m] and no joint moves more in a step [rad or m]
_ARRIVED, _SETTLED = 1e-3, 1e-4


class Controller(Protocol):
    """What follows targets, one control step at a time."""

    def reset(self, configurations: Tensor) -> None:
        """Puts the arms (paths, n) where they start."""

    def step(self, targets: Tensor) -> Tensor:
        """Configurations (paths, n) after a step towards targets (paths, width)."""


class _OnRoadmap:
    """A teleoperator as a controller."""

    def __init__(self, roadmap: Roadmap) -> None:
        self._teleoperator = Teleoperator(roadmap, RATE, max_step=MAX_STEP)

    def reset(self, configurations: Tensor) -> None:
        self._teleoperator.reset(configurations)

    def step(self, targets: Tensor) -> Tensor:
        return self._teleoperator.step(targets).configuration


@dataclass(frozen=True, eq=False)
class Run:
    """One method on one kind of paths.

    Attributes:
        method: Of `METHODS`.
        kind: Of `KINDS`.
        waypoints: (paths, waypoints, width).
        trajectories: (paths, steps, n) joint trajectories, the start first, NaN after a path's end; not wrapped.
        step_seconds: Time of a step, all paths together, over the number of paths [s].
        figures: The metrics, path by path.
    """

    method: str
    kind: str
    waypoints: Tensor
    trajectories: Tensor
    step_seconds: float
    figures: Figures


def run_teleoperation(
    roadmap: Roadmap,
    *,
    paths: Mapping[str, Tensor] | None = None,
    methods: Sequence[str] = METHODS,
    count: int = 100,
    seed: int = 0,
    progress: Progress = silent,
) -> list[Run]:
    """Lets every method follow the same paths (Section V-D of the paper).

    All start at the roadmap's configuration for the first waypoint, or at the nearest resolved vertex where it has
    none; "random" at those of its own roadmap. A joint moves at most 0.04 rad a step. After the last waypoint arms have
    100 more steps to arrive.

    Args:
        roadmap: The roadmap of the method "expansion"; the others use its robot, task and graph.
        paths: Waypoints (paths, waypoints, width) by kind; by default `count` of each are drawn.
        methods: Of `METHODS`; "random" builds a roadmap with Random-GRR first, which takes minutes.
        count: Paths of each kind that are drawn.
        seed: Of the paths, and of Random-GRR.
        progress: Told what is being done.

    Raises:
        UnknownNameError: No such method or kind.
        ParameterError: Paths do not fit the roadmap.
        MissingPackageError: dtw-python is not installed.
    """
    if roadmap.task.rotations is not None:
        raise ParameterError("task", roadmap.task.kind, "position or fixed-rotation: the paths compared do not turn")
    check_methods(methods)
    warping()  # known before minutes have passed
    if paths is None:
        paths = {kind: draw_paths(roadmap, kind, count, seed=seed) for kind in KINDS}
    for kind, waypoints in paths.items():
        if kind not in KINDS:
            raise UnknownNameError("kind of path", kind, KINDS)
        if waypoints.ndim != 3 or waypoints.shape[2] != roadmap.task.width or waypoints.shape[1] < 2:
            raise ParameterError(f"paths '{kind}'", tuple(waypoints.shape), f"(paths, 2 or more, {roadmap.task.width})")
        if len(waypoints) == 0 or not bool(waypoints.isfinite().all()):
            given = "no path" if len(waypoints) == 0 else "NaN or infinite values"
            raise ParameterError(f"paths '{kind}'", given, "one or more, with finite values")
    runs: list[Run] = []
    for method in methods:
        own = _random_roadmap(roadmap, seed, progress) if method == "random" else roadmap
        controller = _controller(method, own)
        for kind, waypoints in paths.items():
            trajectories, seconds = _follow(controller, own, waypoints, f"{method}, {kind}", progress)
            figures = measure(roadmap, waypoints, trajectories, RATE, closed=kind in CLOSED)
            runs.append(Run(method, kind, waypoints, trajectories, seconds, figures))
    return runs


def check_methods(methods: Sequence[str]) -> None:
    """Checks the names of methods.

    Raises:
        UnknownNameError: One is not of `METHODS`.
    """
    for method in methods:
        if method not in METHODS:
            raise UnknownNameError("method", method, METHODS)


def _random_roadmap(roadmap: Roadmap, seed: int, progress: Progress) -> Roadmap:
    """Random-GRR's map of the same robot, task and graph."""
    graph = roadmap.graph
    return build(roadmap.robot, roadmap.task, points=graph, method="random", refine=False, seed=seed, progress=progress)


def _controller(method: str, roadmap: Roadmap) -> Controller:
    if method == "newton":
        return NewtonIk(roadmap.robot, roadmap.task, max_step=MAX_STEP)
    if method == "relaxed":
        return RelaxedIk(roadmap.robot, roadmap.task, max_step=MAX_STEP)
    return _OnRoadmap(roadmap)


def starts(roadmap: Roadmap, points: Tensor) -> Tensor:
    """(paths, n) where arms start: the map's configurations, or the nearest resolved vertices'."""
    solution = roadmap.solve(points)
    vertices = roadmap.solver.nearest(points)[1][:, 0]
    return torch.where(solution.valid[:, None], solution.configurations, roadmap.configurations[vertices].to(points))


def _follow(
    controller: Controller, roadmap: Roadmap, waypoints: Tensor, name: str, progress: Progress
) -> tuple[Tensor, float]:
    """Trajectories (paths, steps, n) and the time of a step for one path [s]."""
    waypoints = waypoints.to(roadmap.robot.lower)
    count, given = waypoints.shape[:2]
    q = starts(roadmap, waypoints[:, 0])
    controller.reset(q)
    trajectory = [q]
    done = torch.zeros(count, dtype=torch.bool)
    begin = time.perf_counter()
    for step in range(1, given + MORE_STEPS):
        progress(name, step, given + MORE_STEPS)
        before, q = q, controller.step(waypoints[:, min(step, given - 1)])
        trajectory.append(torch.where(done[:, None], torch.nan, q))
        if step >= given - 1:
            tool = roadmap.robot.forward_kinematics(q)[0][:, : roadmap.task.dimension]
            near = (tool - waypoints[:, -1, : roadmap.task.dimension]).norm(dim=1) <= _ARRIVED
            done |= near & ((q - before).abs().amax(1) <= _SETTLED)
            if bool(done.all()):
                break
    progress(name, given + MORE_STEPS, given + MORE_STEPS)
    seconds = (time.perf_counter() - begin) / (len(trajectory) - 1) / count
    return torch.stack(trajectory, dim=1).cpu(), seconds


def aggregate(runs: Sequence[Run]) -> list[dict[str, float | str | int | None]]:
    """Each run's metrics over its paths: means, and the largest joint step, acceleration, closure and stall.

    `deviation_solved` and `smoothness_solved` are means over the paths of a kind on which all methods succeed; None
    where there is no such path.
    """
    solved = {
        kind: torch.stack([run.figures.success for run in runs if run.kind == kind]).all(0)
        for kind in {run.kind for run in runs}
    }
    results: list[dict[str, float | str | int | None]] = []
    for run in runs:
        figures, common = run.figures, solved[run.kind]
        results.append(
            {
                "kind": run.kind,
                "method": run.method,
                "paths": len(run.waypoints),
                "success": float(figures.success.double().mean()),
                "deviation": float(figures.deviation.mean()),
                "deviation_solved": float(figures.deviation[common].mean()) if bool(common.any()) else None,
                "tilt": float(figures.tilt.mean()),
                "smoothness": float(figures.smoothness.mean()),
                "smoothness_solved": float(figures.smoothness[common].mean()) if bool(common.any()) else None,
                "joint_step": float(figures.joint_step.max()),
                "acceleration": float(figures.acceleration.max()),
                "closure": float(figures.closure.max()) if run.kind in CLOSED else None,
                "stall": float(figures.stall.max()),
                "step_seconds": run.step_seconds,
            }
        )
    return results


def save_trajectories(runs: Sequence[Run], path: str | os.PathLike[str]) -> None:
    """Writes joint trajectories, and the waypoints they followed, to an npz file by an atomic rename.

    One array METHOD__KIND of shape (paths, steps, n) for each run, and one KIND (paths, waypoints, width).

    Raises:
        OutputError: It cannot be written.
    """
    arrays = {f"{run.method}__{run.kind}": run.trajectories.numpy() for run in runs}
    arrays |= {run.kind: run.waypoints.cpu().numpy() for run in runs}
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
