"""Components of a self-motion manifold: what values their joints take, and in which order they are numbered."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from grr_torch.spaces.configuration import embed

# a gap [rad] between values of a continuous joint that is no accident of sampling
_GAP = 0.3


def joint_ranges(q: Tensor, continuous: Tensor) -> Tensor:
    """(n, 2) lowest and highest of configurations (S, n), on the circle where a joint is continuous."""
    values = q.sort(dim=0).values
    following = torch.cat([values[1:], values[:1] + 2.0 * math.pi])
    gap, before = (following - values).max(0)
    low = values.gather(0, ((before + 1) % len(values))[None])[0]
    arc = torch.stack([low, low + 2.0 * math.pi - gap], 1)
    arc[gap < _GAP] = torch.tensor([-math.pi, math.pi]).to(arc)
    return torch.where(continuous[:, None], arc, torch.stack([values[0], values[-1]], 1))


def places(q: Tensor, weights: Tensor, component: Tensor, continuous: Tensor) -> Tensor:
    """A number (C,) for where each component lies: a fixed combination of its mean, so that no symmetry gives ties."""
    rows = embed(q, continuous)
    sums = rows.new_zeros(int(component.max()) + 1, rows.shape[1]).index_add_(0, component, weights[:, None] * rows)
    totals = rows.new_zeros(len(sums)).index_add_(0, component, weights)
    factors = torch.cos(math.e * torch.arange(1, rows.shape[1] + 1, dtype=rows.dtype, device=rows.device))
    return (sums / totals[:, None]) @ factors
