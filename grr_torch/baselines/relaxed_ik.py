"""Relaxed IK: a weighted sum of goals, minimised at each step from the last configuration."""

from __future__ import annotations

import torch
from torch import Tensor

from grr_torch.baselines.follower import Follower
from grr_torch.baselines.relaxed_objective import Past, RelaxedObjective, Weights
from grr_torch.projection.columns import solve_spd
from grr_torch.robots.robot import Robot
from grr_torch.spaces.task import TaskSpace

# most evaluations of the objective in a step
_EVALUATIONS = 16
# a step of the solver as short as this ends it [rad or m]
_SHORTEST_STEP = 1e-5
# damping as a share of the curvature: at first, and by what it falls after a success and rises after a failure
_DAMPING, _FALL, _RISE = 1e-4, 0.2, 8.0

DEFAULT_WEIGHTS = Weights()


class RelaxedIk(Follower):
    """x."""

    def __init__(
        self, robot: Robot, task: TaskSpace, *, max_step: float | Tensor, weights: Weights = DEFAULT_WEIGHTS
    ) -> None:
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
        """A local minimum (n, N) of the objective within bounds (n, N), by a Levenberg–Marquardt method."""
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
