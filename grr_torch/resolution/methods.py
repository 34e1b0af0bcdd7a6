"""The two methods by which vertices come to configurations: Expansion-GRR, from seeds, and the baseline Random-GRR."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from grr_torch.progress import Progress
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.auto_seeds import find_seeds
from grr_torch.resolution.checkpoint import Checkpoint
from grr_torch.resolution.edges import EdgeCheck, continuous_edges
from grr_torch.resolution.expand import default_neighbours, expand
from grr_torch.resolution.problem import Problem
from grr_torch.resolution.random_grr import random_grr
from grr_torch.robots.robot import Robot


class Work(NamedTuple):
    """What either method works on, and with.

    Attributes:
        robot: The robot.
        problem: Task, graph and seeds.
        seed: Of all random draws.
        tolerances: Of the projections.
        check: What checks batches of edges.
        progress: Told what is being done and how far it is.
        kept: Where it is kept what is done.
    """

    robot: Robot
    problem: Problem
    seed: int
    tolerances: Tolerances
    check: EdgeCheck
    progress: Progress
    kept: Checkpoint


class Parts(NamedTuple):
    """What a method finds.

    Attributes:
        configurations: (V, n), NaN where unresolved.
        wave: (V,) when a vertex was resolved, −1 where unresolved.
        connected: (E,) edges that are continuous.
        chosen: The method's parameters.
    """

    configurations: Tensor
    wave: Tensor
    connected: Tensor
    chosen: dict[str, Any]


def at_random(work: Work, samples: int, nearest: int | None) -> Parts:
    """Random-GRR, with so many random configurations a vertex; of each, so many nearest ones beside it are tested."""
    robot, (task, graph, *_) = work.robot, work.problem
    options: dict[str, Any] = {"samples": samples} | ({} if nearest is None else {"nearest": nearest})

    def resolve() -> dict[str, Tensor]:
        given = {**options, "seed": work.seed, "tolerances": work.tolerances, "progress": work.progress}
        drawn = random_grr(robot, task, graph, **given)
        return {"configurations": drawn.configurations, "wave": drawn.wave}

    found = work.kept.once("random", resolve)
    return _checked(work, found["configurations"], found["wave"], {**options, "seeds": []})


def by_expansion(work: Work, neighbours: int | None, candidates: int) -> Parts:
    """Expansion-GRR, from the problem's seeds, or the best of so many candidates."""
    problem = work.problem
    table = problem.seeds
    if found := isinstance(table, str):
        table = _found_seeds(work, candidates)
    expansion = expand(
        work.robot,
        problem.task,
        problem.graph,
        table,
        neighbours=neighbours,
        tolerances=work.tolerances,
        progress=work.progress,
        kept=work.kept.stage("expansion"),
        warn=not found,
    )
    chosen: dict[str, Any] = {"neighbours": default_neighbours(problem.task) if neighbours is None else neighbours}
    if found:
        # what they are found from: they may be as many as the vertices
        chosen.update(seeds=problem.seeds, candidates=candidates)
    else:
        chosen.update(seeds=torch.as_tensor(table, dtype=torch.float64).tolist())
    return _checked(work, expansion.configurations, expansion.wave, chosen)


def _found_seeds(work: Work, candidates: int) -> Tensor:
    problem = work.problem

    def find() -> dict[str, Tensor]:
        found = find_seeds(
            work.robot,
            problem.task,
            problem.graph,
            candidates=candidates,
            seed=work.seed,
            max_slope=problem.max_slope,
            tolerances=work.tolerances,
            progress=work.progress,
        )
        return {"seeds": found}

    return work.kept.once("seeds", find)["seeds"].to(work.robot.device)


def _checked(work: Work, configurations: Tensor, wave: Tensor, chosen: dict[str, Any]) -> Parts:
    """With the edges that are continuous."""
    robot, (task, graph, *_) = work.robot, work.problem
    parts = graph.points, configurations, wave >= 0, graph.edges
    stage = work.kept.stage("edges")
    connected = continuous_edges(robot, task, *parts, work.tolerances, work.progress, stage, work.check)
    return Parts(configurations, wave, connected, chosen)
