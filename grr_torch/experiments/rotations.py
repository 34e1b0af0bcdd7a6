"""The spaces in which rotation varies: how large their roadmaps are, how good, and what they cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from grr_torch.errors import UnknownNameError
from grr_torch.experiments.timing import in_fresh_process
from grr_torch.progress import Progress, silent
from grr_torch.resolution.build import build
from grr_torch.resolution.quality import Quality
from grr_torch.robots.load import load_robot
from grr_torch.spaces.product import ProductGraph

PROBLEMS = ("planar_5 pose", "kinova yaw", "kinova axis", "kinova pose")


@dataclass(frozen=True)
class Result:
    """One roadmap of a preset.

    Attributes:
        problem: Of `PROBLEMS`.
        positions: Vertices of the grid of positions.
        rotations: Rotations at each.
        refined: Whether it was refined.
        seconds: What it took without reachability.
        memory: Peak of the process [MiB], torch and all.
        quality: Its figures.
    """

    problem: str
    positions: int
    rotations: int
    refined: bool
    seconds: float
    quality: Quality
    memory: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """All of it, for JSON."""
        names = ("problem", "positions", "rotations", "refined", "seconds", "memory")
        return {**{name: getattr(self, name) for name in names}, **self.quality.to_dict()}


def measure_rotations(
    problems: Sequence[str] | None = None,
    *,
    points: int | None = None,
    rotations: int | None = None,
    refine: bool = True,
    reachability: int = 8,
    seed: int = 0,
    progress: Progress = silent,
) -> list[Result]:
    """Builds presets, each in a process of its own.

    Args:
        problems: Of `PROBLEMS`; all by default.
        points: How many positions the grids are asked for; the presets' by default.
        rotations: How many rotations; the presets' by default.
        refine: Whether the maps are refined.
        reachability: Random starts a vertex that tell which are reachable.
        seed: Of all random draws.
        progress: Told which is built.

    Raises:
        UnknownNameError: No such problem.
    """
    wanted = PROBLEMS if problems is None else tuple(problems)
    for name in wanted:
        if name not in PROBLEMS:
            raise UnknownNameError("problem", name, PROBLEMS)
    results: list[Result] = []
    for index, name in enumerate(wanted):
        progress(f"building {name}", index, len(wanted))
        result, memory = in_fresh_process(_measure, name, points, rotations, refine, reachability, seed)
        results.append(replace(result, memory=memory))
    progress("building", len(wanted), len(wanted))
    return results


def _measure(
    problem: str, points: int | None, rotations: int | None, refine: bool, reachability: int, seed: int
) -> Result:
    name, task = problem.split()
    robot = load_robot(name)
    options: dict[str, Any] = {"points": points, "rotations": rotations, "refine": refine, "seed": seed}
    roadmap = build(robot, task, reachability=reachability, **options)
    assert isinstance(roadmap.graph, ProductGraph)
    size = len(roadmap.graph.positions.points)
    return Result(
        problem=problem,
        positions=size,
        rotations=len(roadmap.points) // size,
        refined=refine,
        seconds=roadmap.build_seconds,
        quality=roadmap.quality(),
    )
