"""Task spaces by name, and those in which rotation does not vary."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor

from grr_torch.devices import OnDevices
from grr_torch.errors import ParameterError, UnknownNameError
from grr_torch.pieces import Array
from grr_torch.spaces.base import ROTATION_WEIGHT, TRANSLATION_WEIGHT, TaskSpace
from grr_torch.spaces.configuration import wrap
from grr_torch.spaces.rotation import matrix_from_rpy, rotation_error, rotation_error_of_few, turning_terms
from grr_torch.spaces.turning import Axis, Pose, Yaw

__all__ = [
    "KINDS", "ROTATION_WEIGHT", "TRANSLATION_WEIGHT", "Axis", "FixedRotation", "Pose", "Position", "TaskSpace", "Yaw",
    "make_task", "task_from_json",
]  # fmt: skip


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

    def rotation_error(self, targets: Tensor, rotation: Tensor) -> Tensor:
        """No rows."""
        return rotation[0, :0]

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

    @cached_property
    def _rotation(self) -> OnDevices:
        return OnDevices(self.rotation)

    @cached_property
    def _turning(self) -> tuple[Array, Array]:
        target = self.rotation.numpy()
        return target, turning_terms(target)

    def matrices(self, targets: Tensor) -> Tensor:
        """The one rotation, for every point."""
        return self._rotation.like(targets)[0][..., None]

    def rotation_error(self, targets: Tensor, rotation: Tensor) -> Tensor:
        """Rotation vectors (3, N) in space, wrapped yaw differences (1, N) in the plane [rad]."""
        if self.dimension == 2:
            return wrap(self.rpy[2] - torch.atan2(rotation[1, 0], rotation[0, 0]))[None]
        return rotation_error(self._rotation.like(rotation)[0][..., None], rotation)

    def rotation_error_of_few(self, targets: Array, rotation: Array) -> Array:
        """`rotation_error` for arrays."""
        if self.dimension == 2:
            return super().rotation_error_of_few(targets, rotation)
        return rotation_error_of_few(*self._turning, rotation)

    def to_json(self) -> dict[str, Any]:
        """Kind, dimension and angles."""
        return {"kind": self.kind, "dimension": self.dimension, "rotation": list(self.rpy)}


KINDS = (Position.kind, FixedRotation.kind, Yaw.kind, Axis.kind, Pose.kind)


def make_task(
    kind: str, dimension: int, rpy: Sequence[float] | None = None, axis: Sequence[float] | None = None
) -> TaskSpace:
    """The task space of a kind by its name.

    Args:
        kind: "position", "fixed-rotation", "yaw", "axis" or "pose".
        dimension: 2 or 3.
        rpy: Fixed-axis roll, pitch, yaw [rad] for "fixed-rotation", and for "yaw" at yaw 0; zero by default.
        axis: For "yaw", what the tool turns about, in the base frame; for "axis", the tool's axis, in its own frame;
            z by default.

    Raises:
        UnknownNameError: No such kind.
        ParameterError: The dimension, the angles or the axis are not valid, or the kind has none.
    """
    if kind not in KINDS:
        raise UnknownNameError("task", kind, KINDS)
    if rpy is not None and kind not in (FixedRotation.kind, Yaw.kind):
        raise ParameterError("rotation", tuple(rpy), f"none for the task '{kind}', which leaves it free")
    if axis is not None and kind not in (Axis.kind, Yaw.kind):
        raise ParameterError("axis", tuple(axis), f"none for the task '{kind}', which has none")
    angles = _three("rotation", (0.0, 0.0, 0.0) if rpy is None else rpy, "three finite angles: roll, pitch, yaw [rad]")
    vector = _three("axis", (0.0, 0.0, 1.0) if axis is None else axis, "three finite numbers that are not all zero")
    if kind == Position.kind:
        return Position(dimension)
    if kind == FixedRotation.kind:
        return FixedRotation(dimension, angles)
    if kind == Yaw.kind:
        return Yaw(dimension, vector, angles)
    return Axis(dimension, vector) if kind == Axis.kind else Pose(dimension)


def _three(name: str, values: Sequence[float], valid: str) -> tuple[float, float, float]:
    try:
        first, second, third = map(float, values)
    except (TypeError, ValueError, OverflowError) as error:
        raise ParameterError(name, values, valid) from error
    return first, second, third


def task_from_json(data: dict[str, Any]) -> TaskSpace:
    """Reads what `TaskSpace.to_json` gave."""
    return make_task(data["kind"], data["dimension"], data.get("rotation"), data.get("axis"))
