"""Secondary objectives: what the redundancy that a roadmap leaves can be spent on, besides smoothness.

Each is a value that is to be large. What is minimised is

    S / S₀ + Σ w · mean over vertices of Σ exp(3 (1 − x / x̄)) / 3,

with S the mean slope, S₀ that of the map which was refined for smoothness alone, x the values of a vertex (the limits
have one for each limited joint) and x̄ the mean over that map of each vertex's smallest. So at weight 1, to raise values
near their mean by 1 % of it is worth 1 % of smoothness; a vertex near collision, a singularity or a limit counts up to
20 times as much.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from grr_torch.errors import ParameterError, UnknownNameError
from grr_torch.pieces import in_pieces
from grr_torch.robots.robot import Robot
from grr_torch.spaces.task import TaskSpace

# name: what the value is
OBJECTIVES = {
    "clearance": "distance of the closest two links [m]",
    "manipulability": "Yoshikawa's √det(J Jᵀ) of the task's rows of the Jacobian",
    "limits": "distance of the joint nearest to a limit from it, as a share of half its range",
}
# how fast the penalty of a low value grows
_SHARPNESS = 3.0
# of J Jᵀ, so that its logarithm is finite where the arm is straight
_LEAST_PIVOT = 1e-12


def check_objectives(robot: Robot, objectives: Mapping[str, float] | None) -> dict[str, float]:
    """Weights by name.

    Raises:
        UnknownNameError: No such objective.
        ParameterError: A weight is negative or not finite, or the robot has no such value.
    """
    weights: dict[str, float] = {}
    for name, weight in (objectives or {}).items():
        if name not in OBJECTIVES:
            raise UnknownNameError("objective", name, tuple(OBJECTIVES))
        number = not isinstance(weight, bool) and isinstance(weight, int | float)
        if not number or not 0.0 <= weight < math.inf:
            raise ParameterError(f"weight of {name}", weight, "0 or more; at 0 the objective is only reported")
        if name == "clearance" and robot.sphere_kernel is None:
            raise ParameterError("objective", name, f"a robot with a sphere model; {robot.name} has no pair of links")
        if name == "limits" and not bool(_limited(robot).any()):
            raise ParameterError("objective", name, f"a robot with joint limits; {robot.name} has none")
        weights[name] = float(weight)
    return weights


@dataclass(frozen=True)
class Objective:
    """One objective of a relaxation.

    Attributes:
        robot: The robot.
        task: The task space.
        name: Of `OBJECTIVES`.
        weight: w · S₀ · edges / vertices [rad/m]: then what is minimised is the sum of the edges' slopes and all costs.
        scale: x̄, in the unit of the value.
    """

    robot: Robot
    task: TaskSpace
    name: str
    weight: float
    scale: float

    def cost(self, q: Tensor) -> float:
        """Weighted sum of the penalties of configurations (n, V)."""
        return float(self._penalties(_values(self.robot, self.task, self.name, q)).sum()) / _SHARPNESS

    def model(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """The cost near configurations (n, V), to second order.

        Returns:
            Minus its gradient (n, V), and directions (k, n, V) whose squares add up to its curvature.
        """

        def differentiated(part: Tensor) -> tuple[Tensor, Tensor]:
            with torch.enable_grad():
                part = part.detach().requires_grad_()
                values = _values(self.robot, self.task, self.name, part)
                gradients = [torch.autograd.grad(row.sum(), part, retain_graph=True)[0] for row in values]
            return values.detach(), torch.stack(gradients)

        values, gradients = in_pieces(differentiated, q)
        penalties = self._penalties(values)
        pull = (penalties[:, None] * gradients).sum(0) / self.scale
        return pull, (_SHARPNESS * penalties).sqrt()[:, None] * gradients / self.scale

    def _penalties(self, values: Tensor) -> Tensor:
        """Three times the costs of values."""
        return self.weight * (_SHARPNESS * (1.0 - values / self.scale)).exp()


def measure_objective(robot: Robot, task: TaskSpace, name: str, configurations: Tensor) -> Tensor:
    """An objective's value (V,) for configurations (V, n); of several at a vertex, the smallest."""
    columns = robot.columns(configurations)
    with torch.no_grad():
        return in_pieces(lambda part: (_values(robot, task, name, part).amin(0),), columns)[0]


def _values(robot: Robot, task: TaskSpace, name: str, q: Tensor) -> Tensor:
    """(k, N) values of configurations (n, N); k is the number of limited joints for limits, else 1."""
    if name == "clearance":
        return robot.self_collision_distance(q.T)[None]
    if name == "manipulability":
        frames = robot.tree.frames(q)
        # √det(J Jᵀ) does not depend on the basis that the points give
        points = task.at(*robot.tree.tool_pose(frames)).detach()
        jacobian = task.jacobian(robot.tree.jacobian(frames), points)
        normal = torch.einsum("anN,bnN->Nab", jacobian, jacobian)
        normal = normal + _LEAST_PIVOT * torch.eye(len(jacobian), dtype=q.dtype, device=q.device)
        return (0.5 * torch.logdet(normal)).exp()[None]
    limited = _limited(robot)
    lower, upper = robot.lower[limited, None], robot.upper[limited, None]
    return 1.0 - (2.0 * q[limited] - lower - upper).abs() / (upper - lower)


def _limited(robot: Robot) -> Tensor:
    """(n,) joints with limits on both sides, and room between them."""
    return robot.lower.isfinite() & robot.upper.isfinite() & (robot.lower < robot.upper) & ~robot.continuous
