"""Projection onto self-motion manifolds: a batched Levenberg–Marquardt method.

The paper's Projection(p, q_guess), with damping after Sugihara (2011), steps limited in length, and joint limits
kept as constraints of each step: a joint that would leave its range stops there, and the others make up for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from grr_torch.errors import ParameterError
from grr_torch.pieces import one_thread, piece, slices
from grr_torch.projection.columns import damped_least_squares
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import normalise
from grr_torch.spaces.task import TaskSpace

# metres that a radian of rotation error counts as
_ROTATION_LENGTH = 0.3
# longest step of a joint [rad or m]
_LONGEST_STEP = 0.5
# a step shorter than this [rad or m], with an error left, is one from a stationary point
_SHORTEST_STEP = 1e-9
# λ = _DAMPING · ½‖e‖² + _LEAST_DAMPING
_DAMPING = 0.1
_LEAST_DAMPING = 1e-7
# a configuration is given up when its error has not fallen by a tenth in so many iterations
_PATIENCE = 4
# columns that are done leave the batch when so many are left of it
_LEFT = 0.75


@dataclass(frozen=True)
class Tolerances:
    """When a configuration counts as being at a point.

    Attributes:
        position: Largest position error [m].
        rotation: Largest rotation error [rad].
        iterations: Most iterations of the projection.
    """

    position: float = 1e-4
    rotation: float = 1e-3
    iterations: int = 60

    def __post_init__(self) -> None:
        for name in ("position", "rotation"):
            if not 0.0 < getattr(self, name) < float("inf"):
                raise ParameterError(f"{name} tolerance", getattr(self, name), "above 0")
        if not isinstance(self.iterations, int) or self.iterations < 1:
            raise ParameterError("iterations", self.iterations, "1 or more")


DEFAULT_TOLERANCES = Tolerances()


def project(
    robot: Robot,
    task: TaskSpace,
    points: Tensor,
    guesses: Tensor,
    *,
    tolerances: Tolerances = DEFAULT_TOLERANCES,
    check_collision: bool = True,
) -> tuple[Tensor, Tensor]:
    """Projects each guess to a near configuration whose tool is at the point (the paper's Projection).

    Args:
        robot: The robot.
        task: The task space.
        points: (*batch, width) points of the task space.
        guesses: (*batch, n) configurations to start from; beyond a limit, they start at it.
        tolerances: When a configuration counts as being at a point, and how long it is tried.
        check_collision: Whether a configuration in self-collision is invalid.

    Returns:
        Configurations (*batch, n), continuous joints in [−π, π], and valid (*batch,): converged, within limits and
        free of self-collision. Rows that are not valid are NaN.

    Raises:
        ParameterError: Shapes do not fit, or an input is not finite.
    """
    targets = point_columns(robot, task, points)
    q = robot.columns(guesses)
    if points.shape[:-1] != guesses.shape[:-1]:
        raise ParameterError("points and guesses", (tuple(points.shape), tuple(guesses.shape)), "equal batch shapes")
    if not bool(q.isfinite().all()):
        raise ParameterError("guesses", "NaN or infinite values", "finite values")
    solved, valid = project_columns(robot, task, targets, q, tolerances, check_collision)
    return solved.T.reshape(guesses.shape), valid.reshape(guesses.shape[:-1])


def point_columns(robot: Robot, task: TaskSpace, points: Tensor) -> Tensor:
    """Points (*batch, width) as finite columns (width, N) in the robot's dtype.

    Raises:
        ParameterError: The width is not the task's, or a value is not finite.
    """
    if not isinstance(points, Tensor) or points.is_complex():
        raise ParameterError("points", type(points).__name__, "a real torch tensor")
    if points.ndim == 0 or points.shape[-1] != task.width:
        raise ParameterError("point shape", tuple(points.shape), f"(*batch, {task.width})")
    columns = points.to(device=robot.device, dtype=robot.dtype).reshape(-1, points.shape[-1]).T.contiguous()
    if not bool(columns.isfinite().all()):
        raise ParameterError("points", "NaN or infinite values", "finite values")
    return columns


def project_columns(
    robot: Robot,
    task: TaskSpace,
    targets: Tensor,
    q: Tensor,
    tolerances: Tolerances = DEFAULT_TOLERANCES,
    check_collision: bool = True,
) -> tuple[Tensor, Tensor]:
    """`project` for columns: targets (width, N) and guesses (n, N) give configurations (n, N) and valid (N,)."""
    with torch.no_grad(), one_thread():
        solved, valid = _converge(robot, task, targets, q, tolerances)
        solved = normalise(solved, robot.continuous[:, None])
        if check_collision and robot.spheres is not None:
            converged = valid.nonzero()[:, 0]
            hit = robot.columns_in_self_collision(_take(solved, converged))
            valid[converged[hit]] = False
        return torch.where(valid, solved, torch.nan), valid


class _Batch(NamedTuple):
    """Columns that have not converged.

    Attributes:
        rank: (M,) where their results belong.
        targets: (width, M).
        q: (n, M).
        best: (M,) least squared error so far.
    """

    rank: Tensor
    targets: Tensor
    q: Tensor
    best: Tensor

    def take(self, columns: Tensor | slice) -> _Batch:
        return _Batch(*(tensor[..., columns] for tensor in self))


def _converge(
    robot: Robot, task: TaskSpace, targets: Tensor, q: Tensor, tolerances: Tolerances
) -> tuple[Tensor, Tensor]:
    """Configurations (n, N), NaN where not converged, and converged (N,).

    After every few iterations, what the pieces of a long batch have left is put together.
    """
    limits = _limits(robot)
    count = q.shape[1]
    solved = torch.full_like(q, torch.nan)
    valid = torch.zeros(count, dtype=torch.bool, device=q.device)
    rank = torch.arange(count, device=q.device)
    batch = _Batch(rank, targets, q if limits is None else q.clamp(*limits), torch.full_like(q[0], torch.inf))
    workspace = robot.tree.workspace(q, min(count, piece(q.device)))
    left = tolerances.iterations + 1
    while left > 0 and len(batch.rank):
        rounds = min(_PATIENCE, left)
        left -= rounds
        parts = [
            _iterate(robot, task, batch.take(part), tolerances, rounds, left == 0, limits, workspace, solved, valid)
            for part in slices(len(batch.rank), q.device)
        ]
        batch = (
            parts[0] if len(parts) == 1 else _Batch(*(torch.cat(tensors, -1) for tensors in zip(*parts, strict=True)))
        )
    return solved, valid


def _iterate(
    robot: Robot,
    task: TaskSpace,
    batch: _Batch,
    tolerances: Tolerances,
    rounds: int,
    last: bool,
    limits: tuple[Tensor, Tensor] | None,
    workspace: Tensor,
    solved: Tensor,
    valid: Tensor,
) -> _Batch:
    """Some iterations of a batch; writes what converged and gives what is left and has come nearer.

    What has converged stays in the batch, at no harm to itself, until it is a good part of it: to copy the rest each
    time costs more.
    """
    rank, targets, q, before = batch
    best = before
    waiting = torch.ones_like(rank, dtype=torch.bool)
    rows = task.dimension
    for iteration in range(rounds):
        frames = robot.tree.frames(q, workspace)
        error = task.error(targets, *robot.tree.tool_pose(frames))
        squared = error.square()
        translation, rotation = squared[:rows].sum(0), squared[rows:].sum(0)
        done = (translation <= tolerances.position**2) & (rotation <= tolerances.rotation**2)
        size = translation.add_(rotation, alpha=_ROTATION_LENGTH**2)
        best = torch.minimum(best, size)
        finished = (waiting & done).nonzero()[:, 0]
        if len(finished):
            where = rank[finished]
            solved[:, where], valid[where] = _take(q, finished), True
            waiting = waiting & ~done
            left = waiting.nonzero()[:, 0]
            if len(left) < _LEFT * len(waiting):
                rank, targets, q, error = rank[left], _take(targets, left), _take(q, left), _take(error, left)
                best, before, size, frames = best[left], before[left], size[left], frames[..., left]
                waiting = torch.ones_like(rank, dtype=torch.bool)
        if len(rank) == 0 or (last and iteration == rounds - 1):
            break
        jacobian = task.jacobian(robot.tree.jacobian(frames))
        if len(error) > rows:
            error[rows:].mul_(_ROTATION_LENGTH)
            jacobian[rows:].mul_(_ROTATION_LENGTH)
        q = _step(q, jacobian, error, size.mul(0.5 * _DAMPING).add_(_LEAST_DAMPING), limits)
    kept = (waiting & (best < 0.81 * before)).nonzero()[:, 0]
    return _Batch(rank, targets, q, best).take(kept)


def _step(q: Tensor, jacobian: Tensor, error: Tensor, damping: Tensor, limits: tuple[Tensor, Tensor] | None) -> Tensor:
    """Configurations after one step, within limits."""
    step = damped_least_squares(jacobian, error, damping)
    longest = step.abs().amax(0)
    stuck = longest < _SHORTEST_STEP
    if bool(stuck.any()):
        # at a stationary point, such as a straight arm, any direction may lead on
        step = torch.where(stuck, _nudge(q), step)
    moved = torch.addcmul(q, step, _LONGEST_STEP / longest.clamp_min(_LONGEST_STEP))
    if limits is None:
        return moved
    kept = moved.clamp(*limits)
    stopped = kept != moved
    columns = stopped.any(0).nonzero()[:, 0]
    if len(columns):
        parts = [part[..., columns] for part in (q, kept, stopped, jacobian, error, damping)]
        kept[:, columns] = _stop_at_limits(limits, *parts)
    return kept


def _stop_at_limits(
    limits: tuple[Tensor, Tensor],
    q: Tensor,
    kept: Tensor,
    stopped: Tensor,
    jacobian: Tensor,
    error: Tensor,
    damping: Tensor,
) -> Tensor:
    """Configurations after a step in which joints that would leave their range stop at its end, at `kept`.

    The others make up for it: their step is solved for again, until no more of them would leave.
    """
    for _ in range(len(q)):
        held = torch.where(stopped, kept - q, 0.0)
        rest = error - (jacobian * held).sum(1)
        step = held + damped_least_squares(jacobian * ~stopped, rest, damping)
        moved = torch.addcmul(q, step, _LONGEST_STEP / step.abs().amax(0).clamp_min(_LONGEST_STEP))
        kept = moved.clamp(*limits)
        beyond = (kept != moved) & ~stopped
        if not bool(beyond.any()):
            break
        stopped = stopped | beyond
    return kept


def _limits(robot: Robot) -> tuple[Tensor, Tensor] | None:
    """Limits (n, 1) as columns; None where no joint has any."""
    if bool(robot.lower.isinf().all() & robot.upper.isinf().all()):
        return None
    return robot.lower[:, None], robot.upper[:, None]


def _nudge(q: Tensor) -> Tensor:
    """A small step (n, 1) that moves every joint differently."""
    return 0.05 * torch.cos(torch.arange(1, len(q) + 1, dtype=q.dtype, device=q.device))[:, None]


def _take(columns: Tensor, kept: Tensor) -> Tensor:
    return columns.index_select(1, kept)
