"""What varies of a tool's rotation: a yaw on the circle, a direction on S², or an orientation in SO(3).

Each has the paper's distance 1 − |o_i · o_j| (Section IV-B), where the rotations left open are those that make it
smallest, geodesics, and grids of low discrepancy, whose neighbours are those of a Delaunay triangulation.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from grr_torch.errors import ParameterError
from grr_torch.spaces.configuration import wrap
from grr_torch.spaces.rotation import quaternion_distance, slerp

# a direction or a quaternion that is shorter has none
_LEAST_LENGTH = 1e-6
# rotations of which a grid may consist
_MOST_ROTATIONS = 100_000
# Alexa (2022), Super-Fibonacci spirals: ψ⁴ = ψ + 4, beside √2
_PSI = 1.533751168755204288118041


@dataclass(frozen=True, eq=False)
class RotationGrid:
    """Rotations and which of them are neighbours.

    Attributes:
        values: (R, w), float64.
        edges: (E, 2) indices, the smaller one first.
    """

    values: Tensor
    edges: Tensor


class Rotations(ABC):
    """Arithmetic with rows (*batch, w) that stand for what varies of a rotation."""

    names: ClassVar[tuple[str, ...]]

    @abstractmethod
    def distance(self, first: Tensor, second: Tensor) -> Tensor:
        """1 − |o_i · o_j| (*batch,): the smallest over what is left open, 0 to 1."""

    @abstractmethod
    def distances(self, first: Tensor, second: Tensor) -> Tensor:
        """`distance` (N, R) of each of (N, w) to each of (R, w), to about 1e-16."""

    @abstractmethod
    def interpolate(self, start: Tensor, end: Tensor, fraction: float | Tensor) -> Tensor:
        """Rows `fraction` of the shortest way from start to end."""

    @abstractmethod
    def centre(self, rows: Tensor) -> Tensor:
        """The middle (*batch, w) of rows (*batch, k, w) that are near each other."""

    def are_rotations(self, rows: Tensor) -> Tensor:
        """(*batch,) which rows (*batch, w) stand for a rotation: finite ones that have a length, if they need one."""
        return rows.isfinite().all(-1) & ((len(self.names) == 1) | (rows.norm(dim=-1) > _LEAST_LENGTH))

    @abstractmethod
    def unit(self, rows: Tensor) -> Tensor:
        """Rows as they are stored.

        Raises:
            ParameterError: One of them has no length.
        """

    @abstractmethod
    def turned(self, rows: Tensor, axis: Tensor, angle: float) -> Tensor:
        """Rows (N, w) turned about an axis (3,) of the base frame by an angle [rad]."""

    @abstractmethod
    def grid(self, count: int) -> RotationGrid:
        """`count` rotations, evenly spread.

        Raises:
            ParameterError: There cannot be so many.
        """


@dataclass(frozen=True)
class Yaws(Rotations):
    """Angles [rad] about an axis that stands still in the base frame.

    Attributes:
        axis: Unit vector.
    """

    names: ClassVar[tuple[str, ...]] = ("yaw",)
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def distance(self, first: Tensor, second: Tensor) -> Tensor:
        """1 − |cos(δ / 2)|, as 2 sin²(δ / 4)."""
        return 2.0 * (0.25 * wrap(second - first)[..., 0]).sin().square()

    def distances(self, first: Tensor, second: Tensor) -> Tensor:
        """All pairs of `distance`."""
        return self.distance(first[:, None], second)

    def interpolate(self, start: Tensor, end: Tensor, fraction: float | Tensor) -> Tensor:
        """The shorter way round."""
        return wrap(start + fraction * wrap(end - start))

    def centre(self, rows: Tensor) -> Tensor:
        """The circular mean near the first."""
        first = rows[..., :1, :]
        return wrap(first + wrap(rows - first).mean(-2, keepdim=True))[..., 0, :]

    def unit(self, rows: Tensor) -> Tensor:
        """Angles in [−π, π]."""
        return wrap(rows)

    def turned(self, rows: Tensor, axis: Tensor, angle: float) -> Tensor:
        """About a parallel axis they turn; about another one they could not and stay."""
        along = float(axis.cpu() @ torch.tensor(self.axis, dtype=axis.dtype))
        return wrap(rows + angle * along) if abs(along) > 1.0 - 1e-9 else rows

    def grid(self, count: int) -> RotationGrid:
        """A ring from 0 in steps of 2π / n."""
        count = check_rotations(count)
        values = wrap(torch.arange(count, dtype=torch.float64)[:, None] * (2.0 * math.pi / count))
        pairs = [(k, k + 1) for k in range(count - 1)] + ([(0, count - 1)] if count > 2 else [])
        return RotationGrid(values, torch.tensor(pairs, dtype=torch.long).reshape(-1, 2))


@dataclass(frozen=True)
class Directions(Rotations):
    """Unit vectors."""

    names: ClassVar[tuple[str, ...]] = ("ax", "ay", "az")

    def distance(self, first: Tensor, second: Tensor) -> Tensor:
        """1 − cos(θ / 2): of all rotations between the two, the smallest one's quaternion."""
        angle = 2.0 * torch.atan2((first - second).norm(dim=-1), (first + second).norm(dim=-1))
        return 2.0 * (0.25 * angle).sin().square()

    def distances(self, first: Tensor, second: Tensor) -> Tensor:
        """All pairs of `distance`."""
        return 1.0 - (0.5 * (1.0 + first @ second.T)).clamp(0.0, 1.0).sqrt()

    def interpolate(self, start: Tensor, end: Tensor, fraction: float | Tensor) -> Tensor:
        """On the great circle; between opposite ones, on any."""
        across = end - (start * end).sum(-1, keepdim=True) * start
        length = across.norm(dim=-1, keepdim=True)
        any_side = perpendicular(start.movedim(-1, 0))[:, 0].movedim(0, -1)
        side = torch.where(length > 1e-12, across / length.clamp_min(1e-300), any_side)
        angle = 2.0 * torch.atan2((end - start).norm(dim=-1, keepdim=True), (end + start).norm(dim=-1, keepdim=True))
        turned = (fraction * angle).cos() * start + (fraction * angle).sin() * side
        return turned / turned.norm(dim=-1, keepdim=True)

    def centre(self, rows: Tensor) -> Tensor:
        """The direction of their sum."""
        return torch.nn.functional.normalize(rows.sum(-2), dim=-1)

    def unit(self, rows: Tensor) -> Tensor:
        """Vectors of length one."""
        return _normalised("direction", rows)

    def turned(self, rows: Tensor, axis: Tensor, angle: float) -> Tensor:
        """Rodrigues' formula."""
        along = (rows @ axis)[:, None] * axis
        across = rows - along
        return along + math.cos(angle) * across + math.sin(angle) * torch.linalg.cross(axis.expand_as(rows), rows)

    def grid(self, count: int) -> RotationGrid:
        """A Fibonacci lattice on the sphere."""
        count = check_rotations(count)
        height = 1.0 - (2.0 * np.arange(count) + 1.0) / count
        angle = np.arange(count) * (math.pi * (3.0 - math.sqrt(5.0)))
        radius = np.sqrt(1.0 - height**2)
        values = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
        return RotationGrid(torch.from_numpy(values), _delaunay(values, values, 4))


@dataclass(frozen=True)
class Orientations(Rotations):
    """Unit quaternions (w, x, y, z); q and −q are the same orientation."""

    names: ClassVar[tuple[str, ...]] = ("qw", "qx", "qy", "qz")

    def distance(self, first: Tensor, second: Tensor) -> Tensor:
        """1 − |o_i · o_j|."""
        return quaternion_distance(first, second)

    def distances(self, first: Tensor, second: Tensor) -> Tensor:
        """All pairs of `distance`."""
        return 1.0 - (first @ second.T).abs().clamp_max(1.0)

    def interpolate(self, start: Tensor, end: Tensor, fraction: float | Tensor) -> Tensor:
        """Slerp on the shorter arc."""
        return slerp(start, end, fraction)

    def centre(self, rows: Tensor) -> Tensor:
        """The direction of their sum, each with the sign that is nearer to the first."""
        signs = torch.where((rows * rows[..., :1, :]).sum(-1, keepdim=True) < 0.0, -1.0, 1.0)
        return torch.nn.functional.normalize((signs * rows).sum(-2), dim=-1)

    def unit(self, rows: Tensor) -> Tensor:
        """Quaternions of length one."""
        return _normalised("quaternion", rows)

    def turned(self, rows: Tensor, axis: Tensor, angle: float) -> Tensor:
        """The product with the turn's quaternion, from the left."""
        w, v = rows[:, :1], rows[:, 1:]
        c, u = math.cos(0.5 * angle), math.sin(0.5 * angle) * axis
        vector = c * v + w * u + torch.linalg.cross(u.expand_as(v), v)
        return torch.cat([c * w - (v @ u)[:, None], vector], dim=1)

    def grid(self, count: int) -> RotationGrid:
        """A super-Fibonacci spiral (Alexa 2022)."""
        count = check_rotations(count)
        s = np.arange(count) + 0.5
        low, high = np.sqrt(s / count), np.sqrt(1.0 - s / count)
        alpha, beta = 2.0 * math.pi * s / math.sqrt(2.0), 2.0 * math.pi * s / _PSI
        values = np.stack([low * np.sin(alpha), low * np.cos(alpha), high * np.sin(beta), high * np.cos(beta)], axis=1)
        return RotationGrid(torch.from_numpy(values), _delaunay(values, np.concatenate([values, -values]), 5))


def perpendicular(columns: Tensor) -> Tensor:
    """Two unit vectors (3, 2, *batch) perpendicular to unit vectors (3, *batch) and each other (Duff et al. 2017)."""
    x, y, z = columns
    sign = torch.where(z < 0.0, -1.0, 1.0).to(z)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = torch.stack([1.0 + sign * x * x * a, sign * b, -sign * x])
    second = torch.stack([b, sign + y * y * a, -y])
    return torch.stack([first, second], dim=1)


def _normalised(name: str, rows: Tensor) -> Tensor:
    lengths = rows.norm(dim=-1, keepdim=True)
    if not bool((lengths > _LEAST_LENGTH).all()):
        raise ParameterError(name, "one of length zero", "one that has a length; it is normalised")
    return rows / lengths


def check_rotations(count: int) -> int:
    """The number of rotations asked for.

    Raises:
        ParameterError: It is not valid.
    """
    if isinstance(count, bool) or not hasattr(count, "__index__") or not 1 <= count <= _MOST_ROTATIONS:
        raise ParameterError("rotations", count, f"a whole number from 1 to {_MOST_ROTATIONS:,}")
    return int(count)


def _delaunay(values: np.ndarray, points: np.ndarray, least: int) -> Tensor:
    """Edges (E, 2) between (R, w) values that are neighbours on the sphere; all pairs where there are too few.

    Facets of the convex hull of points on a sphere are their Delaunay triangulation. Points may hold the values more
    than once, with other signs.
    """
    count = len(values)
    every = torch.combinations(torch.arange(count)).reshape(-1, 2)
    if count <= least:
        return every
    try:
        facets = ConvexHull(points).simplices % count
    except QhullError:
        return every
    sides = np.concatenate([facets[:, list(pair)] for pair in zip(*np.triu_indices(facets.shape[1], 1), strict=True)])
    sides = np.unique(np.sort(sides, axis=1), axis=0)
    return torch.from_numpy(sides[sides[:, 0] < sides[:, 1]].astype(np.int64))
