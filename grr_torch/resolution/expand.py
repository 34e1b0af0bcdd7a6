"""The expansion: from seeds over the task graph, wave by wave (the paper's Algorithms 2 and 3)."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from grr_torch.errors import ParameterError, check_whole
from grr_torch.progress import Progress, silent
from grr_torch.projection.project import DEFAULT_TOLERANCES, Tolerances, project_columns
from grr_torch.resolution.checkpoint import UNKEPT, Stage
from grr_torch.resolution.reachability import within_reach
from grr_torch.resolution.seeds import SeedsLike, check_seeds, place_seeds
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import average, embed
from grr_torch.spaces.graph import TaskGraph
from grr_torch.spaces.product import MOST_HOPS, ProductGraph
from grr_torch.spaces.task import TaskSpace

# vertices whose neighbours are listed at once
_VERTICES_AT_ONCE = 1 << 15


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
    kept: Stage = UNKEPT,
    warn: bool = True,
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
            in the plane and 64 in space. Where rotation varies, how many edges away they are at most instead, by
            default 2.
        tolerances: Of the projections.
        progress: Told how many vertices are resolved.
        kept: Where it is kept how far that is.
        warn: Whether seeds that cannot be used are named in a GrrWarning.

    Raises:
        SeedError: No seed can be used.
        ParameterError: `neighbours` is below 1, or above 3 where rotation varies.
    """
    if neighbours is None:
        neighbours = default_neighbours(task)
    check_neighbours(task, neighbours)
    vertices, placed = place_seeds(robot, task, graph, check_seeds(robot, seeds), tolerances, warn=warn)
    return grow(
        robot,
        task,
        graph,
        vertices,
        placed,
        neighbours=neighbours,
        tolerances=tolerances,
        progress=progress,
        kept=kept,
    )


def check_neighbours(task: TaskSpace, neighbours: int) -> int:
    """How many of the nearest vertices are to be averaged over, or how many edges away they may be.

    Raises:
        ParameterError: It is below 1, or above 3 where rotation varies.
    """
    number = check_whole("neighbours", neighbours, 1)
    if task.rotations is not None and number > MOST_HOPS:
        raise ParameterError("neighbours", number, f"1 to {MOST_HOPS} edges, as rotation varies")
    return number


def grow(
    robot: Robot,
    task: TaskSpace,
    graph: TaskGraph,
    found: Tensor,
    placed: Tensor,
    *,
    neighbours: int,
    tolerances: Tolerances,
    progress: Progress = silent,
    kept: Stage = UNKEPT,
) -> Expansion:
    """`expand` from vertices `found` (K,) that have configurations `placed` (K, n)."""
    count = len(graph.points)
    configurations = torch.full((count, robot.n), torch.nan, dtype=robot.dtype, device=robot.device)
    wave = torch.full((count,), -1, dtype=torch.int32, device=robot.device)
    # what is averaged: rows of zeros where unresolved
    embedded = configurations.new_zeros(count, 2 * robot.n)
    targets = graph.points.to(device=robot.device, dtype=robot.dtype).T.contiguous()
    candidates = within_reach(robot, task, graph.points).to(robot.device)
    within = int(candidates.sum())
    waiting = torch.zeros_like(candidates)
    begin = 0
    if state := kept.state():
        configurations, wave, waiting = (state[name].to(robot.device) for name in ("configurations", "wave", "waiting"))
        resolved = wave >= 0
        embedded[resolved] = embed(configurations[resolved], robot.continuous)
        candidates &= ~resolved
        found, placed, begin = state["found"].to(robot.device), state["placed"].to(robot.device), int(state["next"])
    for current in itertools.count(begin):
        configurations[found], wave[found], candidates[found] = placed, current, False
        embedded[found] = embed(placed, robot.continuous)
        waiting[graph.around(found)[1]] = True
        frontier = (waiting & candidates).nonzero()[:, 0]
        progress("expanding", int((wave >= 0).sum()), within)
        guesses, known = _average(graph, embedded, frontier, neighbours, robot.continuous)
        # an edge may lead to a vertex that is not among the nearest; its end waits until one of these is resolved
        frontier = frontier[known]
        waiting[frontier] = False
        solved, valid = project_columns(robot, task, targets[:, frontier], guesses[known].T.contiguous(), tolerances)
        found, placed = frontier[valid], solved.T[valid]
        state = {"configurations": configurations, "wave": wave, "waiting": waiting, "found": found, "placed": placed}
        kept.keep({**state, "next": torch.tensor(current + 1)}, last=len(frontier) == 0)
        if len(frontier) == 0:
            progress("expanding", within, within)
            return Expansion(configurations, wave)
    raise AssertionError("unreachable")


def _average(
    graph: TaskGraph, embedded: Tensor, vertices: Tensor, neighbours: int, continuous: Tensor
) -> tuple[Tensor, Tensor]:
    """Weighted averages (F, n) of the resolved among the nearest vertices, and where there are any (F,).

    2n multiply-adds a neighbour. Weights are 1 / d²: what (max d / d)² is, but for a factor.
    """
    sums: list[Tensor] = []
    # a product has some hundreds of neighbours, not some tens
    for part in vertices.split(_VERTICES_AT_ONCE >> (3 if isinstance(graph, ProductGraph) else 0)):
        nearest, distances = graph.neighbours(part, neighbours)
        if nearest.numel() == 0:
            sums.append(embedded.new_zeros(len(part), embedded.shape[1]))
            continue
        weights = distances.to(embedded).square().reciprocal()
        sums.append(embedding_bag(nearest, embedded, per_sample_weights=weights, mode="sum"))
    total = torch.cat(sums)
    return average(total, continuous), (total != 0.0).any(1)


def default_neighbours(task: TaskSpace) -> int:
    """How many nearest vertices are averaged over: 24 in the plane, 64 in space; 2 edges away where rotation varies."""
    if task.rotations is not None:
        return 2
    return 24 if task.dimension == 2 else 64
