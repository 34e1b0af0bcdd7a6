"""How a Jacobian turns with the configuration: the second derivative of the tool's pose, against a force on it."""

from __future__ import annotations

import torch
from torch import Tensor

from grr_torch.robots.kinematics import KinematicTree


def force_derivative(tree: KinematicTree, frames: Tensor, wrench: Tensor) -> Tensor:
    """∂(Jᵀ w)/∂q (n, n, N), J the geometric Jacobian of the tool and w a wrench that stays as it is.

    A joint moves all that lies behind it. So for a joint k at or before l on the way to the tool, with axis ω (0 of a
    sliding joint) and linear column v, ∂v_l/∂q_k = ∂v_k/∂q_l = ω_k × v_l and ∂ω_l/∂q_k = ω_k × ω_l, while
    ∂ω_k/∂q_l = 0: forces give a symmetric matrix, moments do not.

    Args:
        tree: Of the robot.
        frames: (F, 4, 3, N) from `KinematicTree.frames`.
        wrench: (6, N) force above moment, in the base frame.
    """
    path = list(tree.path)
    joints = [tree.joints[i] for i in path]
    turns = torch.tensor([joint.revolute for joint in joints], device=frames.device)[:, None, None]
    axes = frames[path, 2]
    linear = torch.where(turns, torch.linalg.cross(axes, frames[-2, 3] - frames[path, 3], dim=1), axes)
    spins = torch.where(turns, axes, 0.0)
    force, moment = (part.expand_as(spins) for part in wrench.split(3))
    forces = torch.einsum("lin,kin->nlk", linear, torch.linalg.cross(force, spins, dim=1)).tril()
    moments = torch.einsum("lin,kin->nlk", spins, torch.linalg.cross(moment, spins, dim=1)).tril(-1)
    both = forces + forces.tril(-1).mT + moments
    drive = frames.new_zeros(tree.n, len(path))
    for k, joint in enumerate(joints):
        drive[joint.dof, k] = joint.multiplier
    return (drive @ both @ drive.T).permute(1, 2, 0)
