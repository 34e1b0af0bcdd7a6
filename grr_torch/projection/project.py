"""Projection onto self-motion manifolds: a batched Levenberg–Marquardt method.

The paper's Projection(p, q_guess), with damping after Sugihara (2011), steps limited in length, and joint limits
kept as constraints of each step: a joint that would leave its range stops there, and the others make up for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from grr_torch.errors import ParameterError
from grr_torch.projection.columns import damped_least_squares
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import normalise
from grr_torch.spaces.task import TaskSpace

# metres that a radian of rotation error counts as
_ROTATION_LENGTH = 0.3
# longest step of a joint [rad or m]
_LONGEST_STEP = 0.5
# λ = _DAMPING · ½‖e‖² + _LEAST_DAMPING
_DAMPING = 0.1
_LEAST_DAMPING = 1e-7
# a configuration is given up when its error has not fallen by a tenth in so many iterations
_PATIENCE = 8
# configurations that are iterated together: their Jacobians should stay in the cache
_COLUMNS_AT_ONCE = 4096


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
    with torch.no_grad():
        parts = [
            _project(robot, task, target, guess, tolerances)
            for target, guess in zip(
                targets.split(_COLUMNS_AT_ONCE, dim=1), q.split(_COLUMNS_AT_ONCE, dim=1), strict=True
            )
        ]
        solved = normalise(torch.cat([part[0] for part in parts], dim=1), robot.continuous[:, None])
        valid = torch.cat([part[1] for part in parts])
        if check_collision and robot.spheres is not None:
            converged = valid.nonzero()[:, 0]
            valid[converged] = ~robot.columns_in_self_collision(solved[:, converged])
        return torch.where(valid, solved, torch.nan), valid


def _project(
    robot: Robot, task: TaskSpace, targets: Tensor, q: Tensor, tolerances: Tolerances
) -> tuple[Tensor, Tensor]:
    lower, upper = robot.lower[:, None], robot.upper[:, None]
    limited = bool(robot.lower.isfinite().any() | robot.upper.isfinite().any())
    q = q.clamp(lower, upper) if limited else q
    solved = torch.full_like(q, torch.nan)
    valid = torch.zeros(q.shape[1], dtype=torch.bool, device=q.device)
    active = torch.arange(q.shape[1], device=q.device)
    best = torch.full_like(q[0], torch.inf)
    waited = torch.zeros_like(active)
    weights = torch.ones(task.constraints, 1, dtype=q.dtype, device=q.device)
    weights[task.dimension :] = _ROTATION_LENGTH
    for iteration in range(tolerances.iterations + 1):
        frames = robot.tree.frames(q)
        position, rotation = robot.tree.tool_pose(frames)
        error = task.error(targets, position, rotation)
        translation_left, rotation_left = task.residuals(error)
        done = (translation_left <= tolerances.position) & (rotation_left <= tolerances.rotation)
        error = error * weights
        size = error.square().sum(0)
        improved = size < 0.81 * best
        waited = torch.where(improved, 0, waited + 1)
        best = torch.where(improved, size, best)
        keep = ~(done | (waited > _PATIENCE))
        if iteration == tolerances.iterations or not bool(keep.all()):
            finished = active[done]
            solved[:, finished] = q[:, done]
            valid[finished] = True
            kept = keep.nonzero()[:, 0]
            if iteration == tolerances.iterations or len(kept) == 0:
                break
            active, targets, q, error = active[kept], _take(targets, kept), _take(q, kept), _take(error, kept)
            best, waited, size, position = best[kept], waited[kept], size[kept], _take(position, kept)
            frames = [type(frame)(frame.xy[..., kept], frame.zp[..., kept]) for frame in frames]
        jacobian = task.jacobian(robot.tree.jacobian(frames, position)) * weights[:, None]
        damping = _DAMPING * 0.5 * size + _LEAST_DAMPING
        step = damped_least_squares(jacobian, error, damping)
        stuck = (jacobian * error[:, None]).sum(0).abs().amax(0) < 1e-9 * size.sqrt()
        if bool(stuck.any()):
            # at a stationary point, such as a straight arm, any direction may lead on
            step = torch.where(stuck, _nudge(q), step)
        step = step * (_LONGEST_STEP / step.abs().amax(0).clamp_min(_LONGEST_STEP))
        if limited:
            step = _keep_limits(step, q, jacobian, error, damping, lower, upper)
        q = q + step
        if limited:
            q = q.clamp(lower, upper)  # rounding only: the step keeps the limits
    return solved, valid


def _keep_limits(
    step: Tensor, q: Tensor, jacobian: Tensor, error: Tensor, damping: Tensor, lower: Tensor, upper: Tensor
) -> Tensor:
    """Steps that stay within limits: joints that would leave stop there, the others are solved for again."""
    beyond = (q + step < lower) | (q + step > upper)
    columns = beyond.any(0).nonzero()[:, 0]
    if len(columns) == 0:
        return step
    part, stopped = step[:, columns], beyond[:, columns]
    q, jacobian, error, damping = q[:, columns], jacobian[:, :, columns], error[:, columns], damping[columns]
    for _ in range(len(part)):
        held = torch.where(stopped, (q + part).clamp(lower, upper) - q, 0.0)
        rest = error - (jacobian * held).sum(1)
        part = held + damped_least_squares(jacobian * ~stopped, rest, damping)
        part = part * (_LONGEST_STEP / part.abs().amax(0).clamp_min(_LONGEST_STEP))
        beyond = ((q + part < lower) | (q + part > upper)) & ~stopped
        if not bool(beyond.any()):
            break
        stopped = stopped | beyond
    step = step.clone()
    step[:, columns] = (q + part).clamp(lower, upper) - q
    return step


def _nudge(q: Tensor) -> Tensor:
    """A small step (n, 1) that moves every joint differently."""
    return 0.05 * torch.cos(torch.arange(1, len(q) + 1, dtype=q.dtype, device=q.device))[:, None]


def _take(columns: Tensor, kept: Tensor) -> Tensor:
    return columns.index_select(1, kept)
