"""The arithmetic of a staggered grid: which vertices lie round another one, without a search."""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from grr_torch.devices import OnDevices


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
        displacements, lengths = _stencil(self, k).at(vertices.device)
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

    def pyramids(self, offsets: Tensor) -> Tensor:
        """(N,) the pyramid that each point lies in: a cell's centre over one of its faces; −1 outside the grid.

        In the plane, pyramids are the triangles of a centre and an edge. A cell has 2d of them, counted by axis, the
        lower face first.

        Args:
            offsets: (N, d) points as seen from the grid's first corner [m].
        """
        cells = np.array(self.cells)
        steps = offsets.cpu().numpy() / np.array(self.spacing)
        # what rounding puts outside still counts
        inside = ((steps > -1e-9) & (steps < cells + 1e-9)).all(1)
        cell = np.minimum(np.maximum(steps, 0.0), cells - 1).astype(np.int64)
        from_centre = steps - cell - 0.5
        axis = np.abs(from_centre).argmax(1)
        upper = np.take_along_axis(from_centre, axis[:, None], axis=1)[:, 0] > 0
        strides = np.cumprod([1, *self.cells[:0:-1]])[::-1]
        index = 2 * len(self.cells) * (cell @ strides) + 2 * axis + upper
        return torch.from_numpy(np.where(inside, index, -1)).to(offsets.device)

    def pyramids_at(self, corners: Tensor) -> Tensor:
        """(P,) the pyramids that triangles (C, 3), smallest vertex first, or square faces (C, 4) bound."""
        count, sides = corners.shape
        d = len(self.cells)
        place = torch.stack(self._coordinates(corners.reshape(-1)), dim=-1).reshape(count, sides, d)
        if sides == 3:
            # an edge and a centre: the edge lies on one face of the centre's cell in the plane, on two in space
            centre = place[:, 2]
            ends = place[:, :2] - centre[:, None]
            which, axis = (ends[:, 0] == ends[:, 1]).nonzero().unbind(1)
            return self._pyramid(centre[which], axis, ends[which, 0, axis] > 0)
        low, high = place.amin(1), place.amax(1)
        axis = (low == high).long().argmax(1)
        found: list[Tensor] = []
        for upper in (False, True):
            centre = (low + high) // 2 + (1 - 2 * upper) * torch.nn.functional.one_hot(axis, d)
            level = centre.gather(1, axis[:, None])[:, 0]
            inside = (level > 0) & (level < 2 * torch.tensor(self.cells, device=corners.device)[axis])
            found.append(self._pyramid(centre[inside], axis[inside], upper))
        return torch.cat(found)

    def _pyramid(self, centre: Tensor, axis: Tensor, upper: Tensor | bool) -> Tensor:
        """Pyramids over faces of cells, whose centres (P, d) are given in half cells."""
        cell = torch.zeros_like(axis)
        for count, coordinate in zip(self.cells, centre.unbind(1), strict=True):
            cell = cell * count + (coordinate >> 1)
        return 2 * len(self.cells) * cell + 2 * axis + upper

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
def _stencil(lattice: Lattice, k: int) -> OnDevices:
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
    chosen, far = [offsets[i] for i in order], [lengths[i] for i in order]
    return OnDevices(torch.tensor(chosen), torch.tensor(far, dtype=torch.float64))
