"""Moving and resizing spheres by gradient descent until they cover a solid with the least excess."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from grr_torch.robots.geometry import Points, Solid

_STEPS = 1500
# nodes of the distance field along each axis
_NODES = 72
# points on all spheres together, at which the excess is taken
_SURFACE = 3200
# surface points that each step looks at, drawn anew, so that no gap hides between them
_DRAWN = 3000
# all lengths below are shares of the link's size
_RATE = 0.01
_SOFT_COVER, _SOFT_OUTER = 0.003, 0.006
_OVERLAP = 0.001
_STEEP = 0.06


def tighten(
    centres: Points, radii: Points, solid: Solid, inner: Points, size: float, seed: int
) -> tuple[Points, Points]:
    """Minimises the mean distance of the spheres' outer surface from a solid, under a penalty for what they miss.

    Excess is weighted by area, plus its sixth power, which holds down the largest one.

    Args:
        centres: (S, 3) where the spheres start [m].
        radii: (S,) their radii [m].
        solid: What is to be covered.
        inner: (I, 3) points inside that are to be covered besides its surface.
        size: The solid's size [m]; the scale of all tolerances.
        seed: For the surface points each step looks at.

    Returns:
        Centres and radii. Coverage is approximate; the caller closes the last gaps.
    """
    c = torch.tensor(centres, requires_grad=True)
    r = torch.tensor(radii, requires_grad=True)
    field = _DistanceField(solid, size)
    boundary, inside = torch.tensor(solid.boundary), torch.tensor(inner)
    directions = torch.tensor(unit_sphere(max(16, _SURFACE // len(c))))
    own = torch.arange(len(c)).repeat_interleave(len(directions))
    generator = torch.Generator().manual_seed(seed)
    optimiser = torch.optim.Adam([c, r], lr=_RATE * size)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, _STEPS)
    for _ in range(_STEPS):
        optimiser.zero_grad()
        drawn = boundary[torch.randint(len(boundary), (_DRAWN,), generator=generator)]
        gaps = torch.cdist(torch.cat([drawn, inside]), c) - r
        soft = _SOFT_COVER * size
        nearest = -soft * torch.logsumexp(-gaps / soft, 1)
        missed = (torch.relu(nearest + _OVERLAP * size) / size).square().mean()
        surface = (c[:, None] + r[:, None, None] * directions).reshape(-1, 3)
        others = (torch.cdist(surface, c) - r).scatter(1, own[:, None], size)
        area = torch.sigmoid(others.amin(1) / (_SOFT_OUTER * size)) * r.detach()[own].square()
        excess = field(surface) / size
        steep = (excess / _STEEP) ** 6
        loss = 3e6 * missed + 10.0 * (area * (excess + 0.1 * steep)).sum() / area.sum()
        torch.autograd.backward(loss)
        optimiser.step()
        schedule.step()
    return c.detach().numpy(), r.detach().numpy()


class _DistanceField:
    """Distance outside a solid [m], interpolated on a grid; zero inside."""

    def __init__(self, solid: Solid, size: float) -> None:
        pad = 0.2 * size
        low, high = solid.boundary.min(0) - pad, solid.boundary.max(0) + pad
        axes = [np.linspace(a, b, _NODES) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        values = solid.distance(grid)
        values[solid.inside(grid)] *= -1.0
        self._values = torch.tensor(values.reshape(1, 1, _NODES, _NODES, _NODES))
        self._low, self._span = torch.tensor(low), torch.tensor(high - low)

    def __call__(self, points: Tensor) -> Tensor:
        unit = 2.0 * (points - self._low) / self._span - 1.0
        # grid_sample names the last grid axis first
        grid = unit.flip(-1)[None, :, None, None]
        values = grid_sample(self._values, grid, align_corners=True, padding_mode="border")
        return values.reshape(-1).clamp_min(0.0)


def unit_sphere(count: int) -> Points:
    """Points (count, 3) spread evenly on the unit sphere (Fibonacci spiral)."""
    k = np.arange(count) + 0.5
    polar, turn = np.arccos(1.0 - 2.0 * k / count), np.pi * (1.0 + 5.0**0.5) * k
    return np.column_stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)])
