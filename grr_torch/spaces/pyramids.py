"""The pyramids of a staggered grid: their corners, and weights of these that are continuous over the whole grid.

A pyramid is a cell's centre over one of its faces, in the plane the triangle of a centre and an edge. Its index is
that of `Lattice.pyramids`.
"""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from grr_torch.spaces.lattice import Lattice

# of a half cell: below this distance from a centre, directions do not count
_AT_CENTRE = 1e-12


def pyramid_corners(lattice: Lattice, pyramids: Tensor | None = None) -> Tensor:
    """(P, K) vertices of pyramids (P,): the corners of the face, the last axis fastest, and behind them the centre.

    K is 3 in the plane and 5 in space. By default, of all pyramids.
    """
    d, corners = len(lattice.cells), math.prod(count + 1 for count in lattice.cells)
    if pyramids is None:
        pyramids = torch.arange(2 * d * math.prod(lattice.cells))
    cell, axis, upper = pyramids // (2 * d), pyramids % (2 * d) // 2, pyramids % 2
    first, rest, strides, stride = torch.zeros_like(cell), cell, [0] * d, 1
    for k in range(d - 1, -1, -1):
        strides[k] = stride
        first += rest % lattice.cells[k] * stride
        rest, stride = rest // lattice.cells[k], stride * (lattice.cells[k] + 1)
    shifts = torch.tensor(
        [
            [sum(s * step for s, step in zip(shift, strides[:k] + strides[k + 1 :], strict=True)) for k in range(d)]
            for shift in itertools.product((0, 1), repeat=d - 1)
        ]
    )
    first = first + upper * torch.tensor(strides)[axis]
    return torch.cat([first[:, None] + shifts.T[axis], corners + cell[:, None]], dim=1)


def whole_pyramids(lattice: Lattice, counts: Tensor) -> Tensor:
    """(P,) bool, the pyramids all of whose corners are among the vertices (V,) that count."""
    d, corners = len(lattice.cells), math.prod(count + 1 for count in lattice.cells)
    corner = counts[:corners].reshape([count + 1 for count in lattice.cells])
    centre = counts[corners:].reshape(lattice.cells)
    whole = centre[..., None].repeat(*[1] * d, 2 * d)
    for axis, upper in itertools.product(range(d), (0, 1)):
        for shift in itertools.product((0, 1), repeat=d - 1):
            shifts = (*shift[:axis], upper, *shift[axis:])
            window = tuple(slice(s, s + count) for s, count in zip(shifts, lattice.cells, strict=True))
            whole[..., 2 * axis + upper] &= corner[window]
    return whole.flatten()


def pyramid_weights(lattice: Lattice, offsets: Tensor, pyramids: Tensor) -> Tensor:
    """Barycentric weights (N, K) of the corners of the pyramids that points lie in. Differentiable.

    They are not negative, add up to 1, and give back the point. On a face only the weights of its own corners are not
    zero, and they are the same from both sides. In space a height t ∈ [0, 1] above the centre has
    the centre's weight 1 − t, and the square face the rest, bilinearly: there are five corners, so that other weights
    would do too, but not all would be continuous.

    Args:
        lattice: The grid.
        offsets: (N, d) points as seen from the grid's first corner [m].
        pyramids: (N,) where they lie, from `Lattice.pyramids`; none of them −1.
    """
    d = len(lattice.cells)
    cell, side = pyramids // (2 * d), pyramids % (2 * d)
    axis, upper = side[:, None] // 2, side % 2
    indices: list[Tensor] = []
    for count in lattice.cells[::-1]:
        indices.append(cell % count)
        cell = cell // count
    # in half cells from the cell's centre
    place = 2.0 * (offsets / offsets.new_tensor(lattice.spacing) - torch.stack(indices[::-1], dim=1)) - 1.0
    height = place.gather(1, axis)[:, 0] * (2 * upper - 1)
    others = torch.arange(d - 1, device=axis.device).expand(len(axis), -1)
    across = place.gather(1, others + (others >= axis)) / height.clamp_min(_AT_CENTRE)[:, None]
    weights = height[:, None]
    for along in across.unbind(1):
        weights = (weights[:, :, None] * torch.stack([0.5 - 0.5 * along, 0.5 + 0.5 * along], 1)[:, None]).flatten(1)
    return torch.cat([weights, 1.0 - height[:, None]], dim=1)
