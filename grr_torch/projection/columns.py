"""Small symmetric positive definite systems, one a column, solved by an unrolled LDLᵀ factorisation."""

from __future__ import annotations

import torch
from torch import Tensor


def damped_least_squares(jacobian: Tensor, error: Tensor, damping: Tensor) -> Tensor:
    """Steps (n, N) = Jᵀ (J Jᵀ + λ)⁻¹ e: of all steps that reduce the error as much, the shortest.

    About m²n + m³/3 multiply-adds a column.

    Args:
        jacobian: (m, n, N).
        error: (m, N).
        damping: (N,) λ > 0.
    """
    rows = [(jacobian[i] * jacobian[i:]).sum(1) for i in range(len(jacobian))]
    solution = solve_spd(rows, error, damping)
    return (jacobian * solution[:, None]).sum(0)


def solve_spd(rows: list[Tensor], right: Tensor, damping: Tensor) -> Tensor:
    """Solves (A + λ) x = b for N systems at once.

    Args:
        rows: Row i of the upper triangles of A, from the diagonal on: (m − i, N).
        right: (m, N) right-hand sides b.
        damping: (N,) λ, added to the diagonal.

    Returns:
        (m, N) solutions.
    """
    m = len(rows)
    # A + λ = L D Lᵀ: column i of L below its unit diagonal, and the pivots D
    factors: list[Tensor] = []
    pivots: list[Tensor] = []
    for i in range(m):
        column = rows[i]
        for k in range(i):
            # pivot_k · l_ik · l_jk for all j ≥ i
            below = factors[k][i - k - 1 :]
            column = torch.addcmul(column, below, below[0] * pivots[k], value=-1.0)
        pivot = column[0] + damping
        pivots.append(pivot)
        factors.append(column[1:] / pivot)
    forward = list(right.unbind(0))
    for i in range(m):
        for j in range(i + 1, m):
            forward[j] = torch.addcmul(forward[j], factors[i][j - i - 1], forward[i], value=-1.0)
    solution: list[Tensor] = [forward[i] / pivots[i] for i in range(m)]
    for i in range(m - 1, -1, -1):
        for j in range(i + 1, m):
            solution[i] = torch.addcmul(solution[i], factors[i][j - i - 1], solution[j], value=-1.0)
    return torch.stack(solution)
