"""Task spaces: their metric, their interpolation, and the error of a configuration against a point.

A point of a task space is a row of a (*batch, width) tensor: the tool's position, and behind it as much of its rotation
as varies from point to point. What a task leaves open, or what stands fixed in it, is not in the row.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from grr_torch.errors import ParameterError
from grr_torch.pieces import Array, norms
from grr_torch.spaces.rotations import Rotations

# weights of translation and rotation in D_p (Section IV-B of the paper)
TRANSLATION_WEIGHT = 1.0
ROTATION_WEIGHT = 0.3


@dataclass(frozen=True)
class TaskSpace(ABC):
    """A task space over positions in R² or R³.

    Attributes:
        dimension: 2 or 3: how many coordinates of the tool's position count.
    """

    dimension: int
    kind: ClassVar[str]

    def __post_init__(self) -> None:
        if not isinstance(self.dimension, int) or self.dimension not in (2, 3):
            raise ParameterError("task dimension", self.dimension, "2 or 3")

    @property
    def rotations(self) -> Rotations | None:
        """What varies of the tool's rotation from point to point; None where nothing does."""
        return None

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of a point's entries."""
        rotation = () if self.rotations is None else self.rotations.names
        return ("x", "y", "z")[: self.dimension] + rotation

    @property
    def width(self) -> int:
        """Entries of a point: its position, and what varies of its rotation."""
        return len(self.coordinates)

    @property
    @abstractmethod
    def constraints(self) -> int:
        """How many equations a point imposes on a configuration."""

    @property
    @abstractmethod
    def name(self) -> str:
        """The space in the paper's notation."""

    @abstractmethod
    def rotation_error(self, targets: Tensor, rotation: Tensor) -> Tensor:
        """Rotation part (r, N) [rad] of `error`; r rows, none where rotation is free."""

    @abstractmethod
    def to_json(self) -> dict[str, Any]:
        """The task as `task_from_json` reads it."""

    def matrices(self, targets: Tensor) -> Tensor | None:
        """Tool rotations (3, 3, N or 1) that points (width, N) demand; None where they leave some of it open."""
        return None

    def unit(self, points: Tensor) -> Tensor:
        """Points (*batch, width) with angles in [−π, π] and directions and quaternions of length one.

        Raises:
            ParameterError: A direction or a quaternion has no length.
        """
        if self.rotations is None:
            return points
        d = self.dimension
        return torch.cat([points[..., :d], self.rotations.unit(points[..., d:])], dim=-1)

    def at(self, position: Tensor, rotation: Tensor) -> Tensor:
        """The points (width, N) nearest to tools, as columns.

        Args:
            position: (3, N) tool positions [m].
            rotation: (3, 3, N) tool rotations.
        """
        return position[: self.dimension]

    def distance(self, first: Tensor, second: Tensor) -> Tensor:
        """D_p (*batch,) = w_t ‖t_i − t_j‖ + w_o (1 − |o_i · o_j|), with w_t = 1 and w_o = 0.3 (Section IV-B).

        Args:
            first: (*batch, width) points.
            second: (*batch, width) points.
        """
        d = self.dimension
        result = TRANSLATION_WEIGHT * (first[..., :d] - second[..., :d]).norm(dim=-1)
        if self.rotations is None:
            return result
        return result + ROTATION_WEIGHT * self.rotations.distance(first[..., d:], second[..., d:])

    def interpolate(self, start: Tensor, end: Tensor, fraction: float | Tensor) -> Tensor:
        """Points `fraction` of the way from start to end (BisectP at 0.5): straight in translation, slerp in rotation.

        Args:
            start: (*batch, width) points.
            end: (*batch, width) points.
            fraction: 0 at `start`, 1 at `end`; a number or a tensor that broadcasts.
        """
        d = self.dimension
        translation = start[..., :d] + fraction * (end[..., :d] - start[..., :d])
        if self.rotations is None:
            return translation
        return torch.cat([translation, self.rotations.interpolate(start[..., d:], end[..., d:], fraction)], dim=-1)

    def interpolate_few(self, start: Array, end: Array, fraction: Array | float) -> Array:
        """`interpolate` for arrays."""
        if self.rotations is None:
            return start + fraction * (end - start)
        between = fraction if isinstance(fraction, float) else torch.from_numpy(fraction)
        return self.interpolate(torch.from_numpy(start), torch.from_numpy(end), between).numpy()

    def gap_of_few(self, first: Array, second: Array) -> Array:
        """How far arms have to go between points (*batch, width) [m]: a radian of rotation counts as 0.3 m.

        Other than D_p, in which small turns count for next to nothing, it grows with the angle itself.
        """
        d = self.dimension
        if self.rotations is None:
            return norms(first - second)
        turns = (torch.from_numpy(part[..., d:]) for part in (first, second))
        # the distance of rotations is 1 − cos(θ / 2)
        angle = 4.0 * np.arcsin(np.sqrt(np.clip(0.5 * self.rotations.distance(*turns).numpy(), 0.0, 1.0)))
        return np.hypot(norms(first[..., :d] - second[..., :d]), ROTATION_WEIGHT * angle)

    def centre(self, points: Tensor) -> Tensor:
        """The middle (*batch, width) of points (*batch, k, width) that are near each other."""
        d = self.dimension
        translation = points[..., :d].mean(-2)
        if self.rotations is None:
            return translation
        return torch.cat([translation, self.rotations.centre(points[..., d:])], dim=-1)

    def error(self, targets: Tensor, position: Tensor, rotation: Tensor) -> Tensor:
        """What is left to the target: (constraints, N), translation rows [m] above rotation rows [rad].

        Args:
            targets: (width, N) points as columns.
            position: (3, N) tool positions [m].
            rotation: (3, 3, N) tool rotations.
        """
        translation = targets[: self.dimension] - position[: self.dimension]
        if self.constraints == self.dimension:
            return translation
        return torch.cat([translation, self.rotation_error(targets, rotation)])

    def error_of_few(self, targets: Array, position: Array, rotation: Array) -> Array:
        """`error` for arrays."""
        translation = targets[: self.dimension] - position[: self.dimension]
        if self.constraints == self.dimension:
            return translation
        return np.concatenate([translation, self.rotation_error_of_few(targets, rotation)])

    def rotation_error_of_few(self, targets: Array, rotation: Array) -> Array:
        """`rotation_error` for arrays: what a space has no faster way for is left to torch."""
        tensors = (torch.from_numpy(np.ascontiguousarray(array)) for array in (targets, rotation))
        return self.rotation_error(*tensors).numpy()

    def jacobian(self, jacobian: Tensor, targets: Tensor | None = None) -> Tensor:
        """Rows (constraints, n, N) of a geometric Jacobian (6, n, N) that answer to `error`.

        Args:
            jacobian: (6, n, N).
            targets: (width, N or 1) the points; only `axis`, whose rows depend on them, asks for them.
        """
        if self._first_rows:
            return jacobian[: self._first_rows]
        return torch.cat([jacobian[: self.dimension], jacobian[6 - self.constraints + self.dimension :]])

    @property
    def _first_rows(self) -> int:
        """How many of a Jacobian's first rows are all that answer to `error`; 0 if others do."""
        return self.constraints if self.dimension == 3 and self.constraints in (3, 6) else 0

    def jacobian_of_few(self, jacobian: Array, targets: Array) -> Array:
        """`jacobian` for arrays; its rows may be those that are given."""
        if self._first_rows:
            return jacobian[: self._first_rows]
        return self.jacobian(torch.from_numpy(jacobian), torch.from_numpy(targets)).numpy()

    def residuals(self, error: Tensor) -> tuple[Tensor, Tensor]:
        """Norms (N,) of an error's translation [m] and rotation [rad] parts."""
        return error[: self.dimension].norm(dim=0), error[self.dimension :].norm(dim=0)
