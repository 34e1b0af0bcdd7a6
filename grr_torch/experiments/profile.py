"""Where the time of a build goes."""

from __future__ import annotations

import cProfile
import pstats
from dataclasses import dataclass
from pathlib import Path

import grr_torch
from grr_torch.resolution.build import build
from grr_torch.robots.robot import Robot

# what a build spends its time in, by file and function; each without what is listed beside it
STAGES: dict[str, set[tuple[str, str | None]]] = {
    "Jacobians": {("kinematics", "jacobian")},
    "poses": {("kinematics", None)},
    "damped least squares": {("columns", None)},
    "projection, rest": {("project", None), ("step", None), ("task", None), ("rotation", None)},
    "self-collision": {("self_collision", None)},
    "averages of neighbours": {("expand", "_average"), ("lattice", None), ("configuration", None), ("graph", None)},
    "bisection": {("continuity", None)},
}


@dataclass(frozen=True)
class Stage:
    """Part of a build.

    Attributes:
        name: What was done.
        seconds: How long it took.
        calls: How often its functions were called.
    """

    name: str
    seconds: float
    calls: int


def profile_build(robot: Robot, task: str, points: int | None = None) -> tuple[list[Stage], int]:
    """Own time by stage, of a second build; torch's operators count for the function that calls them.

    The profiler itself costs something: the sum is more than a build takes.

    Args:
        robot: A bundled robot.
        task: "position" or "fixed-rotation".
        points: About how many vertices; by default as many as the paper's.

    Returns:
        The stages, and how many vertices there are.
    """
    build(robot, task, refine=False)
    profiler = cProfile.Profile(builtins=False)
    roadmap = profiler.runcall(build, robot, task, points=points, refine=False)
    seconds = dict.fromkeys([*STAGES, "everything else"], 0.0)
    calls = dict.fromkeys(seconds, 0)
    package = Path(grr_torch.__file__).parent
    for (file, _, function), (_, count, own, _, _) in pstats.Stats(profiler).stats.items():  # type: ignore[attr-defined]
        stem = Path(file).stem if package in Path(file).parents else ""
        name = _stage(stem, function)
        seconds[name] += own
        calls[name] += count
    return [Stage(name, seconds[name], calls[name]) for name in seconds], len(roadmap.points)


def _stage(stem: str, function: str) -> str:
    for name, members in STAGES.items():
        if (stem, function) in members or (stem, None) in members:
            return name
    return "everything else"
