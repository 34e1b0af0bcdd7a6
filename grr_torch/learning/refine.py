"""A fixed number of Newton steps from guesses that are already near: what makes a network's answer exact."""

from __future__ import annotations

import torch
from torch import Tensor

from grr_torch.errors import ParameterError, check_whole
from grr_torch.pieces import in_pieces
from grr_torch.projection.columns import damped_least_squares
from grr_torch.projection.project import Tolerances, point_columns
from grr_torch.projection.step import Equations, Limits, stop_at_limits
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import normalise
from grr_torch.spaces.task import TaskSpace

# little enough that two steps from millimetres away end within micrometres
_DAMPING = 1e-8
# longest step of a joint [rad or m]
_LONGEST_STEP = 0.5


def newton_steps(
    robot: Robot, task: TaskSpace, points: Tensor, guesses: Tensor, steps: int, tolerances: Tolerances
) -> tuple[Tensor, Tensor]:
    """Takes a fixed number of damped Newton steps, each within joint limits.

    Args:
        robot: The robot.
        task: The task space.
        points: (*batch, d) points [m].
        guesses: (*batch, n) configurations.
        steps: How many.
        tolerances: When a configuration counts as being at a point.

    Returns:
        Configurations (*batch, n), and valid (*batch,): at the point, within limits, and free of self-collision.

    Raises:
        ParameterError: Shapes do not fit, a value is not finite, or `steps` is negative.
    """
    steps = check_whole("steps", steps, 0)
    targets, q = point_columns(robot, task, points), robot.columns(guesses)
    if points.shape[:-1] != guesses.shape[:-1]:
        raise ParameterError("points and guesses", (tuple(points.shape), tuple(guesses.shape)), "equal batch shapes")
    if not bool(q.isfinite().all()):
        raise ParameterError("guesses", "NaN or infinite values", "finite values")
    limits = Limits.of(robot)

    def walk(target: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
        if limits is not None:
            q = q.clamp(*limits)
        for _ in range(steps):
            q = _step(robot, task, limits, target, q)
        position, rotation = task.residuals(_error(robot, task, target, q)[1])
        q = normalise(q, robot.continuous[:, None])
        there = (position <= tolerances.position) & (rotation <= tolerances.rotation)
        return q, there & ~robot.columns_in_self_collision(q)

    with torch.no_grad():
        q, valid = in_pieces(walk, targets, q)
    return q.T.reshape(guesses.shape), valid.reshape(guesses.shape[:-1])


def _error(robot: Robot, task: TaskSpace, targets: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
    """Frames and errors (m, N) of columns."""
    frames = robot.tree.frames(q)
    return frames, task.error(targets, *robot.tree.tool_pose(frames))


def _step(robot: Robot, task: TaskSpace, limits: Limits | None, targets: Tensor, q: Tensor) -> Tensor:
    frames, error = _error(robot, task, targets, q)
    jacobian = task.jacobian(robot.tree.jacobian(frames))
    columns = torch.arange(q.shape[1], device=q.device)
    equations = Equations(columns, q, jacobian, error, torch.full_like(q[0], _DAMPING))
    step = damped_least_squares(jacobian, error, equations.damping)
    moved = torch.addcmul(q, step, _LONGEST_STEP / step.abs().amax(0).clamp_min(_LONGEST_STEP))
    if limits is None:
        return moved
    kept = moved.clamp(*limits)
    beyond = (kept != moved).any(0).nonzero()[:, 0]
    if len(beyond):
        kept[:, beyond] = stop_at_limits(limits, equations.take(beyond), moved[:, beyond])
    return kept
