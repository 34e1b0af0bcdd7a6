"""The projection of a few columns on the CPU: the iteration of `project_columns`, with calls of numpy.

There is nothing to gain from pieces that stay in the cache here, and no need to put them together again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from grr_torch.pieces import Array
from grr_torch.projection.columns import damped_least_squares
from grr_torch.projection.step import (
    DAMPING,
    FALLEN,
    LEAST_DAMPING,
    LONGEST_STEP,
    PATIENCE,
    ROTATION_LENGTH,
    SHORTEST_STEP,
    Equations,
    Limits,
    nudge,
    stop_at_limits,
)
from grr_torch.robots.robot import Robot
from grr_torch.spaces.task import TaskSpace

# columns up to which LAPACK's solver is faster
_LAPACK = 64

if TYPE_CHECKING:
    from grr_torch.projection.project import Tolerances


# errors of a hostile guess may be beyond all numbers: they do not converge
@np.errstate(over="ignore", invalid="ignore")
def converge_few(
    robot: Robot, task: TaskSpace, tolerances: Tolerances, limits: Limits | None, targets: Tensor, q: Tensor
) -> tuple[Tensor, Tensor]:
    """Configurations (n, N), NaN where not converged, and converged (N,), for points (width, N) and guesses (n, N)."""
    few, wanted = robot.tree.few, targets.numpy()
    solved, valid = np.full(q.shape, np.nan, q.numpy().dtype), np.zeros(q.shape[1], dtype=bool)
    now = (q if limits is None else q.clamp(*limits)).numpy()
    rank = np.arange(q.shape[1])
    best = before = np.full(q.shape[1], np.inf)
    for iteration in range(tolerances.iterations + 1):
        frames = few.frames(now)
        error = task.error_of_few(wanted, frames[-2, 3], frames[-2, :3].transpose(1, 0, 2))
        squared = error * error
        translation, rotation = squared[: task.dimension].sum(0), squared[task.dimension :].sum(0)
        done = (translation <= tolerances.position**2) & (rotation <= tolerances.rotation**2)
        size = translation + ROTATION_LENGTH**2 * rotation
        best = np.minimum(best, size)
        kept = ~done
        if (iteration + 1) % PATIENCE == 0:
            kept &= best < FALLEN * before
            before = best
        if not kept.all():
            solved[:, rank[done]], valid[rank[done]] = now[:, done], True
            if not kept.any():
                break
            rank, best, before, size, now = rank[kept], best[kept], before[kept], size[kept], now[:, kept]
            error, frames, wanted = error[:, kept], frames[..., kept], wanted[:, kept]
        jacobian = task.jacobian(torch.from_numpy(few.jacobian(frames)), torch.from_numpy(wanted)).numpy()
        jacobian[task.dimension :] *= ROTATION_LENGTH
        error[task.dimension :] *= ROTATION_LENGTH
        now = _step(limits, now, jacobian, error, 0.5 * DAMPING * size + LEAST_DAMPING)
    return torch.from_numpy(solved), torch.from_numpy(valid)


def _step(limits: Limits | None, q: Array, jacobian: Array, error: Array, damping: Array) -> Array:
    """Configurations (n, M) after a step within limits: `free_step`, and `stop_at_limits` where one is met."""
    step = _damped_least_squares(jacobian, error, damping)
    longest = np.abs(step).max(0)
    if (longest < SHORTEST_STEP).any():
        # at a stationary point, such as a straight arm, any direction may lead on
        step = np.where(longest < SHORTEST_STEP, nudge(torch.from_numpy(step)).numpy(), step)
    moved = q + step * (LONGEST_STEP / np.maximum(longest, LONGEST_STEP))
    if limits is None:
        return moved
    kept = np.clip(moved, limits.lower.numpy(), limits.upper.numpy())
    stopped = (kept != moved).any(0).nonzero()[0]
    if len(stopped):
        columns_ = torch.from_numpy(stopped)
        parts = (torch.from_numpy(np.ascontiguousarray(part[..., stopped])) for part in (q, jacobian, error, damping))
        redone = stop_at_limits(limits, Equations(columns_, *parts), torch.from_numpy(moved[:, stopped]))
        kept[:, stopped] = redone.numpy()
    return kept


def _damped_least_squares(jacobian: Array, error: Array, damping: Array) -> Array:
    """`columns.damped_least_squares`: steps (n, M); LAPACK, one call for all, is faster for very few."""
    # in single precision the damping may be lost, and one singular column would make LAPACK give up all
    if jacobian.shape[2] > _LAPACK or jacobian.dtype != np.float64:
        return damped_least_squares(*(torch.from_numpy(array) for array in (jacobian, error, damping))).numpy()
    rows = jacobian.transpose(2, 0, 1)
    columns = rows.transpose(0, 2, 1)
    normal = rows @ columns
    diagonal = np.arange(len(error))
    normal[:, diagonal, diagonal] += damping[:, None]
    return (columns @ np.linalg.solve(normal, error.T[..., None]))[..., 0].T
