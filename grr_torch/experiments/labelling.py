"""Which label each vertex of a graph takes, so that the sum of its edges' costs is least: TRW-S, with a bound.

Sequential tree-reweighted message passing: V. Kolmogorov, Convergent Tree-reweighted Message Passing for Energy
Minimization, 2006. Vertices tell their edges, level by level there and back, what their labels cost.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from grr_torch.resolution.roadmap import Roadmap

# entries of tables that are worked on together
ENTRIES = 1 << 24


class Graph(NamedTuple):
    """Edges (E,) between vertices (V,), `low` before `high`; vertices of one level share none.

    Attributes:
        low: (E,) one end.
        high: (E,) the other.
        lengths: (E,) D_p.
        levels: (V,) longest chain of edges that ends at a vertex.
        shares: (V,) of what a vertex is told, how much it tells each edge: 1 / max(edges before, edges behind).
    """

    low: Tensor
    high: Tensor
    lengths: Tensor
    levels: Tensor
    shares: Tensor

    @staticmethod
    def of(roadmap: Roadmap, vertices: Tensor, device: torch.device) -> Graph:
        """Of a roadmap's resolved vertices."""
        rank = torch.full((len(roadmap.points),), -1).index_put_((vertices,), torch.arange(len(vertices)))
        edges = roadmap.edges[roadmap.resolved[roadmap.edges].all(1)]
        first, second = roadmap.points[edges].unbind(1)
        lengths = roadmap.task.distance(first, second).float()
        low, high = rank[edges].sort(dim=1).values.unbind(1)
        levels = torch.zeros(len(vertices), dtype=torch.long)
        while not torch.equal(levels, raised := levels.scatter_reduce(0, high, levels[low] + 1, "amax")):
            levels = raised
        before, behind = (end.bincount(minlength=len(vertices)) for end in (high, low))
        shares = 1.0 / torch.maximum(before, behind).clamp_min(1)
        return Graph(*(part.to(device) for part in (low, high, lengths, levels, shares.float())))


@dataclass(frozen=True)
class _Level:
    """Vertices (K,) that share no edge, and their edges to higher and to lower levels."""

    vertices: Tensor
    out: Tensor
    into: Tensor


class Search:
    """Message passing over tables (E, L, L) of costs, by the labels of the edges' low and high ends.

    Attributes:
        best: Smallest sum of a choice so far.
        chosen: (V,) that choice; at first, each vertex's first label.
        bound: Largest lower bound of the sum so far.
    """

    def __init__(self, graph: Graph, tables: Tensor) -> None:
        self._graph, self._tables = graph, tables
        # what the low and the high end of each edge were told of their labels
        self._told = tables.new_zeros(2, len(graph.low), tables.shape[1])
        self._levels = []
        # of a vertex within its level
        self._place = torch.empty_like(graph.levels)
        lows, highs = graph.levels[graph.low], graph.levels[graph.high]
        for level in range(int(graph.levels.max()) + 1):
            members = (graph.levels == level).nonzero()[:, 0]
            self._place[members] = torch.arange(len(members), device=members.device)
            ends = ((lows == level).nonzero()[:, 0], (highs == level).nonzero()[:, 0])
            self._levels.append(_Level(members, *ends))
        self.chosen = torch.zeros_like(graph.levels)
        self.best, self.bound = self._sum(self.chosen), 0.0

    def go_on(self) -> None:
        """Once up all levels, which gives a choice, and once down, which gives a bound."""
        graph = self._graph
        chosen = torch.zeros_like(self.chosen)
        for level in self._levels:
            given = self._tables[level.into, chosen[graph.low[level.into]]]
            told = self._told[0, level.out]
            chosen[level.vertices] = self._sums(level, told, given).argmin(1)
            self._tell(1, level.out, self._heard(level)[self._place[graph.low[level.out]]])
        if (found := self._sum(chosen)) < self.best:
            self.best, self.chosen = found, chosen
        bound = 0.0
        for level in reversed(self._levels):
            heard = self._heard(level)
            least = heard.amin(1, keepdim=True)
            bound += float(least.double().sum())
            bound += self._tell(0, level.into, (heard - least)[self._place[graph.high[level.into]]])
        self.bound = max(self.bound, bound)

    def _heard(self, level: _Level) -> Tensor:
        """(K, L) all that the vertices of a level were told."""
        return self._sums(level, self._told[0, level.out], self._told[1, level.into])

    def _sums(self, level: _Level, out: Tensor, into: Tensor) -> Tensor:
        """(K, L) sums over the edges of a level's vertices."""
        sums = self._tables.new_zeros(len(level.vertices), self._tables.shape[1])
        sums.index_add_(0, self._place[self._graph.low[level.out]], out)
        return sums.index_add_(0, self._place[self._graph.high[level.into]], into)

    def _tell(self, end: int, edges: Tensor, heard: Tensor) -> float:
        """Tells one end of edges (K,), low or high, what the other makes of what it heard (K, L); the sum of least."""
        shares = self._graph.shares[self._graph.low if end else self._graph.high][edges]
        offered = shares[:, None] * heard - self._told[1 - end, edges]
        total, size = 0.0, max(1, ENTRIES // self._tables.shape[1] ** 2)
        for part, offer in zip(edges.split(size), offered.split(size), strict=True):
            costs = self._tables[part]
            costs += offer[:, :, None] if end else offer[:, None]
            told = costs.amin(1 if end else 2)
            least = told.amin(1, keepdim=True)
            self._told[end, part] = told - least
            total += float(least.double().sum())
        return total

    def _sum(self, chosen: Tensor) -> float:
        edges = torch.arange(len(self._tables), device=chosen.device)
        return float(self._tables[edges, chosen[self._graph.low], chosen[self._graph.high]].double().sum())
