"""Projection onto self-motion manifolds: a batched Levenberg–Marquardt method.

The paper's Projection(p, q_guess), with damping after Sugihara (2011), steps limited in length, and joint limits
kept as constraints of each step: a joint that would leave its range stops there, and the others make up for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from grr_torch.errors import ParameterError, check_whole
from grr_torch.pieces import are_few, one_thread, piece, slices
from grr_torch.projection.few import project_few
from grr_torch.projection.step import (
    DAMPING,
    FALLEN,
    LEAST_DAMPING,
    PATIENCE,
    ROTATION_LENGTH,
    Equations,
    Limits,
    free_step,
    stop_at_limits,
)
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import normalise
from grr_torch.spaces.task import TaskSpace

# columns that are done leave a batch, or its piece, when less than so many are left of it
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
            object.__setattr__(self, name, float(getattr(self, name)))
        object.__setattr__(self, "iterations", check_whole("iterations", self.iterations, 1))


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
        ParameterError: The width is not the task's, a value is not finite, or a direction or quaternion is zero.
    """
    if not isinstance(points, Tensor) or points.is_complex():
        raise ParameterError("points", type(points).__name__, "a real torch tensor")
    if points.ndim == 0 or points.shape[-1] != task.width:
        raise ParameterError("point shape", tuple(points.shape), f"(*batch, {task.width})")
    columns = points.to(device=robot.device, dtype=robot.dtype).reshape(-1, points.shape[-1]).T.contiguous()
    if not bool(columns.isfinite().all()):
        raise ParameterError("points", "NaN or infinite values", "finite values")
    return task.unit(columns.T).T.contiguous()


def tool_points(robot: Robot, task: TaskSpace, q: Tensor) -> Tensor:
    """The points (N, width) of the task space that the tools of configurations (N, n) are at, or nearest to."""
    position, rotation = robot.forward_kinematics(q)
    return task.at(position.T, rotation.permute(1, 2, 0)).T


def project_columns(
    robot: Robot,
    task: TaskSpace,
    targets: Tensor,
    q: Tensor,
    tolerances: Tolerances = DEFAULT_TOLERANCES,
    check_collision: bool = True,
) -> tuple[Tensor, Tensor]:
    """`project` for columns: targets (width, N) and guesses (n, N) give configurations (n, N) and valid (N,)."""
    if q.shape[1] == 0:
        return q.clone(), torch.zeros(0, dtype=torch.bool, device=q.device)
    with torch.no_grad(), one_thread():
        if are_few(q):
            found = project_few(robot, task, tolerances, targets.numpy(), q.numpy())
            solved, valid = (torch.from_numpy(part) for part in found)
        else:
            workspace = robot.tree.workspace(q, min(q.shape[1], piece(q.device)))
            solved, valid = _Projection(robot, task, tolerances, Limits.of(robot), workspace).converge(targets, q)
            solved = normalise(solved, robot.continuous[:, None])
        if check_collision and robot.spheres is not None:
            converged = valid.nonzero()[:, 0]
            hit = robot.columns_in_self_collision(solved.index_select(1, converged))
            valid[converged[hit]] = False
        return torch.where(valid, solved, torch.nan), valid


class _Batch(NamedTuple):
    """Columns that are not known to have converged.

    Attributes:
        rank: (M,) where their results belong.
        targets: (width, M).
        q: (n, M), changed in place.
        best: (M,) least squared error so far, changed in place.
        before: (M,) what that was when patience was last asked for.
    """

    rank: Tensor
    targets: Tensor
    q: Tensor
    best: Tensor
    before: Tensor

    def take(self, columns: Tensor) -> _Batch:
        return _Batch(*(tensor.index_select(-1, columns) for tensor in self))


@dataclass(frozen=True)
class _Projection:
    """What stays the same from the first iteration to the last.

    An iteration goes through the batch piece by piece; it evaluates a piece and steps it while it is in the cache.
    What is too narrow for that is put together over all pieces first: the columns left of a piece that has mostly
    converged, and those of which a joint would leave its range.
    """

    robot: Robot
    task: TaskSpace
    tolerances: Tolerances
    limits: Limits | None
    workspace: Tensor

    def converge(self, targets: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
        """Configurations (n, N), NaN where not converged, and converged (N,)."""
        count = q.shape[1]
        solved, valid = torch.full_like(q, torch.nan), torch.zeros(count, dtype=torch.bool, device=q.device)
        start = q.clone() if self.limits is None else q.clamp(*self.limits)
        far = torch.full_like(q[0], torch.inf)
        batch = _Batch(torch.arange(count, device=q.device), targets, start, far, far.clone())
        for iteration in range(self.tolerances.iterations + 1):
            last = iteration == self.tolerances.iterations
            done = self._iterate(batch, last)
            patience = (iteration + 1) % PATIENCE == 0
            kept = ~done & (batch.best < FALLEN * batch.before) if patience else ~done
            left = kept.nonzero()[:, 0]
            if len(left) >= _LEFT * len(done) and not patience and not last:
                continue
            there = done.nonzero()[:, 0]
            where = batch.rank[there]
            solved[:, where], valid[where] = batch.q.index_select(1, there), True
            if len(left) == 0:
                break
            batch = batch.take(left)
            if patience:
                batch.before.copy_(batch.best)
        return solved, valid

    def _iterate(self, batch: _Batch, last: bool) -> Tensor:
        """Evaluates a batch and steps what has not converged, unless it is the last time; (M,) has converged."""
        every = torch.arange(len(batch.rank), device=batch.rank.device)
        done = torch.empty_like(every, dtype=torch.bool)
        few: list[Equations] = []
        beyond: list[tuple[Equations, Tensor]] = []
        for part in slices(len(every), every.device):
            frames, error, size = self._evaluate(batch, part, done)
            left = (~done[part]).nonzero()[:, 0]
            if last or len(left) == 0:
                continue
            ahead: tuple[Tensor, ...] = (every[part], batch.q[:, part], frames, error, size, batch.targets[:, part])
            if len(left) < _LEFT * len(size):
                few.append(self._equations(*(tensor.index_select(-1, left) for tensor in ahead)))
            else:
                there = done[part] if len(left) < len(size) else None
                batch.q[:, part] = self._step(self._equations(*ahead), beyond, there)
        if few:
            together = Equations.join(few)
            for part in slices(len(together.columns), every.device):
                equations = together.take(part)
                batch.q.index_copy_(1, equations.columns, self._step(equations, beyond))
        if self.limits is not None and beyond:
            together, moved = Equations.join([e for e, _ in beyond]), torch.cat([m for _, m in beyond], -1)
            batch.q.index_copy_(1, together.columns, stop_at_limits(self.limits, together, moved))
        return done

    def _evaluate(self, batch: _Batch, part: slice, done: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Frames, errors and their squared size (M,) of a piece; notes which of it has converged."""
        rows = self.task.dimension
        frames = self.robot.tree.frames(batch.q[:, part], self.workspace)
        error = self.task.error(batch.targets[:, part], *self.robot.tree.tool_pose(frames))
        squared = error.square()
        translation, rotation = squared[:rows].sum(0), squared[rows:].sum(0)
        near = translation <= self.tolerances.position**2
        torch.logical_and(near, rotation <= self.tolerances.rotation**2, out=done[part])
        size = translation.add_(rotation, alpha=ROTATION_LENGTH**2)
        torch.minimum(batch.best[part], size, out=batch.best[part])
        return frames, error, size

    def _equations(
        self, columns: Tensor, q: Tensor, frames: Tensor, error: Tensor, size: Tensor, targets: Tensor
    ) -> Equations:
        """Of a step, a radian counted as `ROTATION_LENGTH` metres."""
        rows = self.task.dimension
        jacobian = self.task.jacobian(self.robot.tree.jacobian(frames), targets)
        if len(error) > rows:
            error[rows:].mul_(ROTATION_LENGTH)
            jacobian[rows:].mul_(ROTATION_LENGTH)
        return Equations(columns, q, jacobian, error, size.mul(0.5 * DAMPING).add_(LEAST_DAMPING))

    def _step(self, equations: Equations, beyond: list[tuple[Equations, Tensor]], done: Tensor | None = None) -> Tensor:
        """Configurations (n, M) after a step, clamped; those that are done stay.

        Appends to `beyond` those of which a joint was stopped at a limit, and where they would have gone.
        """
        moved = free_step(equations)
        kept = moved if self.limits is None else moved.clamp(*self.limits)
        if self.limits is not None:
            # of bytes, the largest is found faster than whether any is true
            stopped = (kept != moved).view(torch.uint8).amax(0)
            which = (stopped if done is None else stopped * ~done).nonzero()[:, 0]
            if len(which):
                beyond.append((equations.take(which), moved.index_select(1, which)))
        return kept if done is None else torch.where(done, equations.q, kept)
