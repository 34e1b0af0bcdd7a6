"""Relaxed IK: a weighted sum of goals, minimised at each step from the last configuration."""

from __future__ import annotations

import torch
from torch import Tensor

from grr_torch.baselines.reactive_ik import ReactiveIk
from grr_torch.baselines.relaxed_objective import Past, RelaxedObjective, Weights
from grr_torch.projection.columns import solve_spd
from grr_torch.robots.robot import Robot
from grr_torch.spaces.task import TaskSpace

# most evaluations of the objective in a step
_EVALUATIONS = 8
# a step of the solver as short as this ends it [rad or m]
_SHORTEST_STEP = 1e-4
# damping as a share of the curvature: at first, and by what it falls after a success and rises after a failure
_DAMPING, _FALL, _RISE = 1e-4, 0.2, 8.0

DEFAULT_WEIGHTS = Weights()


class RelaxedIk(ReactiveIk):
    """Follows targets by Relaxed IK (Rakita, Mutlu and Gleicher, Robotics: Science and Systems 2018).

    At each step a weighted sum of groove losses is minimised from the last configuration: of the tool's position and
    orientation error, joint velocity, acceleration and jerk (differences of the last four configurations), nearness
    to self-collision and to joint limits, and manipulability. Joint limits and the most that a joint moves in a step
    are constraints. Loss, spread and steepness are as published. Differently from there, self-collision is measured
    between the robot's spheres instead of learned, manipulability is a goal, as in the authors' later release, instead
    of a constraint, and gradients are analytic and the sum is minimised by a Levenberg–Marquardt method with bounds.

    The weights are those of least deviation, as in the paper's comparison, chosen among 17 settings: position 60 to
    15,000, orientation 1/33 to 2 of that, self-collision 1/100 to 1/20, manipulability 0.1 to 30, and the authors'
    5 : 4 : 6 of velocity, acceleration and jerk or less. Each followed 40 random lines and 40 lines across the base,
    most of them 40 partially reachable circles too, with the Kinova arm at 0.04 rad a step. The defaults left 0.6, 51
    and 11 mm and completed 100, 75 and 100 %; the authors' own, 60 : 30 : 5 : 4 : 6 : 3, left 3.6 and 96 mm on the
    lines and completed 48 % of those across the base. With a larger share of the orientation fewer were completed; a
    smaller one left 4 mm less on those and tilted the tool 1.7 times as much.
    """

    def __init__(
        self, robot: Robot, task: TaskSpace, *, max_step: float | Tensor, weights: Weights = DEFAULT_WEIGHTS
    ) -> None:
        """Makes arms that stand nowhere yet: `reset` comes first.

        Args:
            robot: The robot.
            task: The task space of the targets.
            max_step: The most that a joint moves in a step [rad or m]; a number, or one for each joint (n,).
            weights: What the goals count.

        Raises:
            ParameterError: `max_step` is not positive and finite, or has the wrong shape.
        """
        super().__init__(robot, task, max_step=max_step)
        self._objective = RelaxedObjective(robot, task, weights)

    def _start(self, q: Tensor) -> None:
        self._past = Past(q, q, q)

    def _advance(self, targets: Tensor) -> Tensor:
        last = self._past.last
        least, most = last - self._max_step, last + self._max_step
        lower, upper = (limit[:, None].clamp(least, most) for limit in (self.robot.lower, self.robot.upper))
        q = self._minimise(last.clamp(lower, upper), targets, lower, upper)
        self._past = self._past.then(q)
        return q

    def _minimise(self, q: Tensor, targets: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
        """Configurations (n, N) within bounds (n, N) that lessen the objective, by a Levenberg–Marquardt method.

        Never worse than where it starts; a local minimum if so many evaluations are enough.
        """
        value, gradient, curvature = self._objective(q, targets, self._past)
        damping = torch.full_like(value, _DAMPING)
        moving = torch.ones_like(value, dtype=torch.bool)
        for _ in range(_EVALUATIONS - 1):
            candidate = q + _bounded_step(gradient, curvature, damping, lower - q, upper - q)
            candidate = candidate.clamp(lower, upper)
            new_value, new_gradient, new_curvature = self._objective(candidate, targets, self._past)
            better = moving & (new_value < value)
            moving &= (candidate - q).abs().amax(0) > _SHORTEST_STEP
            damping = damping * torch.where(better, _FALL, _RISE)
            q, value = torch.where(better, candidate, q), torch.where(better, new_value, value)
            gradient = torch.where(better, new_gradient, gradient)
            curvature = torch.where(better, new_curvature, curvature)
            if not bool(moving.any()):
                break
        return q


def _bounded_step(gradient: Tensor, curvature: Tensor, damping: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Steps (n, N) down a quadratic model, in which a joint that would leave its bounds stops there."""
    n = len(gradient)
    damped = curvature.clone()
    diagonal = damped.diagonal(dim1=0, dim2=1)
    diagonal += (damping * (diagonal.mean(1) + 1e-9))[:, None]
    held = ((lower >= 0.0) & (gradient > 0.0)) | ((upper <= 0.0) & (gradient < 0.0))
    step = torch.zeros_like(gradient)
    for _ in range(n):
        kept = torch.where(held, step, 0.0)
        right = -gradient - (damped * kept).sum(1)
        free = ~held
        matrix = damped * (free[:, None] & free)
        matrix.diagonal(dim1=0, dim2=1).add_(held.T.to(matrix))
        solved = solve_spd(matrix, torch.where(held, kept, right)[:, None])[:, 0]
        step = torch.maximum(torch.minimum(solved, upper), lower)
        beyond = (step != solved) & free
        if not bool(beyond.any()):
            break
        held = held | beyond
    return step
