"""What any effort reaches: refined roadmaps from many draws of found seeds, and those of them that no other beats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from grr_torch.errors import ParameterError
from grr_torch.experiments.roadmaps import chosen_problems
from grr_torch.progress import Progress, silent
from grr_torch.resolution.build import build
from grr_torch.resolution.quality import Quality
from grr_torch.robots.load import load_robot


@dataclass(frozen=True)
class Best:
    """A refined roadmap that no other one of its problem beats.

    Attributes:
        robot: The bundled robot.
        task: The kind of task.
        seed: What its seeds were found from; None for the preset's seeds.
        seconds: What it took to build.
        quality: Its figures.
    """

    robot: str
    task: str
    seed: int | None
    seconds: float
    quality: Quality

    @property
    def merits(self) -> tuple[float, ...]:
        """Resolved vertices, connected edges, smoothness and certified triangles; more is better in each."""
        quality = self.quality
        certified = quality.triangles - quality.triangles_wound - quality.triangles_spread
        smoothness = float("inf") if quality.smoothness is None else quality.smoothness
        return quality.resolved_vertices, quality.connected_edges, -smoothness, certified

    def beats(self, other: Best) -> bool:
        """Whether it is as good in everything and better in something."""
        return self.merits != other.merits and all(a >= b for a, b in zip(self.merits, other.merits, strict=True))

    def to_dict(self) -> dict[str, Any]:
        """All of it, for JSON."""
        names = ("robot", "task", "seed", "seconds")
        return {**{name: getattr(self, name) for name in names}, **self.quality.to_dict()}


def measure_effort(
    draws: int,
    *,
    robots: Sequence[str] | None = None,
    tasks: Sequence[str] | None = None,
    max_slope: float | None = None,
    progress: Progress = silent,
) -> list[Best]:
    """Builds each problem from the preset's seeds and from those that `draws` generator seeds find.

    Args:
        draws: How many.
        robots: Of planar_5 and kinova; both by default.
        tasks: Of position and fixed-rotation; both by default.
        max_slope: As of `build`.
        progress: Told which roadmap is built.

    Returns:
        For each problem, the roadmaps that no other beats, the smoothest first.

    Raises:
        ParameterError: `draws` is below 1, or `max_slope` is not above 0.
        UnknownNameError: No such robot or task.
    """
    if draws < 1:
        raise ParameterError("draws", draws, "1 or more")
    problems = chosen_problems(robots, tasks)
    results: list[Best] = []
    for index, (name, task) in enumerate(problems):
        robot = load_robot(name)
        maps: list[Best] = []
        for draw in range(draws + 1):
            progress(f"{name} {task}", index * (draws + 1) + draw, len(problems) * (draws + 1))
            seed = draw - 1 if draw else None
            seeds = None if seed is None else "auto"
            roadmap = build(robot, task, seeds=seeds, seed=seed or 0, max_slope=max_slope)
            maps.append(Best(name, task, seed, roadmap.build_seconds, roadmap.quality()))
        best = {one.merits: one for one in reversed(maps) if not any(other.beats(one) for other in maps)}
        results += sorted(best.values(), key=lambda one: one.merits[2], reverse=True)
    progress("done", 1, 1)
    return results
