"""Task spaces in which rotation varies from point to point: yaw, axis and pose."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor

from grr_torch.devices import OnDevices
from grr_torch.errors import ParameterError
from grr_torch.spaces.base import TaskSpace
from grr_torch.spaces.configuration import wrap
from grr_torch.spaces.rotation import (
    matrix_from_quaternion,
    matrix_from_rpy,
    quaternion_from_matrix,
    rotation_error,
)
from grr_torch.spaces.rotations import Directions, Orientations, Rotations, Yaws, perpendicular

_Z = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Pose(TaskSpace):
    """T = SE(2) or SE(3): rows x, y, yaw, or x, y, z, qw, qx, qy, qz."""

    kind: ClassVar[str] = "pose"

    @property
    def rotations(self) -> Rotations:
        """Yaws in the plane, orientations in space."""
        return Yaws() if self.dimension == 2 else Orientations()

    @property
    def constraints(self) -> int:
        """3 in the plane, 6 in space."""
        return 3 if self.dimension == 2 else 6

    @property
    def name(self) -> str:
        """SE(2) or SE(3)."""
        return f"SE({self.dimension})"

    def matrices(self, targets: Tensor) -> Tensor:
        """Those of the quaternions, or of the yaws about z."""
        if self.dimension == 3:
            return matrix_from_quaternion(targets[3:])
        return _turned(_YAWED, targets[2])

    def rotation_error(self, targets: Tensor, rotation: Tensor) -> Tensor:
        """Rotation vectors (3, N) in space, wrapped yaw differences (1, N) in the plane [rad]."""
        if self.dimension == 2:
            return wrap(targets[2] - torch.atan2(rotation[1, 0], rotation[0, 0]))[None]
        return rotation_error(self.matrices(targets), rotation)

    def at(self, position: Tensor, rotation: Tensor) -> Tensor:
        """The tools' own poses."""
        if self.dimension == 2:
            return torch.cat([position[:2], torch.atan2(rotation[1, 0], rotation[0, 0])[None]])
        return torch.cat([position, quaternion_from_matrix(rotation.permute(2, 0, 1)).T])

    def to_json(self) -> dict[str, Any]:
        """Kind and dimension."""
        return {"kind": self.kind, "dimension": self.dimension}


@dataclass(frozen=True)
class _OfSpace(TaskSpace):
    """What there is in R³ only, with an axis.

    Attributes:
        axis: Of any length but zero.
    """

    axis: tuple[float, float, float] = _Z

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dimension != 3:
            raise ParameterError("task", f"{self.kind} in the plane", "position, fixed-rotation or pose there")
        if len(self.axis) != 3 or not 1e-6 < math.hypot(*self.axis) < 1e6:
            raise ParameterError("axis", self.axis, "three finite numbers that are not all zero")

    @cached_property
    def unit_axis(self) -> tuple[float, float, float]:
        """The axis at length one."""
        x, y, z = self.axis
        length = math.hypot(x, y, z)
        return (x / length, y / length, z / length)

    @cached_property
    def _unit_axis(self) -> OnDevices:
        return OnDevices(torch.tensor(self.unit_axis, dtype=torch.float64))


@dataclass(frozen=True)
class Yaw(_OfSpace):
    """T = R³ × S¹: the tool in a given rotation, turned about one axis; rows x, y, z, yaw.

    Attributes:
        axis: What the tool turns about, in the base frame.
        rpy: The tool's rotation at yaw 0, as of `FixedRotation` [rad].
    """

    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    kind: ClassVar[str] = "yaw"

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.rpy) != 3 or not all(abs(angle) <= 2.0 * math.pi for angle in self.rpy):
            raise ParameterError("rotation", self.rpy, "roll, pitch, yaw in radians, each within a full turn")

    @property
    def rotations(self) -> Rotations:
        """Yaws about the axis."""
        return Yaws(self.unit_axis)

    @property
    def constraints(self) -> int:
        """6."""
        return 6

    @property
    def name(self) -> str:
        """R3×S1."""
        return "R3×S1"

    @cached_property
    def rotation(self) -> Tensor:
        """The tool's rotation matrix (3, 3) at yaw 0."""
        return matrix_from_rpy(*self.rpy)

    @cached_property
    def _turning(self) -> OnDevices:
        return _turning(self.unit_axis, self.rotation)

    def matrices(self, targets: Tensor) -> Tensor:
        """Those at yaw 0, turned."""
        return _turned(self._turning, targets[3])

    def rotation_error(self, targets: Tensor, rotation: Tensor) -> Tensor:
        """Rotation vectors (3, N) [rad]."""
        return rotation_error(self.matrices(targets), rotation)

    def at(self, position: Tensor, rotation: Tensor) -> Tensor:
        """The yaws at which the tool comes nearest to its rotation."""
        turn = rotation.permute(2, 0, 1) @ self._turning.like(rotation)[0].T
        quaternion = quaternion_from_matrix(turn)
        along = quaternion[:, 1:] @ self._unit_axis.like(quaternion)[0]
        return torch.cat([position, wrap(2.0 * torch.atan2(along, quaternion[:, 0]))[None]])

    def to_json(self) -> dict[str, Any]:
        """Kind, dimension, angles and axis."""
        return {
            "kind": self.kind,
            "dimension": self.dimension,
            "rotation": list(self.rpy),
            "axis": list(self.axis),
        }


@dataclass(frozen=True)
class Axis(_OfSpace):
    """T = R³ × S²: the direction of one of the tool's axes given, its roll about it free; rows x, y, z, ax, ay, az.

    Attributes:
        axis: That axis, in the tool frame.
    """

    kind: ClassVar[str] = "axis"

    @property
    def rotations(self) -> Rotations:
        """Directions."""
        return Directions()

    @property
    def constraints(self) -> int:
        """5."""
        return 5

    @property
    def name(self) -> str:
        """R3×S2."""
        return "R3×S2"

    def rotation_error(self, targets: Tensor, rotation: Tensor) -> Tensor:
        """Rotation vectors (2, N) [rad] from the tool's axis to its direction, in a basis perpendicular to that.

        Norms reach π; there, one of all axes is taken.
        """
        wanted = targets[3:]
        along = self._along(rotation)
        across = torch.linalg.cross(along, wanted, dim=0)
        sine = across.norm(dim=0)
        angle = torch.atan2(sine, (along * wanted).sum(0))
        basis = perpendicular(wanted)
        error = (basis * across[:, None]).sum(0) * (angle / sine.clamp_min(1e-300))
        opposite = (sine < 1e-12) & (angle > 1.0)
        return torch.where(opposite, torch.stack([angle, torch.zeros_like(angle)]), error)

    def jacobian(self, jacobian: Tensor, targets: Tensor | None = None) -> Tensor:
        """The rows of position, and those of rotation in the basis perpendicular to the targets' directions."""
        if targets is None:
            raise ParameterError("task", "axis", "position, fixed-rotation, yaw or pose: this does not work with axis")
        basis = perpendicular(targets[3:])
        turning = (basis[:, :, None] * jacobian[3:, None]).sum(0)
        return torch.cat([jacobian[:3], turning])

    def at(self, position: Tensor, rotation: Tensor) -> Tensor:
        """The tools' own axes."""
        return torch.cat([position, self._along(rotation)])

    def _along(self, rotation: Tensor) -> Tensor:
        """The axis in the base frame (3, N)."""
        return torch.einsum("ijN,j->iN", rotation, self._unit_axis.like(rotation)[0])

    def to_json(self) -> dict[str, Any]:
        """Kind, dimension and axis."""
        return {"kind": self.kind, "dimension": self.dimension, "axis": list(self.axis)}


def _turning(axis: tuple[float, float, float], rotation: Tensor) -> OnDevices:
    """What `_turned` needs of a unit axis and a rotation (3, 3): it, and its factors in Rodrigues' formula."""
    x, y, z = axis
    cross = rotation.new_tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return OnDevices(rotation, cross @ rotation, cross @ cross @ rotation)


def _turned(turning: OnDevices, angles: Tensor) -> Tensor:
    """The rotation turned about the axis by angles (N,): (3, 3, N)."""
    rotation, first, second = (matrix[..., None] for matrix in turning.like(angles))
    return rotation + angles.sin() * first + (1.0 - angles.cos()) * second


_YAWED = _turning(_Z, torch.eye(3, dtype=torch.float64))
