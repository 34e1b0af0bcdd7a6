"""The expansion: from seeds over the task graph, wave by wave (the paper's Algorithms 2 and 3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from grr_torch.errors import ParameterError
from grr_torch.progress import Progress, silent
from grr_torch.projection.project import DEFAULT_TOLERANCES, Tolerances, project_columns
from grr_torch.resolution.seeds import SeedsLike, check_seeds, place_seeds
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import weighted_average
from grr_torch.spaces.graph import TaskGraph
from grr_torch.spaces.task import TaskSpace


@dataclass(frozen=True)
class Expansion:
    """What an expansion found.

    Attributes:
        configurations: (V, n), NaN where unresolved.
        wave: (V,) the wave that resolved a vertex, 0 for seeds, −1 where unresolved.
    """

    configurations: Tensor
    wave: Tensor

    @property
    def resolved(self) -> Tensor:
        """(V,) vertices that have a configuration."""
        return self.wave >= 0


def expand(
    robot: Robot,
    task: TaskSpace,
    graph: TaskGraph,
    seeds: SeedsLike,
    *,
    neighbours: int | None = None,
    tolerances: Tolerances = DEFAULT_TOLERANCES,
    progress: Progress = silent,
) -> Expansion:
    """Expands seeds over a task graph.

    All vertices of a breadth-first layer are resolved at once (Algorithm 2, GlobalExpansion, with layers in place of
    a queue): each is projected from the weighted, circular average of its nearest resolved vertices (Algorithm
    3, ProjectNeighbors, w = (max d / d)²). A vertex whose projection failed is tried again when more of the vertices
    it shares an edge with are resolved.

    Args:
        robot: The robot.
        task: The task space.
        graph: The task graph G_p.
        seeds: (S, n) configurations; each goes to the vertex nearest to its tool.
        neighbours: How many of the nearest vertices are averaged over, as far as they are resolved; by default 24
            in the plane and 64 in space.
        tolerances: Of the projections.
        progress: Told how many vertices are resolved.

    Raises:
        SeedError: No seed can be used.
        ParameterError: `neighbours` is below 1.
    """
    if neighbours is None:
        neighbours = default_neighbours(task)
    if neighbours < 1:
        raise ParameterError("neighbours", neighbours, "1 or more")
    count = len(graph.points)
    configurations = torch.full((count, robot.n), torch.nan, dtype=robot.dtype, device=robot.device)
    wave = torch.full((count,), -1, dtype=torch.int32, device=robot.device)
    vertices, placed = place_seeds(robot, task, graph, check_seeds(robot, seeds), tolerances)
    configurations[vertices], wave[vertices] = placed, 0
    nearest, distances = (part.to(robot.device) for part in graph.neighbours(neighbours))
    # (max d / d)² normalised is 1 / d² normalised
    weights = distances.square().reciprocal().to(robot.dtype)
    starts, ends = (part.to(robot.device) for part in graph.adjacency)
    targets = graph.points.to(device=robot.device, dtype=robot.dtype)
    tried_with = torch.zeros(count, dtype=torch.int32, device=robot.device)
    current = 0
    while True:
        resolved = wave >= 0
        around = torch.zeros_like(tried_with).index_add_(0, starts, resolved[ends].int())
        # an edge may lead to a vertex that is not among the nearest; its end waits until one of these is resolved
        frontier = (~resolved & (around > tried_with)).nonzero()[:, 0]
        frontier = frontier[resolved[nearest[frontier]].any(1)]
        progress("expanding", int(resolved.sum()), count)
        if len(frontier) == 0:
            return Expansion(configurations, wave)
        current += 1
        near = nearest[frontier]
        known = resolved[near]
        weight = torch.where(known, weights[frontier], 0.0)
        average = weighted_average(configurations[near].nan_to_num(), weight, robot.continuous)
        solved, valid = project_columns(
            robot, task, targets[frontier].T.contiguous(), average.T.contiguous(), tolerances
        )
        tried_with[frontier] = around[frontier]
        found = frontier[valid]
        configurations[found], wave[found] = solved.T[valid], current


def default_neighbours(task: TaskSpace) -> int:
    """How many nearest vertices are averaged over: 24 in the plane, 64 in space."""
    return 24 if task.dimension == 2 else 64
