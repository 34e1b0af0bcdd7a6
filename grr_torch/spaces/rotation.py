"""Rotations: quaternions (w, x, y, z), matrices, and the error between two of them."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from grr_torch.pieces import Array, some

# below any sine of an angle that is not 0, and above what a division makes infinite
_TINY = 1e-30
# how far from −1 cosines are of angles to which the axis may have to be found otherwise, and sines of such angles
_HALF_TURN = 1e-12
_STRAIGHT = 1e-7
# cosines below which that is so, by precision
_FLIPPED = {
    np.dtype(kind): -1.0 + max(_HALF_TURN, 8.0 * float(np.finfo(kind).eps)) for kind in (np.float64, np.float32)
}


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


def matrix_from_quaternion(quaternions: Tensor) -> Tensor:
    """Rotation matrices (3, 3, N) of unit quaternions (4, N)."""
    w, x, y, z = quaternions
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row) for row in rows])


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
    """D_SO(3) = 1 − |o_i · o_j| (*batch,) of unit quaternions (*batch, 4), as ½ ‖o_i ∓ o_j‖²: exact for near ones."""
    return 0.5 * torch.minimum((first - second).square().sum(-1), (first + second).square().sum(-1))


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
    turn = _product(target, rotation)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(0) for row in turn.unbind(0))
    # its antisymmetric part is axis · sin(angle), its trace 2 cos(angle) + 1
    twisted = torch.stack([zy - yz, xz - zx, yx - xy]).mul_(0.5)
    cosine = (xx + yy).add_(zz).sub_(1.0).mul_(0.5)
    # the tiny number is lost beside any sine but 0
    sine = twisted.square().sum(0).sqrt_().add_(_TINY)
    error = twisted * torch.atan2(sine, cosine).div_(sine)
    precision = torch.finfo(turn.dtype).eps
    flipped = cosine < -1.0 + max(_HALF_TURN, 8.0 * precision)
    if bool(flipped.any()):
        flipped &= sine < max(_STRAIGHT, precision**0.5)
        # at π, T Rᵀ = 2 a aᵀ − 1: any column of T Rᵀ + 1 points along the axis
        outer = turn[..., flipped] + torch.eye(3, dtype=turn.dtype, device=turn.device)[..., None]
        column = torch.take_along_dim(outer, outer.norm(dim=0).argmax(0)[None, None], dim=1)[:, 0]
        error[:, flipped] = math.pi * column / column.norm(dim=0)
    return error


def turning_terms(target: Array) -> Array:
    """(4, 9) what of the entries of Rᵀ makes axis · sin(angle) and cos(angle) + ½ of T Rᵀ, for one target T (3, 3)."""
    terms = np.zeros((4, 3, 3), target.dtype)
    x, y, z = target
    terms[0, :, 1], terms[0, :, 2] = z, -y
    terms[1, :, 2], terms[1, :, 0] = x, -z
    terms[2, :, 0], terms[2, :, 1] = y, -x
    terms[3] = target.T
    return 0.5 * terms.reshape(4, 9)


def rotation_error_of_few(target: Array, terms: Array, rotation: Array) -> Array:
    """`rotation_error` for arrays, of one target (3, 3) with its `turning_terms`: a fifth of its time."""
    mixed = terms.astype(rotation.dtype, copy=False) @ rotation.transpose(1, 0, 2).reshape(9, -1)
    twisted, cosine = mixed[:3], mixed[3] - 0.5
    if some(cosine < _FLIPPED[rotation.dtype]):
        tensors = torch.from_numpy(target).to(torch.from_numpy(rotation))[..., None], torch.from_numpy(rotation)
        return rotation_error(*tensors).numpy()
    sine = np.sqrt((twisted * twisted).sum(0)) + _TINY
    return twisted * (np.arctan2(sine, cosine) / sine)


def _product(target: Tensor, rotation: Tensor) -> Tensor:
    """T Rᵀ (3, 3, N) for T (3, 3, 1 or N) and R (3, 3, N)."""
    if target.shape[2] == 1:
        return torch.mm(target[..., 0], rotation.transpose(0, 1).reshape(3, -1)).view_as(rotation)
    first, *others = zip(target.unbind(1), rotation.unbind(1), strict=True)
    product = first[0][:, None] * first[1]
    for axis, other in others:
        product.addcmul_(axis[:, None], other)
    return product
