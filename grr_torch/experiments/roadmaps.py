"""The paper's Table I, and beyond: its four problems by every method, plain and refined."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from grr_torch.errors import ParameterError, UnknownNameError
from grr_torch.progress import Progress, silent
from grr_torch.resolution.build import build
from grr_torch.resolution.quality import Quality
from grr_torch.resolution.refine import refine
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.robots.load import load_robot

PROBLEMS = tuple((robot, task) for robot in ("planar_5", "kinova") for task in ("position", "fixed-rotation"))
METHODS = ("random", "preset", "auto")
# the paper's Table I: connectivity [%], smoothness [rad/m] and build time [min], by problem and method
PAPER = {
    ("planar_5", "position"): {"random": (100, 16.853, 2.023), "preset": (100, 5.675, 0.095)},
    ("planar_5", "fixed-rotation"): {"random": (100, 24.528, 1.862), "preset": (100, 8.992, 0.150)},
    ("kinova", "position"): {"random": (100, 9.223, 22.971), "preset": (100, 2.563, 0.201)},
    ("kinova", "fixed-rotation"): {"random": (100, 11.205, 72.013), "preset": (100, 4.299, 0.196)},
}


@dataclass(frozen=True)
class Result:
    """One roadmap.

    Attributes:
        robot: The bundled robot.
        task: The kind of task.
        method: Of `METHODS`: random is Random-GRR, the others are Expansion-GRR with the seeds of that name.
        refined: Whether it was refined.
        seconds: What it took: seeds, expansion, continuity of all edges, refinement; the median of several builds, of
            random one.
        quality: Its figures.
    """

    robot: str
    task: str
    method: str
    refined: bool
    seconds: float
    quality: Quality

    @property
    def paper(self) -> tuple[float, float, float] | None:
        """The paper's connectivity [%], smoothness [rad/m] and build time [min]; it has none for refined maps."""
        return None if self.refined else PAPER[self.robot, self.task].get(self.method)

    def to_dict(self) -> dict[str, Any]:
        """All of it, for JSON."""
        names = ("robot", "task", "method", "refined", "seconds")
        return {**{name: getattr(self, name) for name in names}, "paper": self.paper, **self.quality.to_dict()}


def chosen_problems(robots: Sequence[str] | None = None, tasks: Sequence[str] | None = None) -> list[tuple[str, str]]:
    """Of the four problems, those of some robots and tasks; of all by default.

    Raises:
        UnknownNameError: No such robot or task.
    """
    known = tuple(tuple(dict.fromkeys(names)) for names in zip(*PROBLEMS, strict=True))
    for names, kind, which in ((robots, "robot", known[0]), (tasks, "task", known[1])):
        for name in names or ():
            if name not in which:
                raise UnknownNameError(kind, name, which)
    return [(robot, task) for robot, task in PROBLEMS if robot in (robots or known[0]) and task in (tasks or known[1])]


def measure_roadmaps(
    *,
    robots: Sequence[str] | None = None,
    methods: Sequence[str] | None = None,
    reachability: int = 40,
    samples: int = 100,
    seed: int = 0,
    repeats: int = 3,
    progress: Progress = silent,
) -> list[Result]:
    """Builds the four problems by every method, plain and refined.

    Args:
        robots: Of planar_5 and kinova; both by default.
        methods: Of `METHODS`; all by default.
        reachability: Random starts a vertex that tell which are reachable.
        samples: Random configurations a vertex, for the method "random".
        seed: Of all random draws.
        repeats: Times are medians of so many builds, of all methods by turns; random, which takes minutes, is built
            once.
        progress: Told which roadmap is built.

    Raises:
        UnknownNameError: No such robot or method.
        ParameterError: `repeats` is below 1.
    """
    if repeats < 1:
        raise ParameterError("repeats", repeats, "1 or more")
    for name in methods or ():
        if name not in METHODS:
            raise UnknownNameError("method", name, METHODS)
    chosen = [method for method in METHODS if method in (methods or METHODS)]
    # by turns; random only once
    turns = [(turn, method) for turn in range(repeats) for method in chosen if method != "random" or turn == 0]
    problems = chosen_problems(robots)
    results: list[Result] = []
    for index, (name, task) in enumerate(problems):
        robot = load_robot(name)
        pairs: dict[str, list[tuple[Roadmap, Roadmap]]] = {method: [] for method in chosen}
        for number, (turn, method) in enumerate(turns):
            progress(f"{name} {task}, {method}", index * len(turns) + number, len(problems) * len(turns))
            options: dict[str, Any] = {"seed": seed, "seeds": "auto" if method == "auto" else None}
            if method == "random":
                options |= {"method": "random", "samples": samples}
            plain = build(robot, task, **options, refine=False, reachability=0 if turn else reachability)
            pairs[method].append((plain, refine(plain, seed=seed)))
        for method in chosen:
            for refined, roadmaps in enumerate(zip(*pairs[method], strict=True)):
                seconds = statistics.median(roadmap.build_seconds for roadmap in roadmaps)
                results.append(Result(name, task, method, bool(refined), seconds, roadmaps[0].quality()))
    progress("done", len(problems) * len(turns), len(problems) * len(turns))
    return results
