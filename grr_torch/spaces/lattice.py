"""The arithmetic of a staggered grid: which vertices lie round another one, without a search."""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Lattice:
    """Corners of a grid of cells, and behind them the cells' centres, both in C order.

    In units of half a cell, a corner has even coordinates and a centre odd ones. So the same displacements, all even
    or all odd, lead from any vertex to its neighbours.

    Attributes:
        cells: How many cells there are along each axis.
        spacing: Their lengths [m].
    """

    cells: tuple[int, ...]
    spacing: tuple[float, ...]

    def neighbours(self, vertices: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """Indices (F, K) and distances (F, K) [m] of the k nearest vertices, as `TaskGraph.neighbours` gives them."""
        displacements, lengths = (part.to(vertices.device) for part in _stencil(self, k))
        index = vertices.new_zeros(len(vertices), len(lengths))
        inside = torch.ones_like(index, dtype=torch.bool)
        corners = math.prod(count + 1 for count in self.cells)
        is_centre = vertices >= corners
        to_centre = (is_centre[:, None] + displacements[:, 0]) % 2 == 1
        for axis, coordinate in enumerate(self._coordinates(vertices)):
            place = coordinate[:, None] + displacements[:, axis]
            inside &= (place >= 0) & (place <= 2 * self.cells[axis])
            index = torch.where(to_centre, index * self.cells[axis], index * (self.cells[axis] + 1)) + (place >> 1)
        index = torch.where(to_centre, index + corners, index)
        return torch.where(inside, index, 0), torch.where(inside, lengths, torch.inf)

    def faces(self) -> Tensor:
        """(Q, 4) corners round every face of a cell, in space; in the plane, edges split all faces: (0, 4)."""
        counts = [count + 1 for count in self.cells]
        corner = torch.arange(math.prod(counts)).reshape(counts)
        if len(counts) < 3:
            return corner.new_empty(0, 4)
        rings: list[Tensor] = []
        for first, second in itertools.combinations(range(len(counts)), 2):
            along = [corner.narrow(first, shift, self.cells[first]) for shift in (0, 1)]
            low, high = ([part.narrow(second, s, self.cells[second]).flatten() for s in (0, 1)] for part in along)
            rings.append(torch.stack([low[0], high[0], high[1], low[1]], dim=1))
        return torch.cat(rings)

    def _coordinates(self, vertices: Tensor) -> list[Tensor]:
        """(F,) coordinates of vertices along each axis, in half cells."""
        corners = math.prod(count + 1 for count in self.cells)
        is_centre = vertices >= corners
        rest = torch.where(is_centre, vertices - corners, vertices)
        coordinates: list[Tensor] = []
        for count in self.cells[::-1]:
            size = torch.where(is_centre, count, count + 1)
            coordinates.append(2 * (rest % size) + is_centre.long())
            rest = rest // size
        return coordinates[::-1]


@functools.lru_cache(maxsize=32)
def _stencil(lattice: Lattice, k: int) -> tuple[Tensor, Tensor]:
    """Displacements (K, d) in half cells and their lengths (K,) [m], nearest first; none longer than the grid."""
    limits = [2 * count for count in lattice.cells]
    half = [0.5 * length for length in lattice.spacing]
    reach = 2
    while True:
        axes = [range(-min(reach, limit), min(reach, limit) + 1) for limit in limits]
        offsets = [o for o in itertools.product(*axes) if any(o) and len({axis % 2 for axis in o}) == 1]
        lengths = [math.hypot(*(a * s for a, s in zip(o, half, strict=True))) for o in offsets]
        order = sorted(range(len(offsets)), key=lambda i: (lengths[i], offsets[i]))
        # whatever lies outside the box is farther than the nearest face that can still move out
        growing = [(reach + 1) * s for s, limit in zip(half, limits, strict=True) if reach < limit]
        if not growing or (len(order) >= k and lengths[order[k - 1]] < min(growing)):
            break
        reach += 1
    last = lengths[order[min(k, len(order)) - 1]] * (1.0 + 1e-9)
    order = [i for i in order if lengths[i] <= last]
    return torch.tensor([offsets[i] for i in order]), torch.tensor([lengths[i] for i in order], dtype=torch.float64)
