"""Small symmetric positive definite systems, one a column, solved by an elimination unrolled over their rows."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import torch
from scipy.linalg.lapack import dposv
from torch import Tensor

from grr_torch.pieces import Array

# up to so many columns torch.linalg's own routines are faster
_FEW = 16
# and those up to which, on the CPU, numpy's are, and up to which it is as fast to call LAPACK for each
_LAPACK, _ONE_BY_ONE = 64, 6


def damped_least_squares(jacobian: Tensor, error: Tensor, damping: Tensor) -> Tensor:
    """Steps (n, N) = Jᵀ (J Jᵀ + λ)⁻¹ e: of all steps that reduce the error as much, the shortest.

    About m²n + m³ multiply-adds a column.

    Args:
        jacobian: (m, n, N).
        error: (m, N).
        damping: (N,) λ > 0.
    """
    if jacobian.shape[2] <= _FEW:
        tracked = torch.is_grad_enabled() and (jacobian.requires_grad or error.requires_grad)
        if jacobian.device.type == "cpu" and jacobian.dtype == torch.float64 and not tracked:
            arrays = (tensor.detach().numpy() for tensor in (jacobian, error, damping))
            return torch.from_numpy(damped_least_squares_of_few(*arrays))
        rows = jacobian.permute(2, 0, 1)
        normal = rows @ rows.mT
        normal.diagonal(dim1=1, dim2=2).add_(damping[:, None])
        factor = torch.linalg.cholesky_ex(normal)[0]
        return (rows.mT @ torch.cholesky_solve(error.T[..., None], factor))[..., 0].T
    m, _, count = jacobian.shape
    block = jacobian.new_empty(m, m + 1, count)
    normal, right = block.split_with_sizes((m, 1), 1)
    # a joint at a time: all products at once would leave the cache
    first, *others = jacobian.unbind(1)
    torch.mul(first[:, None], first, out=normal)
    for column in others:
        normal.addcmul_(column[:, None], column)
    normal.diagonal(dim1=0, dim2=1).add_(damping[:, None])
    right.copy_(error[:, None])
    return transposed_product(jacobian, _eliminate(block, m)[:, 0])


def damped_least_squares_of_few(jacobian: Array, error: Array, damping: Array) -> Array:
    """`damped_least_squares` for arrays, by LAPACK where they are few; NaN where a system is singular all the same."""
    # in single precision the damping may be lost, and one singular column would make LAPACK give up all
    if jacobian.shape[2] > _LAPACK or jacobian.dtype != np.float64:
        return damped_least_squares(*(torch.from_numpy(array) for array in (jacobian, error, damping))).numpy()
    rows = jacobian.transpose(2, 0, 1)
    columns = rows.transpose(0, 2, 1)
    normal = rows @ columns
    normal.reshape(len(rows), len(error) ** 2)[:, :: len(error) + 1] += damping[:, None]
    if len(rows) > _ONE_BY_ONE:
        with suppress(np.linalg.LinAlgError):  # one of them is singular
            return (columns @ np.linalg.solve(normal, error.T[..., None]))[..., 0].T
    step = np.full(jacobian.shape[1:], np.nan)
    for k, (system, transposed) in enumerate(zip(normal, columns, strict=True)):
        _, solved, failed = dposv(system.T, error[:, k])
        if not failed:
            step[:, k] = transposed @ solved
    return step


def null_space_projector(jacobian: Tensor, damping: float) -> Tensor:
    """P (n, n, N) = 1 − Jᵀ (J Jᵀ + λ)⁻¹ J: what of a motion leaves the task alone."""
    _, n, count = jacobian.shape
    normal = (jacobian[:, None] * jacobian).sum(2)
    normal.diagonal(dim1=0, dim2=1).add_(damping)
    solved = solve_spd(normal, jacobian)
    projector = torch.eye(n, dtype=jacobian.dtype, device=jacobian.device)[..., None].repeat(1, 1, count)
    for row, factors in zip(jacobian, solved, strict=True):
        projector.addcmul_(row[:, None], factors, value=-1.0)
    return projector


def transposed_product(jacobian: Tensor, right: Tensor) -> Tensor:
    """Jᵀ b (n, N) for J (m, n, N) and b (m, N)."""
    result = jacobian[0] * right[0]
    for row, factor in zip(jacobian[1:], right[1:], strict=True):
        result.addcmul_(row, factor)
    return result


def solve_spd(matrix: Tensor, right: Tensor) -> Tensor:
    """Solves A X = B for N symmetric positive definite systems at once, by Gauss–Jordan elimination.

    A positive definite system needs no pivoting. Every step clears one column above and below its pivot at once, so
    it takes six calls a row, and m³/2 + k m² multiply-adds a system.

    Args:
        matrix: (m, m, N) A.
        right: (m, k, N) B.

    Returns:
        (m, k, N) solutions.
    """
    return _eliminate(torch.cat([matrix, right], dim=1), len(matrix))


def _eliminate(block: Tensor, m: int) -> Tensor:
    """`solve_spd` of systems (m, m + k, N), A beside B."""
    _, width, count = block.shape
    for columns_left in range(width - 1, width - m - 1, -1):
        column, others = block.split_with_sizes((1, columns_left), 1)
        pivot, factors = column.split_with_sizes((1, m - 1))
        row, rest = others.split_with_sizes((1, m - 1))
        block = block.new_empty(m, columns_left, count)
        # the row goes last: after m steps all are back in order
        cleared, last = block.split_with_sizes((m - 1, 1))
        torch.div(row, pivot, out=last)
        torch.addcmul(rest, factors, last, value=-1.0, out=cleared)
    return block
