"""A robot's figures and checks for a few configurations on the CPU, in arrays.

Up to some hundred configurations the cost is that of calls, and a call of numpy costs a third of one of torch.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch

from grr_torch.pieces import FEW, Array, Mask

if TYPE_CHECKING:
    from grr_torch.robots.robot import Robot
    from grr_torch.robots.self_collision import SphereKernel

# excess over a joint limit that is forgiven [rad or m]
LIMITS_SLACK = 1e-9


class Few:
    """A robot's kinematics, limits and self-collision, of a few configurations as columns (n, N)."""

    def __init__(self, robot: Robot) -> None:
        self._robot, self.kinematics = robot, robot.tree.few

    @cached_property
    def limits(self) -> tuple[Array, Array] | None:
        """(n, 1) lower and upper joint limits; None where no joint has any."""
        robot = self._robot
        return (robot.lower.numpy()[:, None], robot.upper.numpy()[:, None]) if robot.has_limits else None

    @cached_property
    def turns(self) -> Array:
        """(n, 1) a whole turn of continuous joints, 0 of others."""
        robot = self._robot
        return 2.0 * math.pi * robot.continuous.numpy()[:, None].astype(robot.lower.numpy().dtype)

    def tool_pose(self, columns: Array) -> tuple[Array, Array]:
        """Positions (3, N) and rotations (3, 3, N) of the tool."""
        tool = self.kinematics.frames(columns)[-2]
        return tool[3], tool[:3].transpose(1, 0, 2)

    def within_limits(self, columns: Array) -> Mask:
        """`Robot.within_limits`: (N,) bool."""
        if self.limits is None:
            return np.ones(columns.shape[1], dtype=bool)
        lower, upper = self.limits
        return np.asarray(((columns >= lower - LIMITS_SLACK) & (columns <= upper + LIMITS_SLACK)).all(0))

    def in_self_collision(self, columns: Array) -> Mask:
        """`Robot.columns_in_self_collision`: (N,) bool."""
        kernel = self._robot.sphere_kernel
        if kernel is None or self._are_many(kernel, columns):
            return self._robot.columns_in_self_collision(torch.from_numpy(columns)).numpy()
        return kernel.few.collides(self.kinematics.frames(columns), self._robot.margin)

    def may_collide_near(self, columns: Array, motions: Array) -> Mask:
        """Configurations (N,) within whose motions (n, N), to either side, a self-collision is not ruled out.

        It is where no two links' bounding spheres come near each other, however the joints move by as much; it is not
        of more configurations than a few.
        """
        kernel = self._robot.sphere_kernel
        if kernel is None or self._are_many(kernel, columns):
            return np.full(columns.shape[1], kernel is not None)
        return kernel.few.may_collide_near(self.kinematics.frames(columns), self._robot.margin, motions)

    @staticmethod
    def _are_many(kernel: SphereKernel, columns: Array) -> bool:
        return columns.shape[1] > min(FEW, kernel.most_of_few)
