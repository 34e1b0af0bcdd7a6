"""Random-GRR, the baseline: random configurations at every vertex, and a constraint solver that picks one of each.

After K. Hauser and S. Emmons (2018), as the paper describes it (Section V-A): numerous random configurations a vertex,
pairs of neighbouring vertices' configurations that pass the continuity test, then a constraint satisfaction problem.
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
from grr_torch.projection.project import DEFAULT_TOLERANCES, Tolerances, project_columns
from grr_torch.resolution.reachability import within_reach
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import difference
from grr_torch.spaces.graph import TaskGraph
from grr_torch.spaces.task import TaskSpace

# random starts of a vertex in a round, and rounds in all; a vertex that none of the first reached is left out
_STARTS = 40
_ROUNDS = 12
# pairs of configurations whose continuity is checked together
_PAIRS_AT_ONCE = 1 << 16
# pairs of configurations whose compatibility is held, a byte each
_MOST_PAIRS = 4_000_000_000
# moves of the solver: of a descent, for every vertex; and descents
_MOVES = 1500
_DESCENTS = 4
# share of moves to a random value, which leads out of dead ends
_RANDOM_MOVES = 0.1


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
    samples: int = 100,
    nearest: int = 6,
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
        nearest: Of each configuration, so many of the nearest ones at a neighbouring vertex are tested.
        seed: Of all random draws.
        tolerances: Of the projections.
        progress: Told what is being done and how far it is.

    Raises:
        ParameterError: `samples` or `nearest` is below 1.
    """
    most = max(1, math.isqrt(_MOST_PAIRS // max(1, len(graph.edges))))
    if not 1 <= samples <= most:
        raise ParameterError("samples", samples, f"1 to {most} for {len(graph.edges):,} edges")
    if nearest < 1:
        raise ParameterError("nearest", nearest, "1 or more")
    generator = torch.Generator().manual_seed(check_seed(seed))
    pool, counts = _sample(robot, task, graph, samples, tolerances, generator, progress)
    edges = (counts[graph.edges] > 0).all(1).nonzero()[:, 0]
    compatible = _test_pairs(robot, task, graph, edges, pool, min(nearest, samples), tolerances, progress)
    solver = _MinConflicts(graph.edges[edges].numpy(), compatible.numpy(), counts.numpy(), np.random.default_rng(seed))
    values = torch.from_numpy(solver.solve(progress))
    configurations = pool[torch.arange(len(pool)), values]
    first, second = graph.edges[edges].unbind(1)
    connected = torch.zeros(len(graph.edges), dtype=torch.bool)
    connected[edges] = compatible[torch.arange(len(edges)), values[first], values[second]]
    return RandomMap(configurations, connected)


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
        guesses = robot.sample(len(vertices) * _STARTS, generator)
        targets = graph.points[vertices].repeat_interleave(_STARTS, dim=0).to(guesses)
        solved, valid = project_columns(robot, task, targets.T.contiguous(), guesses.T.contiguous(), tolerances)
        valid = valid.cpu().reshape(len(vertices), _STARTS)
        rank = counts[vertices, None] + valid.cumsum(1) - 1
        kept = valid & (rank < samples)
        rows = vertices[:, None].expand_as(rank)
        pool[rows[kept], rank[kept]] = solved.T.cpu().reshape(len(vertices), _STARTS, robot.n)[kept]
        counts[vertices] = (counts[vertices] + valid.sum(1)).clamp(max=samples)
        open_vertices = open_vertices & (counts > 0)
    progress("sampling", _ROUNDS, _ROUNDS)
    return pool, counts


def _test_pairs(
    robot: Robot,
    task: TaskSpace,
    graph: TaskGraph,
    edges: Tensor,
    pool: Tensor,
    nearest: int,
    tolerances: Tolerances,
    progress: Progress,
) -> Tensor:
    """(E, samples, samples) bool: pairs of an edge's configurations that pass the continuity test."""
    samples = pool.shape[1]
    compatible = torch.zeros(len(edges), samples, samples, dtype=torch.bool)
    wraps = robot.continuous.cpu()
    at_once = max(1, _PAIRS_AT_ONCE // (2 * samples * nearest))
    for start in range(0, len(edges), at_once):
        progress("testing pairs", start, len(edges))
        part = edges[start : start + at_once]
        first, second = graph.edges[part].unbind(1)
        apart = difference(pool[first][:, :, None], pool[second][:, None], wraps).square().sum(-1).nan_to_num(torch.inf)
        close = torch.zeros_like(apart, dtype=torch.bool)
        close.scatter_(2, apart.topk(nearest, dim=2, largest=False).indices, True)
        close.scatter_(1, apart.topk(nearest, dim=1, largest=False).indices, True)
        edge, i, j = (close & apart.isfinite()).nonzero().unbind(1)
        passed = is_continuous(
            robot,
            task,
            graph.points[first[edge]],
            graph.points[second[edge]],
            pool[first[edge], i],
            pool[second[edge], j],
            tolerances=tolerances,
        ).cpu()
        compatible[start + edge[passed], i[passed], j[passed]] = True
    progress("testing pairs", len(edges), len(edges))
    return compatible


class _MinConflicts:
    """Picks a value for every variable so that as many constraints hold as possible.

    Min-conflicts with random descents: a variable with a broken constraint takes the value that breaks fewest, ties
    and now and then a value at random; the best assignment of several descents is kept.
    """

    def __init__(self, edges: np.ndarray, compatible: np.ndarray, counts: np.ndarray, random: np.random.Generator):
        self.edges, self.compatible, self.counts, self.random = edges, compatible, counts, random
        variables, values = len(counts), compatible.shape[1]
        self.size = (variables, values)
        around: list[list[tuple[int, int, bool]]] = [[] for _ in range(variables)]
        for edge, (a, b) in enumerate(edges.tolist()):
            around[a].append((edge, b, True))
            around[b].append((edge, a, False))
        self.around = around

    def solve(self, progress: Progress) -> np.ndarray:
        """(V,) values."""
        best, most = np.zeros(self.size[0], dtype=np.int64), -1
        for descent in range(_DESCENTS):
            progress("solving constraints", descent, _DESCENTS)
            values = self._descend()
            held = int(self._held(values).sum())
            if held > most:
                best, most = values, held
            if most == len(self.edges):
                break
        progress("solving constraints", _DESCENTS, _DESCENTS)
        return best

    def _held(self, values: np.ndarray) -> np.ndarray:
        first, second = self.edges.T
        return self.compatible[np.arange(len(self.edges)), values[first], values[second]]

    def _descend(self) -> np.ndarray:
        values = self.random.integers(0, np.maximum(self.counts, 1))
        scores = np.zeros(self.size, dtype=np.int64)
        scores[np.arange(self.size[1]) >= self.counts[:, None]] = -(10**6)
        first, second = self.edges.T
        order = np.arange(len(self.edges))
        np.add.at(scores, first, self.compatible[order, :, values[second]])
        np.add.at(scores, second, self.compatible[order, values[first], :])
        degree = np.bincount(self.edges.ravel(), minlength=self.size[0])
        best, most = values.copy(), -1
        for _ in range(_MOVES):
            held = scores[np.arange(self.size[0]), values]
            conflicted = np.flatnonzero((held < degree) & (degree > 0))
            if int(held[degree > 0].sum()) > most:
                best, most = values.copy(), int(held[degree > 0].sum())
            if len(conflicted) == 0:
                break
            for variable in self.random.permutation(conflicted).tolist():
                self._move(variable, values, scores)
        return best

    def _move(self, variable: int, values: np.ndarray, scores: np.ndarray) -> None:
        row = scores[variable]
        old = int(values[variable])
        if self.random.random() < _RANDOM_MOVES:
            new = int(self.random.integers(0, self.counts[variable]))
        else:
            new = int(self.random.choice(np.flatnonzero(row == row.max())))
        if new == old:
            return
        values[variable] = new
        for edge, other, is_first in self.around[variable]:
            table = self.compatible[edge] if is_first else self.compatible[edge].T
            scores[other] += table[new].astype(np.int64) - table[old]
