"""What a network is trained for: the map's configurations, and the tool where it should be."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from grr_torch.learning.encoding import Encoding
from grr_torch.robots.kinematics import KinematicTree
from grr_torch.robots.robot import Robot
from grr_torch.spaces.task import FixedRotation, TaskSpace

# metres that a radian of rotation error counts as
_ROTATION_LENGTH = 0.3
# the share of the encoding's length which, as a distance from tool to point, counts as much as a radian of a joint
_POSE_SHARE = 0.16


class Loss(NamedTuple):
    """Parts of a loss, each (N,).

    Attributes:
        joints: Squared chords between configurations: 2 (1 − cos Δq) of a continuous joint on the unit circle, Δq² of
            another, scaled one.
        position: Squared distance from the tool to the point [m²].
        rotation: Squared rotation error, 2 (1 − cos θ), almost θ² [rad²].
    """

    joints: Tensor
    position: Tensor
    rotation: Tensor

    def pose(self, scale: float) -> Tensor:
        """(N,) the pose's part, where the encoding's length is `scale` [m]."""
        return (self.position + _ROTATION_LENGTH**2 * self.rotation) / (_POSE_SHARE * scale) ** 2


class IkLoss:
    """Losses of encoded configurations, in float32; forward kinematics is differentiated through."""

    def __init__(self, robot: Robot, task: TaskSpace, encoding: Encoding) -> None:
        self._tree = _float32(robot.tree)
        self._task, self._encoding = task, encoding
        self._rotation = task.rotation.to(self._tree.mounts[0])[..., None] if isinstance(task, FixedRotation) else None

    def __call__(self, encoded: Tensor, targets: Tensor, points: Tensor) -> Loss:
        """The loss of encoded configurations (N, width) against targets (N, width) and points (N, d) [m]."""
        frames = self._tree.frames(self._encoding.decode(encoded).T.contiguous())
        position, rotation = self._tree.tool_pose(frames)
        d = self._task.dimension
        apart = (position[:d] - points[:, :d].T).square().sum(0)
        turned = torch.zeros_like(apart)
        if self._rotation is not None:
            # ‖R − R*‖² = 4 (1 − cos θ)
            turned = 0.5 * (rotation - self._rotation).square().sum((0, 1))
        return Loss((encoded - targets).square().sum(1), apart, turned)


def _float32(tree: KinematicTree) -> KinematicTree:
    links = {name: (frame, pose.float()) for name, (frame, pose) in tree.links.items()}
    return replace(tree, mounts=tuple(mount.float() for mount in tree.mounts), links=links)
