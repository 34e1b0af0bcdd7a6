"""Arithmetic in configuration space: wrapped differences, distance, interpolation, circular averages.

`continuous` marks the joints whose values are equal modulo 2π. Configurations are (*batch, n).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def wrap(angle: Tensor) -> Tensor:
    """Angles in [−π, π] [rad]."""
    turns = torch.round(angle * (0.5 / math.pi))
    return torch.add(angle, turns, alpha=-2.0 * math.pi)


def normalise(q: Tensor, continuous: Tensor) -> Tensor:
    """The same configurations with continuous joints in [−π, π]."""
    return torch.where(continuous, wrap(q), q)


def difference(start: Tensor, end: Tensor, continuous: Tensor) -> Tensor:
    """The shortest motion end − start (*batch, n); continuous joints in [−π, π]."""
    return normalise(end - start, continuous)


def distance(start: Tensor, end: Tensor, continuous: Tensor) -> Tensor:
    """D_q (*batch,): Euclidean norm of the wrapped difference [rad; prismatic joints count in metres]."""
    return difference(start, end, continuous).norm(dim=-1)


def interpolate(start: Tensor, end: Tensor, fraction: float | Tensor, continuous: Tensor) -> Tensor:
    """Configurations on the shortest straight line, `fraction` of the way from start to end (BisectQ at 0.5)."""
    return normalise(start + fraction * difference(start, end, continuous), continuous)


def weighted_average(q: Tensor, weights: Tensor, continuous: Tensor) -> Tensor:
    """Weighted averages (*batch, n) over the k configurations (*batch, k, n).

    Continuous joints are averaged on the circle: the direction of the weighted sum of their unit vectors.

    Args:
        q: (*batch, k, n) configurations.
        weights: (*batch, k) non-negative weights, not all zero; they need not add up to one.
        continuous: (n,) bool.
    """
    weights = (weights / weights.sum(-1, keepdim=True))[..., None]
    linear = (weights * q).sum(-2)
    circular = torch.atan2((weights * q.sin()).sum(-2), (weights * q.cos()).sum(-2))
    return torch.where(continuous, circular, linear)
