"""Folding a URDF's joints into the constants of a `KinematicTree`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from grr_torch.errors import UrdfError
from grr_torch.robots.kinematics import KinematicTree, MovingJoint
from grr_torch.robots.urdf import Joint, Matrix, Urdf


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
        return torch.tensor(np.ascontiguousarray(matrix), dtype=dtype, device=device)

    return KinematicTree(
        joints=tuple(joints),
        mounts=tuple(constant(mount.T) for mount in mounts),
        links={link: (frame, constant(pose.T)) for link, (frame, pose) in links.items()},
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
