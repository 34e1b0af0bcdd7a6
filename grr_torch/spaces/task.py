"""Task spaces: their metric, their interpolation, and the error of a configuration against a point.

A point of a task space is a row of a (*batch, width) tensor. What it leaves open, or what stands fixed in the task,
is not in the row: for `position` and `fixed-rotation` a row is the position alone.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from grr_torch.errors import ParameterError, UnknownNameError
from grr_torch.spaces.configuration import wrap
from grr_torch.spaces.rotation import (
    matrix_from_rpy,
    quaternion_distance,
    quaternion_from_matrix,
    rotation_error,
    rotation_error_of_few,
    slerp,
)

Array = NDArray[Any]

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
    def width(self) -> int:
        """Entries of a point: its position, as long as rotation does not vary."""
        return self.dimension

    @property
    @abstractmethod
    def constraints(self) -> int:
        """How many equations a point imposes on a configuration."""

    @property
    @abstractmethod
    def name(self) -> str:
        """The space in the paper's notation."""

    @abstractmethod
    def quaternions(self, points: Tensor) -> Tensor | None:
        """Orientations (*batch, 4) that points (*batch, width) demand; None where rotation is free."""

    @abstractmethod
    def rotation_error(self, targets: Tensor, rotation: Tensor) -> Tensor:
        """Rotation part (r, N) [rad] of `error`; r rows, none where rotation is free."""

    @abstractmethod
    def to_json(self) -> dict[str, Any]:
        """The task as `task_from_json` reads it."""

    def distance(self, first: Tensor, second: Tensor) -> Tensor:
        """D_p (*batch,) = w_t ‖t_i − t_j‖ + w_o (1 − |o_i · o_j|), with w_t = 1 and w_o = 0.3 (Section IV-B).

        Args:
            first: (*batch, width) points.
            second: (*batch, width) points.
        """
        d = self.dimension
        result = TRANSLATION_WEIGHT * (first[..., :d] - second[..., :d]).norm(dim=-1)
        orientations = self.quaternions(first), self.quaternions(second)
        if orientations[0] is not None and orientations[1] is not None:
            result = result + ROTATION_WEIGHT * quaternion_distance(orientations[0], orientations[1])
        return result

    def interpolate(self, start: Tensor, end: Tensor, fraction: float | Tensor) -> Tensor:
        """Points `fraction` of the way from start to end (BisectP at 0.5): straight in translation, slerp in rotation.

        Args:
            start: (*batch, width) points.
            end: (*batch, width) points.
            fraction: 0 at `start`, 1 at `end`; a number or a tensor that broadcasts.
        """
        d = self.dimension
        translation = start[..., :d] + fraction * (end[..., :d] - start[..., :d])
        if start.shape[-1] == d:
            return translation
        orientations = self.quaternions(start), self.quaternions(end)
        if orientations[0] is None or orientations[1] is None:
            return translation
        return torch.cat([translation, slerp(orientations[0], orientations[1], fraction)], dim=-1)

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
        """`error` for arrays: what a space has no faster way for is left to torch."""
        tensors = (torch.from_numpy(np.ascontiguousarray(array)) for array in (targets, position, rotation))
        return self.error(*tensors).numpy()

    def jacobian(self, jacobian: Tensor) -> Tensor:
        """Rows (constraints, n, N) of a geometric Jacobian (6, n, N) that answer to `error`."""
        rotation_rows = self.constraints - self.dimension
        if self.dimension == 3 and rotation_rows in (0, 3):
            return jacobian[: 3 + rotation_rows]
        return torch.cat([jacobian[: self.dimension], jacobian[6 - rotation_rows :]])

    def residuals(self, error: Tensor) -> tuple[Tensor, Tensor]:
        """Norms (N,) of an error's translation [m] and rotation [rad] parts."""
        return error[: self.dimension].norm(dim=0), error[self.dimension :].norm(dim=0)


@dataclass(frozen=True)
class Position(TaskSpace):
    """T = R² or R³: the tool's position, its rotation free."""

    kind: ClassVar[str] = "position"

    @property
    def constraints(self) -> int:
        """As many as there are coordinates."""
        return self.dimension

    @property
    def name(self) -> str:
        """R2 or R3."""
        return f"R{self.dimension}"

    def quaternions(self, points: Tensor) -> Tensor | None:
        """None: rotation is free."""
        return None

    def rotation_error(self, targets: Tensor, rotation: Tensor) -> Tensor:
        """No rows."""
        return rotation[0, :0]

    def error_of_few(self, targets: Array, position: Array, rotation: Array) -> Array:
        """`error` for arrays."""
        return targets - position[: self.dimension]

    def to_json(self) -> dict[str, Any]:
        """Kind and dimension."""
        return {"kind": self.kind, "dimension": self.dimension}


@dataclass(frozen=True)
class FixedRotation(TaskSpace):
    """T = SE(2) or SE(3) with the tool's rotation held.

    Attributes:
        rpy: Fixed-axis (extrinsic) xyz Euler angles of the tool [rad]; in the plane, only the last one counts.
    """

    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    kind: ClassVar[str] = "fixed-rotation"

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.rpy) != 3 or not all(abs(angle) <= 2.0 * math.pi for angle in self.rpy):
            raise ParameterError("rotation", self.rpy, "roll, pitch, yaw in radians, each within a full turn")
        if self.dimension == 2 and any(abs(angle) > 1e-9 for angle in self.rpy[:2]):
            raise ParameterError("rotation", self.rpy, "roll and pitch 0 for a task in the plane")

    @property
    def constraints(self) -> int:
        """3 in the plane, 6 in space."""
        return 3 if self.dimension == 2 else 6

    @property
    def name(self) -> str:
        """SE(2) or SE(3)."""
        return f"SE({self.dimension})"

    @cached_property
    def rotation(self) -> Tensor:
        """The tool's rotation matrix (3, 3)."""
        return matrix_from_rpy(*self.rpy)

    def quaternions(self, points: Tensor) -> Tensor | None:
        """The one orientation, for every point."""
        return quaternion_from_matrix(self.rotation).to(points).expand(*points.shape[:-1], 4)

    def rotation_error(self, targets: Tensor, rotation: Tensor) -> Tensor:
        """Rotation vectors (3, N) in space, wrapped yaw differences (1, N) in the plane [rad]."""
        if self.dimension == 2:
            return wrap(self.rpy[2] - torch.atan2(rotation[1, 0], rotation[0, 0]))[None]
        return rotation_error(self.rotation.to(rotation)[..., None], rotation)

    def error_of_few(self, targets: Array, position: Array, rotation: Array) -> Array:
        """`error` for arrays."""
        if self.dimension == 2:
            return super().error_of_few(targets, position, rotation)
        turned = rotation_error_of_few(self.rotation.numpy(), rotation)
        return np.concatenate([targets - position, turned])

    def to_json(self) -> dict[str, Any]:
        """Kind, dimension and angles."""
        return {"kind": self.kind, "dimension": self.dimension, "rotation": list(self.rpy)}


def make_task(kind: str, dimension: int, rpy: Sequence[float] | None = None) -> TaskSpace:
    """The task space of a kind by its name.

    Args:
        kind: "position" or "fixed-rotation".
        dimension: 2 or 3.
        rpy: Fixed-axis roll, pitch, yaw [rad] for "fixed-rotation"; zero by default.

    Raises:
        UnknownNameError: No such kind.
        ParameterError: The dimension or the angles are not valid.
    """
    if kind == Position.kind:
        if rpy is not None:
            raise ParameterError("rotation", tuple(rpy), "none for the task 'position', which leaves it free")
        return Position(dimension)
    if kind == FixedRotation.kind:
        angles = tuple(rpy or (0.0, 0.0, 0.0))
        if len(angles) != 3:
            raise ParameterError("rotation", angles, "three finite angles: roll, pitch, yaw [rad]")
        return FixedRotation(dimension, (angles[0], angles[1], angles[2]))
    raise UnknownNameError("task", kind, (Position.kind, FixedRotation.kind))


def task_from_json(data: dict[str, Any]) -> TaskSpace:
    """Reads what `TaskSpace.to_json` gave."""
    return make_task(data["kind"], data["dimension"], data.get("rotation"))
