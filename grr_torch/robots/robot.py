"""The robot: a chain from base to tool, its limits, its kinematics and its self-collision model."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from grr_torch.errors import ParameterError
from grr_torch.pieces import are_few, in_pieces, piece
from grr_torch.robots.chain import serial_chain
from grr_torch.robots.few import LIMITS_SLACK, Few
from grr_torch.robots.kinematics import KinematicTree
from grr_torch.robots.presets import Preset
from grr_torch.robots.self_collision import SphereKernel
from grr_torch.robots.spheres import SphereModel
from grr_torch.robots.urdf import Urdf, sampling_range

if TYPE_CHECKING:
    from pytorch_kinematics import SerialChain


@dataclass(frozen=True, eq=False)
class Robot:
    """A serial arm, as `load_robot` makes it. Immutable; all tensors live on one device in one dtype.

    Configurations are (*batch, n) tensors: radians for revolute and continuous joints, metres for prismatic ones.
    Poses are those of the tool frame in the base frame.

    Attributes:
        name: The bundled name, or the URDF's.
        urdf: The URDF it was read from.
        base: Link in whose frame poses are given.
        tool: Link whose pose is controlled.
        joint_names: The n joints of a configuration.
        lower: (n,) lower position limits; −inf where there is none.
        upper: (n,) upper position limits; inf where there is none.
        continuous: (n,) joints of URDF type continuous: their differences are wrapped. (Not one that a mimic joint
            follows by a broken number of turns.)
        velocity_limits: (n,) velocity limits [rad/s or m/s]; inf where there is none.
        held_joints: Values of joints that do not move.
        tree: Constants of the kinematics of all links.
        spheres: The self-collision model, or None: then nothing is checked.
        margin: Distance [m] below which two links count as in collision.
        preset: What the bundled robot is used with unless told otherwise; None for others.
    """

    name: str
    urdf: Urdf
    base: str
    tool: str
    joint_names: tuple[str, ...]
    lower: Tensor
    upper: Tensor
    continuous: Tensor
    velocity_limits: Tensor
    held_joints: Mapping[str, float]
    tree: KinematicTree
    spheres: SphereModel | None
    margin: float
    preset: Preset | None = None

    def __repr__(self) -> str:
        return f"Robot('{self.name}', n={self.n}, base='{self.base}', tool='{self.tool}')"

    @property
    def n(self) -> int:
        """Degrees of freedom."""
        return len(self.joint_names)

    @property
    def dtype(self) -> torch.dtype:
        """Floating-point type of all computations."""
        return self.lower.dtype

    @property
    def device(self) -> torch.device:
        """Device of all computations."""
        return self.lower.device

    @cached_property
    def has_limits(self) -> bool:
        """Whether any joint has position limits."""
        return not bool(self.lower.isinf().all() & self.upper.isinf().all())

    @cached_property
    def few(self) -> Few:
        """For a few configurations on the CPU."""
        return Few(self)

    @cached_property
    def chain(self) -> SerialChain:
        """The chain as a `pytorch_kinematics.SerialChain`, in which mimic joints are degrees of freedom.

        Made when it is first asked for, as pytorch-kinematics takes long to import.
        """
        return serial_chain(self.urdf, self.base, self.tool, self.held_joints, dtype=self.dtype, device=self.device)

    def with_margin(self, margin: float) -> Robot:
        """The same robot with another self-collision margin [m].

        Raises:
            ParameterError: The margin is negative or not finite.
        """
        if not (math.isfinite(margin) and margin >= 0.0):
            raise ParameterError("margin", margin, "0 or more, in metres")
        return replace(self, margin=float(margin))

    def forward_kinematics(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Tool poses.

        Args:
            q: (*batch, n) configurations [rad or m].

        Returns:
            Positions (*batch, 3) [m] and rotation matrices (*batch, 3, 3), in the base frame.

        Raises:
            ParameterError: The last axis is not n.
        """
        position, rotation = self._of_frames(self._tool_pose, self.columns(q))
        return _rows(position, q), _rows(rotation, q)

    def jacobian(self, q: Tensor) -> Tensor:
        """Geometric Jacobians (*batch, 6, n) of the tool: base frame, linear rows [m] above angular ones [rad].

        Args:
            q: (*batch, n) configurations [rad or m].

        Raises:
            ParameterError: The last axis is not n.
        """
        return self.pose_and_jacobian(q)[2]

    def pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Tool poses and Jacobians for the price of one.

        Args:
            q: (*batch, n) configurations [rad or m].

        Returns:
            Positions (*batch, 3) [m], rotation matrices (*batch, 3, 3) and Jacobians (*batch, 6, n).

        Raises:
            ParameterError: The last axis is not n.
        """
        position, rotation, jacobian = self._of_frames(
            lambda frames: (*self._tool_pose(frames), self.tree.jacobian(frames)), self.columns(q)
        )
        return _rows(position, q), _rows(rotation, q), _rows(jacobian, q)

    def link_poses(self, q: Tensor) -> dict[str, Tensor]:
        """Poses T_base_link (*batch, 4, 4) of every link of the robot, also beside and beyond the chain.

        Args:
            q: (*batch, n) configurations [rad or m].

        Raises:
            ParameterError: The last axis is not n.
        """

        def poses(frames: Tensor) -> tuple[Tensor, ...]:
            bottom = frames.new_tensor([0.0, 0.0, 0.0, 1.0])[None, :, None].expand(1, 4, frames.shape[3])
            placed = (self.tree.link_pose(frames, link).transpose(0, 1) for link in self.tree.links)
            return tuple(torch.cat([pose, bottom]) for pose in placed)

        placed = self._of_frames(poses, self.columns(q))
        return {link: _rows(pose, q) for link, pose in zip(self.tree.links, placed, strict=True)}

    def self_collision_distance(self, q: Tensor) -> Tensor:
        """Signed distance (*batch,) [m] of the closest two links of the sphere model; negative in penetration.

        Differentiable. The margin is not subtracted. inf where the robot has no sphere model, NaN where q is NaN.

        Args:
            q: (*batch, n) configurations [rad or m].

        Raises:
            ParameterError: The last axis is not n.
        """
        columns, kernel = self.columns(q), self.sphere_kernel
        if kernel is None:
            return columns.new_full(q.shape[:-1], math.inf)
        (distances,) = self._of_frames(lambda frames: (kernel.distance(frames),), columns)
        return distances.reshape(q.shape[:-1])

    def in_self_collision(self, q: Tensor) -> Tensor:
        """Whether two links are nearer than the margin: (*batch,) bool. False where there is no sphere model.

        What is not finite is not known to be free: True.

        Args:
            q: (*batch, n) configurations [rad or m].

        Raises:
            ParameterError: The last axis is not n.
        """
        return self.columns_in_self_collision(self.columns(q)).reshape(q.shape[:-1])

    def collision_shares(self, q: Tensor) -> dict[tuple[str, str], float]:
        """In what share of configurations each checked pair of links is nearer than the margin; empty if none is.

        Args:
            q: (*batch, n) configurations [rad or m].

        Raises:
            ParameterError: The last axis is not n.
        """
        columns, kernel = self.columns(q), self.sphere_kernel
        if kernel is None:
            return {}
        (touching,) = self._of_frames(lambda frames: (kernel.touching(frames, self.margin),), columns)
        return dict(zip(kernel.names, touching.double().mean(1).tolist(), strict=True))

    def within_limits(self, q: Tensor, tolerance: float = LIMITS_SLACK) -> Tensor:
        """Whether every joint lies within its position limits: (*batch,) bool.

        Args:
            q: (*batch, n) configurations [rad or m].
            tolerance: Excess that is forgiven [rad or m].

        Raises:
            ParameterError: The last axis is not n.
        """
        columns = self.columns(q)
        lower, upper = (limit[:, None] for limit in (self.lower - tolerance, self.upper + tolerance))
        return ((columns >= lower) & (columns <= upper)).all(0).reshape(q.shape[:-1])

    @cached_property
    def _sampling_range(self) -> tuple[Tensor, Tensor]:
        kinds = [self.urdf.joints[name].kind for name in self.joint_names]
        limits = zip(kinds, self.lower.tolist(), self.upper.tolist(), strict=True)
        lower, upper = self.lower.new_tensor([sampling_range(*limit) for limit in limits]).T
        return lower, upper

    def sample(self, k: int, generator: torch.Generator | None = None) -> Tensor:
        """Draws (k, n) configurations, uniform within limits; ±π rad or ±1 m where a joint has none.

        Args:
            k: How many.
            generator: Source of randomness; torch's global one by default.

        Raises:
            ParameterError: k is negative.
        """
        if k < 0:
            raise ParameterError("k", k, "0 or more")
        lower, upper = self._sampling_range
        # drawn on the CPU, so that a seed gives the same configurations on every device
        unit = torch.rand(k, self.n, dtype=self.dtype, generator=generator).to(self.device)
        return lower + (upper - lower) * unit

    def columns(self, q: Tensor) -> Tensor:
        """Configurations (*batch, n) as contiguous columns (n, N) in the robot's dtype, on its device.

        Raises:
            ParameterError: It is no real tensor, or its last axis is not n.
        """
        if not isinstance(q, Tensor) or q.is_complex():
            raise ParameterError("configuration", type(q).__name__, "a real torch tensor")
        if q.ndim == 0 or q.shape[-1] != self.n:
            raise ParameterError("configuration shape", tuple(q.shape), f"(*batch, {self.n})")
        return q.to(device=self.device, dtype=self.dtype).reshape(-1, self.n).T.contiguous()

    def columns_in_self_collision(self, columns: Tensor) -> Tensor:
        """`in_self_collision` for columns (n, N): (N,) bool."""
        kernel = self.sphere_kernel
        if kernel is None:
            return torch.zeros(columns.shape[1], dtype=torch.bool, device=columns.device)
        return self._of_frames(lambda frames: (kernel.collides(frames, self.margin),), columns)[0]

    def _tool_pose(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """`KinematicTree.tool_pose` in memory of its own, so that what is kept does not keep all frames."""
        position, rotation = self.tree.tool_pose(frames)
        return position.clone(), rotation.clone()

    def _of_frames(self, function: Callable[[Tensor], tuple[Tensor, ...]], columns: Tensor) -> tuple[Tensor, ...]:
        """What a function makes of the frames of columns (n, N), a piece at a time."""
        if are_few(columns):
            return function(self.tree.frames(columns))
        workspace = self.tree.workspace(columns, min(columns.shape[1], piece(columns.device)))
        return in_pieces(lambda part: function(self.tree.frames(part, workspace)), columns)

    @cached_property
    def sphere_kernel(self) -> SphereKernel | None:
        """The self-collision model, compiled; None if nothing is checked."""
        return None if self.spheres is None else SphereKernel.compile(self.spheres, self.tree, self.lower)


def _rows(columns: Tensor, q: Tensor) -> Tensor:
    """(…, N) results as (*batch, …), where q is (*batch, n)."""
    return columns.movedim(-1, 0).reshape(*q.shape[:-1], *columns.shape[:-1])
