"""The projection of a few columns on the CPU: the iteration of `project_columns`, with calls of numpy.

There is nothing to gain from pieces that stay in the cache here, and no need to put them together again.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from grr_torch.pieces import Array, Mask, some
from grr_torch.projection.columns import damped_least_squares_of_few
from grr_torch.projection.step import (
    DAMPING,
    FALLEN,
    LEAST_DAMPING,
    LONGEST_STEP,
    PATIENCE,
    ROTATION_LENGTH,
    SHORTEST_STEP,
)
from grr_torch.robots.robot import Robot
from grr_torch.spaces.task import TaskSpace

if TYPE_CHECKING:
    from grr_torch.projection.project import Tolerances


# errors of a hostile guess may be beyond all numbers: they do not converge
@np.errstate(over="ignore", invalid="ignore")
def project_few(robot: Robot, task: TaskSpace, tolerances: Tolerances, targets: Array, q: Array) -> tuple[Array, Mask]:
    """Configurations (n, N), NaN where not converged, and converged (N,), for points (width, N) and guesses (n, N)."""
    few, rows, limits = robot.few.kinematics, task.dimension, robot.few.limits
    solved, valid = np.full(q.shape, np.nan, q.dtype), np.zeros(q.shape[1], dtype=bool)
    now = q if limits is None else _clamped(q, limits)
    rank = np.arange(q.shape[1])
    best = before = np.full(q.shape[1], np.inf)
    for iteration in range(tolerances.iterations + 1):
        frames = few.frames(now)
        error = task.error_of_few(targets, frames[-2, 3], frames[-2, :3].transpose(1, 0, 2))
        squared = error * error
        translation, rotation = squared[:rows].sum(0), squared[rows:].sum(0)
        done = (translation <= tolerances.position**2) & (rotation <= tolerances.rotation**2)
        size = translation + ROTATION_LENGTH**2 * rotation
        best = np.minimum(best, size)
        kept = ~done
        if (iteration + 1) % PATIENCE == 0:
            kept &= best < FALLEN * before
            before = best
        left = np.count_nonzero(kept)
        if left < len(kept):
            solved[:, rank[done]], valid[rank[done]] = now[:, done], True
        if left == 0 or iteration == tolerances.iterations:
            break
        if left < len(kept):
            rank, best, before, size, now = rank[kept], best[kept], before[kept], size[kept], now[:, kept]
            error, frames, targets = error[:, kept], frames[..., kept], targets[:, kept]
        jacobian = task.jacobian_of_few(few.jacobian(frames), targets)
        jacobian[rows:] *= ROTATION_LENGTH
        error[rows:] *= ROTATION_LENGTH
        now = _step(limits, now, jacobian, error, 0.5 * DAMPING * size + LEAST_DAMPING)
    return solved - robot.few.turns * np.rint(solved * (0.5 / math.pi)), valid


def _step(limits: tuple[Array, Array] | None, q: Array, jacobian: Array, error: Array, damping: Array) -> Array:
    """Configurations (n, M) after a step within limits: `free_step`, and `stop_at_limits` where one is met."""
    step = damped_least_squares_of_few(jacobian, error, damping)
    longest = np.abs(step).max(0)
    if some(longest < SHORTEST_STEP):
        # at a stationary point, such as a straight arm, any direction may lead on
        nudge = 0.05 * np.cos(np.arange(1, len(step) + 1, dtype=step.dtype))[:, None]
        step = np.where(longest < SHORTEST_STEP, nudge, step)
    moved = q + step * (LONGEST_STEP / np.maximum(longest, LONGEST_STEP))
    if limits is None:
        return moved
    kept = _clamped(moved, limits)
    beyond = kept != moved
    if some(beyond):
        stopped = beyond.any(0).nonzero()[0]
        equations = q[:, stopped], jacobian[..., stopped], error[:, stopped], damping[stopped]
        kept[:, stopped] = _stop_at_limits(limits, *equations, moved[:, stopped])
    return kept


def _clamped(q: Array, limits: tuple[Array, Array]) -> Array:
    """numpy.clip takes three times as long."""
    return np.minimum(np.maximum(q, limits[0]), limits[1])


def _stop_at_limits(
    limits: tuple[Array, Array], q: Array, jacobian: Array, error: Array, damping: Array, moved: Array
) -> Array:
    """`stop_at_limits` for arrays."""
    kept = _clamped(moved, limits)
    stopped, ends = kept != moved, kept
    going = np.ones_like(stopped[0])
    for _ in range(len(q)):
        held = np.where(stopped, ends - q, 0.0).astype(q.dtype)
        rest = error - (jacobian * held).sum(1)
        step = held + damped_least_squares_of_few(jacobian * ~stopped, rest, damping)
        moved = q + step * (LONGEST_STEP / np.maximum(np.abs(step).max(0), LONGEST_STEP))
        within = _clamped(moved, limits)
        beyond = (within != moved) & ~stopped & going
        kept, ends = np.where(going, within, kept), np.where(beyond, within, ends)
        if not beyond.any():
            break
        stopped, going = stopped | beyond, beyond.any(0)
    return kept
