"""Arithmetic in configuration space: wrapped differences, distance, interpolation, circular averages.

`continuous` marks the joints whose values are equal modulo 2π. Configurations are (*batch, n).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from grr_torch.pieces import Array


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


def embed(q: Tensor, continuous: Tensor) -> Tensor:
    """Configurations (*batch, n) as rows (*batch, 2n) whose weighted sums `average` reads.

    (cos q, sin q) of a continuous joint, (q, 1) of another.
    """
    return torch.cat([torch.where(continuous, q.cos(), q), torch.where(continuous, q.sin(), 1.0)], dim=-1)


def average(sums: Tensor, continuous: Tensor) -> Tensor:
    """Averages (*batch, n) from weighted sums (*batch, 2n) of `embed`; the weights need not add up to one.

    Continuous joints are averaged on the circle: the direction of the weighted sum of their unit vectors.
    """
    first, second = sums.chunk(2, dim=-1)
    return torch.where(continuous, torch.atan2(second, first), first / second)


def average_of_few(sums: Array, continuous: Array) -> Array:
    """`average` for arrays."""
    n = sums.shape[-1] // 2
    first, second = sums[..., :n], sums[..., n:]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(continuous, np.arctan2(second, first), first / second)
