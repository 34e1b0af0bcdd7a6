"""What the reactive inverse kinematics solvers have in common: arms that stand somewhere and follow targets."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from grr_torch.errors import ParameterError
from grr_torch.pieces import one_thread
from grr_torch.projection.project import point_columns
from grr_torch.robots.robot import Robot
from grr_torch.spaces.task import TaskSpace


class ReactiveIk(ABC):
    """Arms of one kind that follow a target each, step by step, at a fixed rate.

    Joint values are never wrapped: a continuous joint counts its turns.

    Attributes:
        robot: The robot.
        task: The task space.
    """

    def __init__(self, robot: Robot, task: TaskSpace, *, max_step: float | Tensor) -> None:
        """Makes arms that stand nowhere yet: `reset` comes first.

        Args:
            robot: The robot.
            task: The task space of the targets.
            max_step: The most that a joint moves in a step [rad or m]; a number, or one for each joint (n,).

        Raises:
            ParameterError: `max_step` is not positive and finite, or has the wrong shape.
        """
        steps = torch.as_tensor(max_step, dtype=robot.dtype, device=robot.device)
        if steps.shape not in ((), (robot.n,)):
            raise ParameterError("max_step shape", tuple(steps.shape), f"a number or ({robot.n},)")
        if not bool(((steps > 0.0) & steps.isfinite()).all()):
            raise ParameterError("max_step", max_step, "above 0 and finite")
        self.robot, self.task = robot, task
        self._max_step = steps.expand(robot.n)[:, None]
        self._batch: tuple[int, ...] | None = None

    def reset(self, configurations: Tensor) -> None:
        """Puts the arms, at rest, where they stand.

        Args:
            configurations: (*batch, n) [rad or m].

        Raises:
            ParameterError: The shape is not (*batch, n), or a value is not finite.
        """
        columns = self.robot.columns(configurations)
        if not bool(columns.isfinite().all()):
            raise ParameterError("configurations", "NaN or infinite values", "finite values")
        self._batch = tuple(configurations.shape[:-1])
        self._start(columns.clone())

    def step(self, targets: Tensor) -> Tensor:
        """Moves every arm by one step towards its target.

        Args:
            targets: (*batch, width) points, with the batch shape of `reset`.

        Returns:
            (*batch, n) where the arms stand now [rad or m].

        Raises:
            ParameterError: The arms were never put anywhere, the shape does not fit, or a value is not finite; the
                arms have not moved then.
        """
        if self._batch is None:
            raise ParameterError("configurations", "none", "a call of reset before the first step")
        columns = point_columns(self.robot, self.task, targets)
        if tuple(targets.shape[:-1]) != self._batch:
            valid = f"{(*self._batch, self.task.width)}, as many as there are arms"
            raise ParameterError("targets shape", tuple(targets.shape), valid)
        with torch.no_grad(), one_thread():
            moved = self._advance(columns)
        return moved.T.reshape(*self._batch, self.robot.n).clone()

    @abstractmethod
    def _start(self, q: Tensor) -> None:
        """Takes (n, N) as the arms' configurations, at rest."""

    @abstractmethod
    def _advance(self, targets: Tensor) -> Tensor:
        """Configurations (n, N) after a step towards targets (width, N), which are kept as the arms' own."""
