"""The continuity of a roadmap's edges, however many there are."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from grr_torch.pieces import together
from grr_torch.processes import at_once
from grr_torch.progress import Progress, silent
from grr_torch.projection.continuity import is_continuous
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.checkpoint import UNKEPT, Stage
from grr_torch.robots.robot import Robot
from grr_torch.spaces.task import TaskSpace

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap

# edges that are checked together
EDGES_AT_ONCE = 16384

# `is_continuous`, or what gives the same by other means, and may say by `at_once` how many edges it takes together
EdgeCheck = Callable[..., Tensor]


def check_edges(
    roadmap: Roadmap, tolerances: Tolerances, progress: Progress = silent, wanted: Tensor | None = None
) -> Tensor:
    """Which edges of a roadmap are continuous, checked anew: (E,) bool; of those `wanted` (E,), by default all."""
    parts = (roadmap.points, roadmap.configurations, roadmap.resolved, roadmap.edges)
    return continuous_edges(roadmap.robot, roadmap.task, *parts, tolerances, progress, wanted=wanted).cpu()


def continuous_edges(
    robot: Robot,
    task: TaskSpace,
    points: Tensor,
    configurations: Tensor,
    resolved: Tensor,
    edges: Tensor,
    tolerances: Tolerances,
    progress: Progress,
    kept: Stage = UNKEPT,
    check: EdgeCheck = is_continuous,
    wanted: Tensor | None = None,
) -> Tensor:
    """Which edges between resolved vertices are continuous: (E,) bool, on the robot's device.

    An edge that barely passes may fail beside other edges, as sums are rounded otherwise. The same batches are
    therefore checked whatever is wanted.

    Args:
        robot: The robot.
        task: The task space.
        points: (V, width) points.
        configurations: (V, n) configurations.
        resolved: (V,) vertices that have one.
        edges: (E, 2) vertices of each edge.
        tolerances: Of the projections.
        progress: Told how many edges are checked.
        kept: Where it is kept how far that is.
        check: What checks a batch of edges.
        wanted: (E,) edges that are asked for, by default all; others are not continuous as far as is known.
    """
    configurations, resolved, edges = (part.to(robot.device) for part in (configurations, resolved, edges))
    configurations = configurations.to(robot.dtype)
    points = points.to(configurations)
    connected = torch.zeros(len(edges), dtype=torch.bool, device=robot.device)
    wanted = None if wanted is None else wanted.to(robot.device)
    candidates = resolved[edges].all(1).nonzero()[:, 0]
    state = kept.state()
    if state:
        connected = state["connected"].to(robot.device)
    done = int(state["done"]) if state else 0
    size = getattr(check, "at_once", together(EDGES_AT_ONCE, robot.device))
    batches = [candidates[start : start + size] for start in range(done, len(candidates), size)]
    if wanted is not None:
        batches = [part for part in batches if bool(wanted[part].any())]

    def checked(part: Tensor) -> tuple[Tensor]:
        a, b = edges[part].T
        return (check(robot, task, points[a], points[b], configurations[a], configurations[b], tolerances=tolerances),)

    # what is not our own need not bear to be called in a copy of the process
    run = at_once if check is is_continuous else _one_by_one
    progress("checking edges", done, len(candidates))
    for part, (found,) in zip(batches, run(checked, batches, robot.device), strict=True):
        connected[part] = found
        done = int(torch.searchsorted(candidates, part[-1])) + 1
        kept.keep({"connected": connected, "done": torch.tensor(done)}, last=done == len(candidates))
        progress("checking edges", done, len(candidates))
    progress("checking edges", len(candidates), len(candidates))
    return connected if wanted is None else connected & wanted


def _one_by_one(function: Callable[[Tensor], tuple[Tensor]], batches: list[Tensor], _: Any) -> Iterator[tuple[Tensor]]:
    return map(function, batches)


def continuous_pairs(robot: Robot, task: TaskSpace, *ends: Tensor, tolerances: Tolerances) -> Tensor:
    """`is_continuous` (N,) for as many points (N, width) and configurations (N, n) as there are, in batches."""
    size = together(EDGES_AT_ONCE, robot.device)
    batches = list(zip(*(part.split(size) for part in ends), strict=True))
    results = at_once(lambda batch: (is_continuous(robot, task, *batch, tolerances=tolerances),), batches, robot.device)
    return torch.cat([found for (found,) in results])
