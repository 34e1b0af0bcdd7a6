"""The configuration on a self-motion manifold that is nearest to a given one, and its derivative.

min ½‖q − a‖² where the tool is at p has the conditions of first order

    q − a + J(q)ᵀ λ = 0,    x(q) − p = 0,

differences of continuous joints wrapped. Newton's method solves them, and the implicit function theorem gives what q
does when a and p move: both need the same matrix, with 1 + ∂(Jᵀλ)/∂q at its corner. A joint at whose limit the nearest
configuration lies is held there: its equation is q_j = limit.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from grr_torch.errors import ParameterError
from grr_torch.projection.columns import transposed_product
from grr_torch.robots.curvature import force_derivative
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import difference
from grr_torch.spaces.task import TaskSpace

# largest residual of the conditions [rad, m]: aimed at, and accepted
_AIM = 1e-12
_ACCEPTED = 1e-10
_ITERATIONS = 20
# longest step of a joint [rad or m]
_LONGEST_STEP = 0.3
# a joint that pushes away from its limit by less [rad or m] may stay there
_PUSH = 1e-9


class Nearest(NamedTuple):
    """Solutions of the conditions.

    Attributes:
        q: (n, N) configurations, continuous joints anywhere.
        multipliers: (m, N) λ.
        held: (n, N) joints that are held at a limit.
        valid: (N,) conditions met within 1e-10, of a minimum (second order), within limits.
    """

    q: Tensor
    multipliers: Tensor
    held: Tensor
    valid: Tensor

    def take(self, which: Tensor) -> Nearest:
        """Some of them."""
        return Nearest(*(tensor[..., which] for tensor in self))


class _System(NamedTuple):
    """The conditions at some configurations.

    Attributes:
        residual: (N, n + m).
        matrix: (N, n + m, n + m) its derivative.
        pull: (n, N) q − a + Jᵀλ, of held joints too.
    """

    residual: Tensor
    matrix: Tensor
    pull: Tensor


@dataclass(frozen=True, eq=False)
class Manifolds:
    """The self-motion manifolds of a robot's task.

    Attributes:
        robot: The robot.
        task: The task space.
    """

    robot: Robot
    task: TaskSpace

    def nearest(self, averages: Tensor, targets: Tensor, start: Tensor) -> Nearest:
        """The nearest configurations, local minima found from others that are near.

        Args:
            averages: (n, N) a.
            targets: (width, N) p.
            start: (n, N) configurations near the manifolds.
        """
        robot = self.robot
        lower, upper = robot.lower[:, None], robot.upper[:, None]
        held = torch.zeros_like(start, dtype=torch.bool)
        q, multipliers = self._converge(averages, targets, start, held)
        for _ in range(robot.n):
            beyond = (q < lower) | (q > upper)
            redo = beyond.any(0).nonzero()[:, 0]
            if len(redo) == 0:
                break
            held[:, redo] |= beyond[:, redo]
            q[:, redo], multipliers[:, redo] = self._converge(
                averages[:, redo], targets[:, redo], q[:, redo].clamp(lower, upper), held[:, redo]
            )
        system = self._system(q, multipliers, averages, targets, held)
        valid = (system.residual.abs() <= _ACCEPTED).all(1) & ~((q < lower) | (q > upper)).any(0)
        outward = torch.where(q >= upper, -system.pull, system.pull)
        valid &= (~held | (outward >= -_PUSH)).all(0)
        check = valid.nonzero()[:, 0]
        valid[check] = _is_minimum(system.matrix[check], held[:, check])
        return Nearest(q, multipliers, held, valid)

    def moved(self, nearest: Nearest, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """What a gradient (n, N) on q is on a (n, N), and on the m coordinates of p that the task holds (m, N)."""
        q, multipliers, held, _ = nearest
        matrix = self._matrix(self.robot.tree.frames(q), multipliers, held)[0]
        right = torch.cat([gradient, torch.zeros_like(multipliers)]).T
        solved = torch.linalg.solve(matrix.mT, right).T
        return solved[: self.robot.n].masked_fill(held, 0.0), solved[self.robot.n :]

    def _converge(self, averages: Tensor, targets: Tensor, start: Tensor, held: Tensor) -> tuple[Tensor, Tensor]:
        """Newton's method: configurations (n, N) and multipliers (m, N), converged or not."""
        n = self.robot.n
        unknowns = torch.cat([start, start.new_zeros(self.task.constraints, start.shape[1])])
        left = torch.arange(start.shape[1], device=start.device)
        for _ in range(_ITERATIONS):
            values = unknowns[:, left]
            system = self._system(values[:n], values[n:], averages[:, left], targets[:, left], held[:, left])
            more = (system.residual.abs().amax(1) > _AIM).nonzero()[:, 0]
            left = left[more]
            if len(left) == 0:
                break
            step = torch.linalg.solve_ex(system.matrix[more], system.residual[more])[0].T
            longest = step[:n].abs().amax(0)
            unknowns[:, left] -= step * (_LONGEST_STEP / longest.clamp_min(_LONGEST_STEP))
        return unknowns[:n], unknowns[n:]

    def _system(self, q: Tensor, multipliers: Tensor, averages: Tensor, targets: Tensor, held: Tensor) -> _System:
        frames = self.robot.tree.frames(q)
        matrix, jacobian = self._matrix(frames, multipliers, held)
        motion = difference(averages, q, self.robot.continuous[:, None])
        pull = motion + transposed_product(jacobian, multipliers)
        error = self.task.error(targets, *self.robot.tree.tool_pose(frames))
        return _System(torch.cat([pull.masked_fill(held, 0.0), -error]).T, matrix, pull)

    def _matrix(self, frames: Tensor, multipliers: Tensor, held: Tensor) -> tuple[Tensor, Tensor]:
        """The conditions' derivative (N, n + m, n + m), and J (m, n, N)."""
        n = self.robot.n
        tree = self.robot.tree
        jacobian = self.task.jacobian(tree.jacobian(frames))
        hessian = force_derivative(tree, frames, self._rows.T @ multipliers)
        hessian.diagonal(dim1=0, dim2=1).add_(1.0)
        rows = torch.cat([hessian, jacobian.transpose(0, 1)], dim=1)
        alone = torch.eye(n, n + len(jacobian), dtype=rows.dtype, device=rows.device)[..., None]
        rows = torch.where(held[:, None], alone, rows)
        last = torch.nn.functional.pad(jacobian, (0, 0, 0, len(jacobian)))
        return torch.cat([rows, last]).permute(2, 0, 1), jacobian

    @cached_property
    def _rows(self) -> Tensor:
        """(m, 6) which rows of a geometric Jacobian are the task's."""
        every = torch.eye(6, dtype=self.robot.dtype, device=self.robot.device)
        return self.task.jacobian(every[..., None])[..., 0]


class MovedBy(torch.autograd.Function):
    """Nearest configurations (n, N) as a function of averages (n, N) and targets (width, N), once differentiable."""

    @staticmethod
    def forward(ctx: Any, averages: Tensor, targets: Tensor, manifolds: Manifolds, nearest: Nearest) -> Tensor:
        """Gives the configurations as they are."""
        ctx.manifolds = manifolds
        ctx.save_for_backward(averages, targets, *nearest)
        return nearest.q.clone()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None, None]:
        """Solves the transposed conditions, one system a configuration."""
        averages, targets, *nearest = ctx.saved_tensors
        with torch.no_grad():
            on_averages, on_pose = ctx.manifolds.moved(Nearest(*nearest), gradient)
        # they depend on the inputs in a way that is not followed
        return *_Once.apply(averages, targets, on_averages, on_pose[: len(targets)]), None, None  # type: ignore[no-untyped-call]


class _Once(torch.autograd.Function):
    """Derivatives that depend on averages and targets, but cannot be differentiated by them.

    `once_differentiable` would let a second derivative pass over them in silence: it does not tell of what they depend.
    """

    @staticmethod
    def forward(ctx: Any, averages: Tensor, targets: Tensor, *derivatives: Tensor) -> tuple[Tensor, ...]:
        """Gives the derivatives."""
        return tuple(derivative.clone() for derivative in derivatives)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        """Refuses.

        Raises:
            ParameterError: Always.
        """
        raise ParameterError("order of the derivative", 2, "1: the map can be differentiated once")


def _is_minimum(matrix: Tensor, held: Tensor) -> Tensor:
    """Whether all that the task and held joints (n, N) leave open leads away from a: second order conditions, (N,)."""
    n = len(held)
    jacobian, curvature = matrix[:, :n, n:], matrix[:, :n, :n].masked_fill(held.T[:, None], 0.0)
    curvature = curvature + torch.diag_embed(held.T.to(matrix))
    open_ = torch.linalg.qr(jacobian, mode="complete")[0][:, :, jacobian.shape[2] :]
    reduced = open_.mT @ (0.5 * (curvature + curvature.mT)) @ open_
    return torch.linalg.cholesky_ex(reduced)[1] == 0
