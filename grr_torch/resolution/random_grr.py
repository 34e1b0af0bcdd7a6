"""Random-GRR, the baseline: random configurations at every vertex, and a constraint solver that picks one of each.

After K. Hauser and S. Emmons (2018), as the paper describes it (Section V-A): numerous random configurations a vertex,
pairs of neighbouring vertices' configurations that pass the continuity test, then a constraint satisfaction problem.
To test all pairs would take hours, so the nearest are tested, and round the edges that the solver leaves broken more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from grr_torch.errors import ParameterError, check_seed
from grr_torch.progress import Progress, silent
from grr_torch.projection.continuity import is_continuous
from grr_torch.projection.project import DEFAULT_TOLERANCES, Tolerances
from grr_torch.resolution.constraints import Constraints
from grr_torch.resolution.reachability import from_random_starts, within_reach
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import difference
from grr_torch.spaces.graph import TaskGraph
from grr_torch.spaces.task import TaskSpace

# configurations of a vertex, unless told otherwise
SAMPLES = 100
# random starts of a vertex in a round, and rounds in all; a vertex that none of the first reached is left out
_STARTS = 40
_ROUNDS = 12
# pairs of configurations whose continuity is checked together
_PAIRS_AT_ONCE = 1 << 16
# pairs of configurations whose compatibility is held, two bytes each
_MOST_PAIRS = 2_000_000_000
# turns of the solver, and in each so many descents that start anew besides the one from the best
_TURNS = 6
_RESTARTS = 3
# after each turn, so many times as many of the nearest are tested round broken edges
_WIDER = 8


@dataclass(frozen=True)
class RandomMap:
    """What the solver picked.

    Attributes:
        configurations: (V, n), NaN where no configuration was found.
        connected: (E,) edges whose pair passed the continuity test.
    """

    configurations: Tensor
    connected: Tensor

    @property
    def wave(self) -> Tensor:
        """(V,) 0 where there is a configuration, else −1: all at once."""
        return torch.where(self.configurations.isnan().any(1), -1, 0).to(torch.int32)


def random_grr(
    robot: Robot,
    task: TaskSpace,
    graph: TaskGraph,
    *,
    samples: int = SAMPLES,
    nearest: int | None = None,
    seed: int = 0,
    tolerances: Tolerances = DEFAULT_TOLERANCES,
    progress: Progress = silent,
) -> RandomMap:
    """Resolves a task graph at random.

    Args:
        robot: The robot.
        task: The task space.
        graph: The task graph.
        samples: Configurations of a vertex.
        nearest: Of each configuration, so many of the nearest ones at a neighbouring vertex are tested; by default 6
            in the plane and 2 in space, where a vertex has more neighbours.
        seed: Of all random draws.
        tolerances: Of the projections.
        progress: Told what is being done and how far it is.

    Raises:
        ParameterError: `samples` or `nearest` is below 1.
    """
    most = max(1, math.isqrt(_MOST_PAIRS // max(1, len(graph.edges))))
    if not 1 <= samples <= most:
        raise ParameterError("samples", samples, f"1 to {most} for {len(graph.edges):,} edges")
    if nearest is None:
        nearest = 6 if task.dimension == 2 else 2
    if nearest < 1:
        raise ParameterError("nearest", nearest, "1 or more")
    generator = torch.Generator().manual_seed(check_seed(seed))
    pool, counts = _sample(robot, task, graph, samples, tolerances, generator, progress)
    edges = (counts[graph.edges] > 0).all(1).nonzero()[:, 0]
    table = _PairTable(robot, task, graph.points, graph.edges[edges], pool, tolerances)
    table.test_nearest(min(nearest, samples), progress)
    values = _solve(table, counts, min(_WIDER * nearest, samples), np.random.default_rng(seed), progress)
    connected = torch.zeros(len(graph.edges), dtype=torch.bool)
    connected[edges] = table.held(values)
    return RandomMap(pool[torch.arange(len(pool)), values], connected)


def _solve(table: _PairTable, counts: Tensor, wider: int, random: np.random.Generator, progress: Progress) -> Tensor:
    """(V,) which configuration each vertex takes."""
    constraints = Constraints(table.edges.numpy(), table.compatible.numpy(), counts.numpy())
    best = constraints.grow(random)
    for turn in range(_TURNS):
        progress("solving constraints", turn, _TURNS)
        starts = [best, *(constraints.grow(random) for _ in range(_RESTARTS))]
        descents = [best, *(constraints.descend(start, random) for start in starts)]
        best = max(descents, key=lambda values: int(constraints.held(values).sum()))
        if bool(constraints.held(best).all()):
            break
        table.test_round_broken(torch.from_numpy(best), wider)
    progress("solving constraints", _TURNS, _TURNS)
    return torch.from_numpy(best)


def _sample(
    robot: Robot,
    task: TaskSpace,
    graph: TaskGraph,
    samples: int,
    tolerances: Tolerances,
    generator: torch.Generator,
    progress: Progress,
) -> tuple[Tensor, Tensor]:
    """Valid configurations (V, samples, n), NaN beyond each vertex's count (V,)."""
    pool = torch.full((len(graph.points), samples, robot.n), torch.nan, dtype=robot.dtype)
    counts = torch.zeros(len(graph.points), dtype=torch.long)
    open_vertices = within_reach(robot, task, graph.points)
    for turn in range(_ROUNDS):
        progress("sampling", turn, _ROUNDS)
        vertices = (open_vertices & (counts < samples)).nonzero()[:, 0]
        if len(vertices) == 0:
            break
        solved, valid = from_random_starts(robot, task, graph.points[vertices], _STARTS, generator, tolerances)
        rank = counts[vertices, None] + valid.cumsum(1) - 1
        kept = valid & (rank < samples)
        rows = vertices[:, None].expand_as(rank)
        pool[rows[kept], rank[kept]] = solved[kept]
        counts[vertices] = (counts[vertices] + valid.sum(1)).clamp(max=samples)
        open_vertices = open_vertices & (counts > 0)
    progress("sampling", _ROUNDS, _ROUNDS)
    return pool, counts


class _PairTable:
    """Which pairs of neighbouring vertices' configurations pass the continuity test, as far as it is known.

    Attributes:
        edges: (E, 2) vertices.
        compatible: (E, samples, samples) bool, pairs that passed.
    """

    def __init__(
        self, robot: Robot, task: TaskSpace, points: Tensor, edges: Tensor, pool: Tensor, tolerances: Tolerances
    ):
        self.robot, self.task, self.points, self.tolerances = robot, task, points, tolerances
        self.edges, self.pool = edges, pool
        samples = pool.shape[1]
        self.compatible = torch.zeros(len(edges), samples, samples, dtype=torch.bool)
        self._tested = torch.zeros_like(self.compatible)

    def held(self, values: Tensor) -> Tensor:
        """(E,) edges whose pair passed, for the configurations (V,) that vertices take."""
        first, second = self.edges.unbind(1)
        return self.compatible[torch.arange(len(self.edges)), values[first], values[second]]

    def test_nearest(self, nearest: int, progress: Progress) -> None:
        """Tests, of each configuration, so many of the nearest at a neighbouring vertex."""
        samples = self.pool.shape[1]
        at_once = max(1, _PAIRS_AT_ONCE // (2 * samples * nearest))
        for start in range(0, len(self.edges), at_once):
            progress("testing pairs", start, len(self.edges))
            first, second = (self.pool[ends] for ends in self.edges[start : start + at_once].unbind(1))
            apart = self._apart(first[:, :, None], second[:, None])
            close = torch.zeros_like(apart, dtype=torch.bool)
            for axis in (1, 2):
                close.scatter_(axis, apart.topk(nearest, dim=axis, largest=False).indices, True)
            edge, i, j = (close & apart.isfinite()).nonzero().unbind(1)
            self._test(start + edge, i, j)
        progress("testing pairs", len(self.edges), len(self.edges))

    def test_round_broken(self, values: Tensor, nearest: int) -> None:
        """Tests what else the ends of broken edges could take, against what their neighbours have.

        Args:
            values: (V,) the configuration that each vertex takes.
            nearest: Of a vertex's configurations, so many of the nearest to the neighbour's are tested.
        """
        wanted = torch.zeros(len(values), dtype=torch.bool)
        wanted[self.edges[~self.held(values)]] = True
        for side in (0, 1):
            edge = wanted[self.edges[:, side]].nonzero()[:, 0]
            own, other = self.edges[edge, side], self.edges[edge, 1 - side]
            apart = self._apart(self.pool[own], self.pool[other, values[other]][:, None])
            near, taken = apart.topk(nearest, dim=1, largest=False)
            pairs = (taken.flatten(), values[other].repeat_interleave(nearest))
            i, j = pairs if side == 0 else pairs[::-1]
            edge = edge.repeat_interleave(nearest)
            new = near.flatten().isfinite() & ~self._tested[edge, i, j]
            self._test(edge[new], i[new], j[new])

    def _apart(self, first: Tensor, second: Tensor) -> Tensor:
        """Squared distances of configurations; inf where there is none."""
        apart = difference(first, second, self.robot.continuous.cpu()).square().sum(-1)
        return apart.nan_to_num(torch.inf)

    def _test(self, edge: Tensor, i: Tensor, j: Tensor) -> None:
        for part in torch.stack([edge, i, j]).split(_PAIRS_AT_ONCE, dim=1):
            edge, i, j = part
            a, b = self.edges[edge].unbind(1)
            ends = self.points[a], self.points[b], self.pool[a, i], self.pool[b, j]
            passed = is_continuous(self.robot, self.task, *ends, tolerances=self.tolerances).cpu()
            self.compatible[edge, i, j] = passed
            self._tested[edge, i, j] = True
