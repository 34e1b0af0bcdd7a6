"""Which resolved vertices connected edges join, and which of a few hang together."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from grr_torch.pieces import some

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap

# the most vertices of which a matrix of neighbours is made: 16 MiB
MATRIX = 4096


class Joined:
    """Looks up edges between resolved vertices: in a matrix, or of many vertices in the roadmap's rows."""

    def __init__(self, roadmap: Roadmap, vertices: Tensor) -> None:
        """For the resolved vertices (R,) of a roadmap."""
        self._vertices = vertices.numpy()
        self._neighbours = tuple(part.numpy() for part in roadmap.neighbours)
        self._matrix = _neighbour_matrix(roadmap, vertices).numpy() if len(vertices) <= MATRIX else None

    def one_part(self, nearest: NDArray[Any], counts: NDArray[np.bool_], of_nearest: bool) -> NDArray[np.bool_]:
        """Which of vertices (N, k) lie in the largest part that edges among them connect; the nearest of equals.

        A set of them is a number: vertex j is its bit j.

        Args:
            nearest: (N, k) ranks among the vertices.
            counts: (N, k) which of them count; the others are in no part.
            of_nearest: Whether the part of the first one is wanted instead.
        """
        k = nearest.shape[1]
        if self._matrix is not None:
            joined = self._matrix.take(nearest[:, :, None] * len(self._vertices) + nearest[:, None, :])
        else:
            near = self._vertices[nearest]
            joined = (self._ends(near)[..., None] == near[:, None, None, :]).any(2)
        bits = 1 << np.arange(k)
        counted = counts @ bits
        around = np.where(counts, (joined @ bits | bits) & counted[:, None], 0)
        # most points have all of them in one part: what the first is joined to, and so on
        part, before = around[:, 0], around[:, 0] * 0
        while some(part != before):
            before = part
            part = np.bitwise_or.reduce(np.where(part[:, None] & bits, around, 0), axis=1)
        left = (part != counted).nonzero()[0]
        if len(left) and not of_nearest:
            # Warshall's closure: whoever is joined to j is joined to all that j is joined to
            closed = around[left]
            for j in range(k):
                closed |= np.where(closed >> j & 1, closed[:, j : j + 1], 0)
            sizes = (closed[:, :, None] >> np.arange(k) & 1).sum(2)
            part[left] = np.take_along_axis(closed, sizes.argmax(1)[:, None], axis=1)[:, 0]
        return part[:, None] & bits != 0

    def _ends(self, vertices: NDArray[Any]) -> NDArray[Any]:
        """(N, k, D) neighbours along connected edges of vertices (N, k); −1 where there are fewer."""
        starts, ends = self._neighbours
        first = starts[vertices]
        counts = starts[vertices + 1] - first
        column = np.arange(max(1, int(counts.max()) if counts.size else 1))
        if len(ends) == 0:
            return np.full((*vertices.shape, 1), -1)
        index = np.minimum(first[..., None] + column, len(ends) - 1)
        return np.where(column < counts[..., None], ends[index], -1)


def _neighbour_matrix(roadmap: Roadmap, vertices: Tensor) -> Tensor:
    """(R, R) bool, which resolved vertices a connected edge joins: faster to look up, where it is not too large."""
    rank = torch.full((len(roadmap.points),), -1)
    rank[vertices] = torch.arange(len(vertices))
    first, second = rank[roadmap.edges[roadmap.connected]].T
    joined = torch.zeros(len(vertices), len(vertices), dtype=torch.bool)
    joined[first, second] = True
    joined[second, first] = True
    return joined
