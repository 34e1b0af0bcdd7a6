"""One damped least-squares step of many configurations, within joint limits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from grr_torch.projection.columns import damped_least_squares
from grr_torch.robots.robot import Robot

# metres that a radian of rotation error counts as
ROTATION_LENGTH = 0.3
# λ = DAMPING · ½‖e‖² + LEAST_DAMPING
DAMPING = 0.1
LEAST_DAMPING = 1e-7
# longest step of a joint [rad or m]
LONGEST_STEP = 0.5
# a step shorter than this [rad or m], with an error left, is one from a stationary point
SHORTEST_STEP = 1e-9
# a configuration is given up when its squared error has not fallen to this share of itself in so many iterations
PATIENCE = 4
FALLEN = 0.81


class Equations(NamedTuple):
    """What a step solves for some columns of a batch: the shortest one that reduces the error, J · step ≈ e.

    Attributes:
        columns: (M,) which they are.
        q: (n, M) configurations.
        jacobian: (m, n, M).
        error: (m, M).
        damping: (M,) λ > 0.
    """

    columns: Tensor
    q: Tensor
    jacobian: Tensor
    error: Tensor
    damping: Tensor

    def take(self, which: Tensor | slice) -> Equations:
        """Some of them."""
        return Equations(*(tensor[..., which] for tensor in self))

    @classmethod
    def join(cls, parts: Sequence[Equations]) -> Equations:
        """All parts side by side."""
        return parts[0] if len(parts) == 1 else cls(*(torch.cat(tensors, -1) for tensors in zip(*parts, strict=True)))


class Limits(NamedTuple):
    """Joint limits as columns.

    Attributes:
        lower: (n, 1).
        upper: (n, 1).
    """

    lower: Tensor
    upper: Tensor

    @classmethod
    def of(cls, robot: Robot) -> Limits | None:
        """Those of a robot; None where no joint has any."""
        return cls(robot.lower[:, None], robot.upper[:, None]) if robot.has_limits else None


def free_step(equations: Equations) -> Tensor:
    """Configurations (n, M) after a step that knows no limits."""
    step = damped_least_squares(equations.jacobian, equations.error, equations.damping)
    longest = step.abs().amax(0)
    stuck = longest < SHORTEST_STEP
    if bool(stuck.any()):
        # at a stationary point, such as a straight arm, any direction may lead on
        step = torch.where(stuck, nudge(step), step)
    return torch.addcmul(equations.q, step, LONGEST_STEP / longest.clamp_min(LONGEST_STEP))


def stop_at_limits(limits: Limits, equations: Equations, moved: Tensor) -> Tensor:
    """Configurations after a step in which joints that would leave their range go to its end, and no farther.

    The others make up for it: their step is solved for again, until no more of them would leave. A step that is too
    long then is shortened as a whole, as every step is.

    Args:
        limits: Of the joints.
        equations: Of the step.
        moved: (n, M) where `free_step` leads to.
    """
    _, q, jacobian, error, damping = equations
    kept = moved.clamp(*limits)
    stopped, ends = kept != moved, kept
    # what is settled stays, whatever else of the batch is not
    going = torch.ones_like(stopped[0])
    for _ in range(len(q)):
        held = torch.where(stopped, ends - q, 0.0)
        rest = error - (jacobian * held).sum(1)
        step = held + damped_least_squares(jacobian * ~stopped, rest, damping)
        moved = torch.addcmul(q, step, LONGEST_STEP / step.abs().amax(0).clamp_min(LONGEST_STEP))
        within = moved.clamp(*limits)
        beyond = (within != moved) & ~stopped & going
        kept, ends = torch.where(going, within, kept), torch.where(beyond, within, ends)
        if not bool(beyond.any()):
            break
        stopped, going = stopped | beyond, beyond.any(0)
    return kept


def nudge(step: Tensor) -> Tensor:
    """A small step (n, 1) that moves every joint differently."""
    return 0.05 * torch.cos(torch.arange(1, len(step) + 1, dtype=step.dtype, device=step.device))[:, None]
