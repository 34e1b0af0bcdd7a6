"""The chain by pytorch-kinematics.

Its own URDF reader rounds offsets to float32, and takes an unwritten limit for (0, 0); so its frames are made here,
from a URDF that was read in float64.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch

from grr_torch.robots.compile_tree import joint_motion
from grr_torch.robots.urdf import Joint, Urdf

if TYPE_CHECKING:
    from pytorch_kinematics import SerialChain


def serial_chain(
    urdf: Urdf, base: str, tool: str, held: Mapping[str, float], *, dtype: torch.dtype, device: torch.device
) -> SerialChain:
    """The chain from `base` to `tool`; held joints are fixed, mimic joints are degrees of freedom."""
    from pytorch_kinematics import SerialChain
    from pytorch_kinematics.chain import Chain
    from pytorch_kinematics.frame import Frame, Link

    kind: dict[str, Any] = {"dtype": dtype, "device": device}
    frames = {link: Frame(link, link=Link(link)) for link in urdf.links}
    for joint in urdf.joints.values():
        frames[joint.child].joint = _joint(joint, held.get(joint.name), **kind)
        frames[joint.parent].add_child(frames[joint.child])
    frames[urdf.root].to(**kind)
    return SerialChain(Chain(frames[urdf.root], **kind), tool, base, **kind)


def _joint(joint: Joint, held: float | None, **kind: Any) -> Any:
    from pytorch_kinematics import Transform3d
    from pytorch_kinematics.frame import Joint as ChainJoint

    fixed = held is not None or not joint.movable
    origin = joint.origin if held is None else joint.origin @ joint_motion(joint, held)
    return ChainJoint(
        joint.name,
        offset=Transform3d(matrix=torch.tensor(origin, **kind), **kind),
        joint_type="fixed" if fixed else "prismatic" if joint.kind == "prismatic" else "revolute",
        axis=torch.tensor(joint.axis, **kind),
        limits=(joint.lower, joint.upper),
        velocity_limits=(-joint.velocity, joint.velocity),
        **kind,
    )
