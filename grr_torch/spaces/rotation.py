"""Rotations: quaternions (w, x, y, z), matrices, and the error between two of them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from grr_torch.pieces import FEW


def matrix_from_rpy(roll: float, pitch: float, yaw: float) -> Tensor:
    """Rotation matrix (3, 3) of fixed-axis (extrinsic) xyz Euler angles [rad]."""
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    return torch.tensor(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ],
        dtype=torch.float64,
    )


def quaternion_from_matrix(rotation: Tensor) -> Tensor:
    """Unit quaternions (*batch, 4), w ≥ 0, of rotation matrices (*batch, 3, 3)."""
    m = rotation
    # each row of four candidates is the quaternion times twice one of its components; the largest is well-conditioned
    rows = [
        [1 + m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2], m[..., 2, 1] - m[..., 1, 2],
         m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]],
        [m[..., 2, 1] - m[..., 1, 2], 1 + m[..., 0, 0] - m[..., 1, 1] - m[..., 2, 2],
         m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0]],
        [m[..., 0, 2] - m[..., 2, 0], m[..., 0, 1] + m[..., 1, 0],
         1 - m[..., 0, 0] + m[..., 1, 1] - m[..., 2, 2], m[..., 1, 2] + m[..., 2, 1]],
        [m[..., 1, 0] - m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0],
         m[..., 1, 2] + m[..., 2, 1], 1 - m[..., 0, 0] - m[..., 1, 1] + m[..., 2, 2]],
    ]  # fmt: skip
    candidates = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    largest = candidates.diagonal(dim1=-2, dim2=-1).argmax(-1)
    chosen = torch.take_along_dim(candidates, largest[..., None, None], dim=-2)[..., 0, :]
    unit = chosen / chosen.norm(dim=-1, keepdim=True)
    return torch.where(unit[..., :1] < 0.0, -unit, unit)


def quaternion_distance(first: Tensor, second: Tensor) -> Tensor:
    """D_SO(3) = 1 − |o_i · o_j| (*batch,) of unit quaternions (*batch, 4)."""
    return 1.0 - (first * second).sum(-1).abs()


def slerp(start: Tensor, end: Tensor, fraction: float | Tensor) -> Tensor:
    """Unit quaternions (*batch, 4) on the shorter great arc, `fraction` of the way from start to end."""
    cosine = (start * end).sum(-1, keepdim=True)
    end = torch.where(cosine < 0.0, -end, end)
    # atan2 keeps its accuracy for small angles, where acos does not
    angle = torch.atan2((end - start).norm(dim=-1, keepdim=True), (end + start).norm(dim=-1, keepdim=True)) * 2.0
    sine = angle.sin()
    straight = sine < 1e-9
    divisor = torch.where(straight, 1.0, sine)
    a = torch.where(straight, 1.0 - fraction, ((1.0 - fraction) * angle).sin() / divisor)
    b = torch.where(straight, torch.as_tensor(fraction, dtype=start.dtype), (fraction * angle).sin() / divisor)
    mixed = a * start + b * end
    return mixed / mixed.norm(dim=-1, keepdim=True)


def rotation_error(target: Tensor, rotation: Tensor) -> Tensor:
    """Rotation vectors (3, N) [rad] that turn `rotation` (3, 3, N) into `target` (3, 3, 1 or N), in the base frame.

    Norms reach π; there, where the axis is not unique, one of the two is taken. 27 multiply-adds, an arctangent.
    """
    # vee(T Rᵀ − R Tᵀ) / 2 = ½ Σ columns r × t = axis · sin(angle)
    if rotation.shape[2] <= FEW:
        twisted = 0.5 * torch.linalg.cross(rotation, target.expand_as(rotation), dim=0).sum(1)
    else:
        twisted = torch.stack(
            [
                (rotation[1] * target[2] - rotation[2] * target[1]).sum(0),
                (rotation[2] * target[0] - rotation[0] * target[2]).sum(0),
                (rotation[0] * target[1] - rotation[1] * target[0]).sum(0),
            ]
        ).mul_(0.5)
    cosine = 0.5 * ((rotation * target).sum((0, 1)) - 1.0)
    sine = twisted.square().sum(0).sqrt()
    tiny = sine < 1e-7
    error = twisted * torch.where(tiny, 1.0, torch.atan2(sine, cosine) / sine)
    flipped = tiny & (cosine < 0.0)
    if bool(flipped.any()):
        # at π, T Rᵀ = 2 a aᵀ − 1: any column of T Rᵀ + 1 points along the axis
        product = torch.einsum("ikN,jkN->ijN", target.expand_as(rotation), rotation)[..., flipped]
        outer = product + torch.eye(3, dtype=product.dtype, device=product.device)[..., None]
        column = torch.take_along_dim(outer, outer.norm(dim=0).argmax(0)[None, None], dim=1)[:, 0]
        error[:, flipped] = math.pi * column / column.norm(dim=0)
    return error
