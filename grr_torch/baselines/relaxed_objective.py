"""The objective of Relaxed IK: a weighted sum of groove losses, with its gradient and a positive definite curvature.

Rakita, Mutlu and Gleicher: RelaxedIK, Robotics: Science and Systems 2018.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor

from grr_torch.errors import ParameterError
from grr_torch.projection.columns import solve_spd, transposed_product
from grr_torch.robots.robot import Robot
from grr_torch.spaces.task import TaskSpace

# c and r as published, for all goals but manipulability
_SPREAD, _STEEPNESS = 0.2, 5.0
# and those of the authors' later release for manipulability
_MANIPULABILITY = (0.5, 0.1)
# distance [m] over which the nearness of two links falls to 1/e, and the nearness below which it has no gradient
_NEAR, _FAR = 0.01, 1e-3
# nearness to a limit is this power of the joint's distance from mid-range, as a share of half the range
_POWER = 20
# configurations among which the largest manipulability is found
_SAMPLES = 1024


def groove_loss(chi: Tensor, s: float, c: float, r: float) -> Tensor:
    """f(χ) = −exp(−(χ − s)² / 2c²) + r (χ − s)⁴: a narrow groove at the goal s with a slope towards it around.

    The published loss with n = 1: its other form, a hill instead of a groove, is not needed here.

    Args:
        chi: Values of a goal, any shape.
        s: Where the goal is met.
        c: Spread of the groove.
        r: Steepness of the slope.
    """
    squared = (chi - s).square()
    return r * squared.square() - (squared * (-0.5 / c**2)).exp()


@dataclass(frozen=True)
class Weights:
    """What the goals of Relaxed IK count. See `RelaxedIk` for how the defaults were chosen.

    Attributes:
        position: Distance of the tool from the target [m].
        orientation: Angle of the tool to the target's orientation [rad].
        velocity: Norm of the motion in a step [rad].
        acceleration: Norm of its change from the last step [rad].
        jerk: Norm of that change's change [rad].
        self_collision: Nearness of the closest two links: exp(−d / 1 cm), d what their distance is above the margin.
        limits: Nearness to joint limits: norm of (q − mid-range)²⁰, in half ranges.
        manipulability: √det(J Jᵀ) as a share of the robot's largest: the nearer to 1, the better.
    """

    position: float = 1000.0
    orientation: float = 100.0
    velocity: float = 5.0
    acceleration: float = 4.0
    jerk: float = 6.0
    self_collision: float = 50.0
    limits: float = 1.0
    manipulability: float = 1.0

    def __post_init__(self) -> None:
        for field in fields(self):
            if not 0.0 <= getattr(self, field.name) < float("inf"):
                raise ParameterError(f"weight of {field.name}", getattr(self, field.name), "0 or more, and finite")


class Past(NamedTuple):
    """The last three configurations (n, N) of each arm, the newest first."""

    last: Tensor
    second: Tensor
    third: Tensor

    def then(self, q: Tensor) -> Past:
        """The past after a step to q (n, N)."""
        return Past(q, self.last, self.second)


class _Goal(NamedTuple):
    """A goal that is met where its residual is zero.

    Attributes:
        weight: What it counts.
        residual: (m, N), of which the norm is χ − s.
        jacobian: (m, n, N) its derivative; None for the identity.
        spread: c of its groove.
        steepness: r of its groove.
    """

    weight: float
    residual: Tensor
    jacobian: Tensor | None
    spread: float = _SPREAD
    steepness: float = _STEEPNESS


class RelaxedObjective:
    """The weighted sum for many configurations at once, one a column."""

    def __init__(self, robot: Robot, task: TaskSpace, weights: Weights) -> None:
        self._robot, self._task, self._weights = robot, task, weights
        limited = robot.lower.isfinite() & robot.upper.isfinite()
        self._middle = torch.where(limited, 0.5 * (robot.lower + robot.upper), 0.0)[:, None]
        self._half_range = torch.where(limited, 0.5 * (robot.upper - robot.lower), torch.inf)[:, None]
        samples = robot.columns(robot.sample(_SAMPLES, torch.Generator().manual_seed(0)))
        jacobian = task.jacobian(robot.tree.jacobian(robot.tree.frames(samples)))
        self._most_manipulable = float(_manipulability(jacobian).max())

    def __call__(self, q: Tensor, targets: Tensor, past: Past) -> tuple[Tensor, Tensor, Tensor]:
        """Values (N,), gradients (n, N) and Gauss–Newton curvatures (n, n, N).

        A groove of the norm of a residual e(q) has the gradient k Jᵀ e, k = exp(−‖e‖² / 2c²) / c² + 4 r ‖e‖²; its
        curvature is taken as k Jᵀ J, which is never negative.

        Args:
            q: (n, N) configurations.
            targets: (width, N) points.
            past: Where the arms were.
        """
        value = torch.zeros_like(q[0])
        gradient = torch.zeros_like(q)
        curvature = q.new_zeros(len(q), *q.shape)
        for goal in self._goals(q, targets, past):
            c, r = goal.spread, goal.steepness
            squared = goal.residual.square().sum(0)
            factor = goal.weight * ((squared * (-0.5 / c**2)).exp() / c**2 + 4.0 * r * squared)
            value += goal.weight * groove_loss(squared.sqrt(), 0.0, c, r)
            if goal.jacobian is None:
                gradient.addcmul_(factor, goal.residual)
                curvature.diagonal(dim1=0, dim2=1).add_(factor[:, None])
            else:
                scaled = factor * goal.jacobian
                gradient += transposed_product(scaled, goal.residual)
                for row, scaled_row in zip(goal.jacobian, scaled, strict=True):
                    curvature.addcmul_(row[:, None], scaled_row)
        return value, gradient, curvature

    def _goals(self, q: Tensor, targets: Tensor, past: Past) -> Iterator[_Goal]:
        weights = self._weights
        frames = self._robot.tree.frames(q)
        error = self._task.error(targets, *self._robot.tree.tool_pose(frames))
        jacobian = self._task.jacobian(self._robot.tree.jacobian(frames), targets)
        rows = self._task.dimension
        yield _Goal(weights.position, error[:rows], -jacobian[:rows])
        if len(error) > rows:
            yield _Goal(weights.orientation, error[rows:], -jacobian[rows:])
        velocity, before = q - past.last, past.last - past.second
        acceleration, change = velocity - before, before - (past.second - past.third)
        yield _Goal(weights.velocity, velocity, None)
        yield _Goal(weights.acceleration, acceleration, None)
        yield _Goal(weights.jerk, acceleration - change, None)
        yield _Goal(weights.self_collision, *self._nearness(q))
        yield _Goal(weights.limits, *self._stretch(q))
        yield _Goal(weights.manipulability, *self._clumsiness(q, jacobian), *_MANIPULABILITY)

    def _nearness(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Nearness (1, N) of the closest links and its derivative (1, n, N)."""
        distance = self._robot.self_collision_distance(q.T) - self._robot.margin
        nearness = (distance / -_NEAR).exp()
        derivative = torch.zeros_like(q)
        near = (nearness > _FAR).nonzero()[:, 0]
        if len(near):
            with torch.enable_grad():
                rows = q[:, near].T.contiguous().requires_grad_()
                (slope,) = torch.autograd.grad(self._robot.self_collision_distance(rows).sum(), rows)
            derivative[:, near] = slope.T * nearness[near] / -_NEAR
        return nearness[None], derivative[None]

    def _stretch(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Nearness (n, N) of joints to their limits and its derivative (n, n, N)."""
        # beyond a limit the bounds of a step lead back: no need of a power that overflows
        share = ((q - self._middle) / self._half_range).clamp(-1.5, 1.5)
        slope = _POWER * share ** (_POWER - 1) / self._half_range
        return share**_POWER, torch.diag_embed(slope.T).permute(1, 2, 0)

    def _clumsiness(self, q: Tensor, jacobian: Tensor) -> tuple[Tensor, Tensor]:
        """What is missing (1, N) to the largest manipulability, as a share of it, and its derivative (1, n, N)."""
        share = _manipulability(jacobian) / self._most_manipulable
        wide = jacobian if len(jacobian) <= len(q) else jacobian.transpose(0, 1)
        normal = torch.einsum("ikN,jkN->ijN", wide, wide)
        # ∂√det(J Jᵀ) = √det(J Jᵀ) ⟨(J Jᵀ)⁻¹ J, ∂J⟩; the damping keeps it finite at a singularity, where it is zero
        normal.diagonal(dim1=0, dim2=1).add_(1e-12)
        inverse = solve_spd(normal, wide)
        inverse = inverse if wide is jacobian else inverse.transpose(0, 1)
        with torch.enable_grad():
            leaf = q.detach().requires_grad_()
            moving = self._task.jacobian(self._robot.tree.jacobian(self._robot.tree.frames(leaf)))
            (derivative,) = torch.autograd.grad((moving * inverse).sum(), leaf)
        return 1.0 - share[None], -share * derivative[None]


def _manipulability(jacobian: Tensor) -> Tensor:
    """√det(J Jᵀ) (N,) of Jacobians (m, n, N), of Jᵀ J where there are more rows than joints (Yoshikawa 1985)."""
    matrices = jacobian.permute(2, 0, 1)
    matrices = matrices if matrices.shape[1] <= matrices.shape[2] else matrices.mT
    return torch.linalg.det(matrices @ matrices.mT).clamp_min(0.0).sqrt()
