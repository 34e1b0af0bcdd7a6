"""Poses and Jacobians of all links for many configurations at once, one configuration a column.

A column layout, (n, N) in and (rows, …, N) out, makes every step an operation on long contiguous rows. Each
moving joint gets a *frame*: its link's frame turned so that the joint's axis is the frame's z axis. A frame's
pose is kept as two tensors, `xy` (its x and y axes) and `zp` (its z axis and its origin), each (2, 3, N), because
turning about z touches only the first.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from grr_torch.errors import UrdfError
from grr_torch.robots.urdf import Joint, Matrix, Urdf


class Frame(NamedTuple):
    """Poses of one frame for N configurations, in the base frame.

    Attributes:
        xy: (2, 3, N) x and y axes.
        zp: (2, 3, N) z axis and origin [m].
    """

    xy: Tensor
    zp: Tensor

    def place(self, points: Tensor) -> Tensor:
        """Base-frame positions (S, 3, N) of points given as (S, 4) homogeneous coordinates in this frame."""
        width = self.zp.shape[2]
        placed = torch.addmm(
            points[:, 2:] @ self.zp.reshape(2, 3 * width), points[:, :2], self.xy.reshape(2, 3 * width)
        )
        return placed.view(len(points), 3, width)


@dataclass(frozen=True)
class MovingJoint:
    """A joint whose value depends on the configuration.

    Attributes:
        parent: Index of the frame it is mounted on; −1 for the base.
        revolute: Turns about the frame's z axis if true, slides along it otherwise.
        dof: The configuration entry that drives it.
        multiplier: Joint value = multiplier · q[dof] + offset (1 and 0 unless it is a mimic joint).
        offset: See `multiplier`.
    """

    parent: int
    revolute: bool
    dof: int
    multiplier: float
    offset: float


@dataclass(frozen=True)
class KinematicTree:
    """Constants of the forward kinematics of a robot's whole tree of links.

    Attributes:
        joints: The moving joints, parents first; joint i drives frame i.
        mounts: For each joint (6, 4): rows that give x, y, y, −x, z and origin of its frame at value zero as
            combinations of its parent frame's x, y, z and origin.
        links: For each link: the frame it is fixed to (−1: the base), and its (4, 4) pose in that frame.
        tool: The link at the end of the chain.
        path: Frames from the base to the tool.
        n: Degrees of freedom.
    """

    joints: tuple[MovingJoint, ...]
    mounts: tuple[Tensor, ...]
    links: Mapping[str, tuple[int, Tensor]]
    tool: str
    path: tuple[int, ...]
    n: int

    def frames(self, q: Tensor) -> list[Frame]:
        """Poses of all frames for configurations q (n, N); the base is appended, so that index −1 finds it.

        About 70 multiply-adds a joint and configuration: a (6, 4) by (4, 3) product and the turn about z.
        """
        base = _identity(q)
        angles = self._joint_values(q)
        cosines, sines = angles.cos(), angles.sin()
        frames: list[Frame] = []
        width = q.shape[1]
        for index, (joint, mount) in enumerate(zip(self.joints, self.mounts, strict=True)):
            parent = base if joint.parent < 0 else frames[joint.parent]
            at_zero = torch.addmm(
                mount[:, 2:] @ parent.zp.reshape(2, 3 * width), mount[:, :2], parent.xy.reshape(2, 3 * width)
            ).view(6, 3, width)
            if joint.revolute:
                # x' = c·x + s·y and y' = c·y − s·x, both at once
                xy = torch.addcmul(at_zero[:2] * cosines[index], at_zero[2:4], sines[index])
                frames.append(Frame(xy, at_zero[4:]))
            else:
                moved = torch.stack([at_zero[4], torch.addcmul(at_zero[5], at_zero[4], angles[index])])
                frames.append(Frame(at_zero[:2], moved))
        frames.append(base)
        return frames

    def tool_pose(self, frames: Sequence[Frame]) -> tuple[Tensor, Tensor]:
        """Tool position (3, N) [m] and rotation (3, 3, N): second index counts the tool's axes."""
        index, pose = self.links[self.tool]
        columns = frames[index].place(pose.T.contiguous())
        return columns[3], columns[:3].transpose(0, 1)

    def jacobian(self, frames: Sequence[Frame], position: Tensor) -> Tensor:
        """(6, n, N) geometric Jacobian of the tool at `position` (3, N): linear rows first, base frame.

        Column of a revolute joint: (z × (p_tool − p), z); of a prismatic one: (z, 0).
        """
        path = self.path
        axes = torch.stack([frames[i].zp[0] for i in path], dim=1)
        arms = position[:, None] - torch.stack([frames[i].zp[1] for i in path], dim=1)
        ax, ay, az = axes
        rx, ry, rz = arms
        rows = torch.stack([ay * rz - az * ry, az * rx - ax * rz, ax * ry - ay * rx, ax, ay, az])
        sliding = [k for k, i in enumerate(path) if not self.joints[i].revolute]
        if sliding:
            keep = torch.ones(len(path), 1, dtype=rows.dtype, device=rows.device)
            keep[sliding] = 0.0
            rows = rows * keep + torch.cat([axes, torch.zeros_like(axes)]) * (1.0 - keep)
        dofs = [self.joints[i].dof for i in path]
        if dofs == list(range(self.n)) and all(self.joints[i].multiplier == 1.0 for i in path):
            return rows
        # mimic joints: ∂/∂q sums over the joints that q drives
        drive = rows.new_zeros(self.n, len(path))
        for k, i in enumerate(path):
            drive[dofs[k], k] = self.joints[i].multiplier
        return torch.einsum("dk,rkN->rdN", drive, rows)

    def _joint_values(self, q: Tensor) -> Tensor:
        dofs = [joint.dof for joint in self.joints]
        values = q if dofs == list(range(self.n)) else q[dofs]
        if all(joint.multiplier == 1.0 and joint.offset == 0.0 for joint in self.joints):
            return values
        scale = q.new_tensor([[joint.multiplier] for joint in self.joints])
        shift = q.new_tensor([[joint.offset] for joint in self.joints])
        return values * scale + shift


def _identity(q: Tensor) -> Frame:
    width = q.shape[1]
    axes = torch.eye(4, 3, dtype=q.dtype, device=q.device)
    columns = axes[:, :, None].expand(4, 3, width).contiguous()
    return Frame(columns[:2], columns[2:])


def compile_tree(
    urdf: Urdf,
    path: Sequence[Joint],
    base: str,
    tool: str,
    held: Mapping[str, float],
    *,
    dtype: torch.dtype,
    device: torch.device,
) -> KinematicTree:
    """Folds a URDF's fixed and held joints into constants.

    Args:
        urdf: The robot.
        path: Joints from `base` to `tool`.
        base: Link in whose frame everything is expressed.
        tool: Link at the end of the chain.
        held: Values of joints that do not move [rad or m]; joints outside the chain that are not named stay at 0.
        dtype: Of the constants.
        device: Of the constants.
    """
    dofs = {joint.name: i for i, joint in enumerate(degrees_of_freedom(path, held))}
    joints: list[MovingJoint] = []
    mounts: list[Matrix] = []
    to_base = np.eye(4)
    for joint in urdf.path(urdf.root, base):
        dof, _, offset = _drive(urdf, joint, dofs, held)
        if dof is not None:
            raise UrdfError(urdf.name, f"joint '{joint.name}' above base '{base}' mimics a joint of the chain")
        to_base = to_base @ joint.origin @ joint_motion(joint, offset)
    links: dict[str, tuple[int, Matrix]] = {urdf.root: (-1, np.asarray(np.linalg.inv(to_base), dtype=np.float64))}
    waiting = list(urdf.joints.values())
    while waiting:
        joint = next(joint for joint in waiting if joint.parent in links)
        waiting.remove(joint)
        frame, pose = links[joint.parent]
        dof, multiplier, offset = _drive(urdf, joint, dofs, held)
        if dof is None:
            links[joint.child] = (frame, pose @ joint.origin @ joint_motion(joint, offset))
            continue
        align = _align_z(joint.axis)
        joints.append(MovingJoint(frame, joint.kind != "prismatic", dof, multiplier, offset))
        mounts.append(pose @ joint.origin @ align)
        links[joint.child] = (len(joints) - 1, align.T)

    def constant(matrix: Matrix) -> Tensor:
        return torch.tensor(matrix, dtype=dtype, device=device)

    return KinematicTree(
        joints=tuple(joints),
        # rows x, y, y, −x, z, p of the frame at zero
        mounts=tuple(constant((m.T)[[0, 1, 1, 0, 2, 3]] * [[1], [1], [1], [-1], [1], [1]]) for m in mounts),
        links={link: (frame, constant(pose)) for link, (frame, pose) in links.items()},
        tool=tool,
        path=tuple(_frame_path(joints, links[tool][0])),
        n=len(dofs),
    )


def degrees_of_freedom(path: Sequence[Joint], held: Mapping[str, float]) -> list[Joint]:
    """The joints of a chain that a configuration has an entry for: movable, not held, not mimicking."""
    return [joint for joint in path if joint.movable and joint.name not in held and joint.mimic is None]


def _drive(
    urdf: Urdf, joint: Joint, dofs: Mapping[str, int], held: Mapping[str, float]
) -> tuple[int | None, float, float]:
    """(dof, multiplier, offset) of a joint's value; dof None: constant at `offset`."""
    if joint.name in dofs:
        return dofs[joint.name], 1.0, 0.0
    if joint.name in held or joint.mimic is None:
        return None, 0.0, held.get(joint.name, 0.0)
    source, multiplier, offset = joint.mimic
    dof, inner, shift = _drive(urdf, urdf.joints[source], dofs, held)
    return dof, multiplier * inner, multiplier * shift + offset


def joint_motion(joint: Joint, value: float) -> Matrix:
    """(4, 4) displacement of a joint at a constant value."""
    motion = np.eye(4)
    if joint.kind == "prismatic":
        motion[:3, 3] = value * joint.axis
    elif joint.movable:
        x, y, z = joint.axis
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        motion[:3, :3] += math.sin(value) * cross + (1.0 - math.cos(value)) * cross @ cross
    return motion


def _align_z(axis: Matrix) -> Matrix:
    """(4, 4) rotation whose z column is `axis`."""
    z = axis
    helper = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    align = np.eye(4)
    align[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    return align


def _frame_path(joints: Sequence[MovingJoint], frame: int) -> list[int]:
    path: list[int] = []
    while frame >= 0:
        path.append(frame)
        frame = joints[frame].parent
    return path[::-1]
