"""Shortest paths in the roadmap G_q."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from torch import Tensor

from grr_torch.pieces import Array, norms
from grr_torch.spaces.configuration import difference

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap

# goals, with the edges that are avoided on the way, whose shortest paths are remembered at most, and what those may
# take in all [bytes]
_GOALS, _REMEMBERED = 256, 1 << 29
# of a vertex, a length and the next vertex [bytes]
_VERTEX = 12


class Routes:
    """Shortest paths along connected edges: by D_q, unless told otherwise.

    Attributes:
        part: (V,) the connected part of the roadmap that a vertex lies in.
    """

    def __init__(
        self, roadmap: Roadmap, open_edges: Tensor | None = None, length: Callable[[Array], Array] = norms
    ) -> None:
        """Makes the graph.

        Args:
            roadmap: The roadmap.
            open_edges: (E,) bool, the edges that routes may take; by default the connected ones.
            length: Of joint motions (E, n), how long they are (E,).
        """
        first, second = roadmap.edges[roadmap.connected if open_edges is None else open_edges].T
        q = roadmap.configurations
        lengths = length(difference(q[first], q[second], roadmap.robot.continuous.cpu()).numpy())
        vertices = len(roadmap.points)
        # equal configurations are not the absence of an edge
        lengths = np.maximum(lengths, 1e-9)
        self._graph = csr_matrix((lengths, (first.numpy(), second.numpy())), shape=(vertices, vertices))
        self.part: np.ndarray = connected_components(self._graph, directed=False)[1]
        fitting = _REMEMBERED // (_VERTEX * max(1, vertices))
        self.towards = lru_cache(min(_GOALS, max(1, fitting)))(self._towards)

    def _towards(self, goal: int, avoided: frozenset[tuple[int, int]] = frozenset()) -> tuple[np.ndarray, np.ndarray]:
        """Shortest paths to a vertex.

        Args:
            goal: The vertex.
            avoided: Pairs of vertices whose edges no path may take.

        Returns:
            Lengths (V,), as edges are measured, inf where there is no path, and the next vertex (V,) on it, negative
            at the goal and where there is none.
        """
        graph = self._graph
        if avoided:
            lengths = graph.data.copy()
            for pair in avoided:
                row = slice(*graph.indptr[min(pair) : min(pair) + 2])
                lengths[row][graph.indices[row] == max(pair)] = np.inf
            graph = csr_matrix((lengths, graph.indices, graph.indptr), shape=graph.shape)
        return dijkstra(graph, directed=False, indices=goal, return_predecessors=True)

    def between(self, start: int, goal: int) -> list[int]:
        """Vertices of a shortest path, both ends included; empty if there is none."""
        following = self.towards(goal)[1]
        if start != goal and following[start] < 0:
            return []
        path = [start]
        while path[-1] != goal:
            path.append(int(following[path[-1]]))
        return path


def part_sizes(roadmap: Roadmap) -> list[int]:
    """How many resolved vertices each connected part of a roadmap has, the largest first.

    There is no path between vertices of different parts.
    """
    counts = np.bincount(roadmap.routes.part[roadmap.resolved.numpy()])
    sizes: list[int] = sorted(counts[counts > 0].tolist(), reverse=True)
    return sizes
