"""A person and an arm: the target that the one moves and the control steps of the other. It knows no browser."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import torch
from torch import Tensor

from grr_torch.applications.example_paths import middles
from grr_torch.applications.teleoperate import Teleoperator
from grr_torch.applications.teleoperation_log import Step, TeleoperationLog, tool_and_clearance
from grr_torch.errors import ParameterError

# a target may leave what is resolved by this share of its size
_BEYOND = 0.25


class Session:
    """One arm that follows a target which others move.

    `tick` is called at the control rate by one thread; the target may be moved, and the clutch let go, by another.

    Attributes:
        teleoperator: What leads the arm.
        roadmap: Its roadmap.
        rate: Control steps in a second [Hz].
        low: (d,) lower bounds of the target's position [m].
        high: (d,) upper bounds of the target's position [m].
        home: (width,) where the target starts.
        log: All steps.
    """

    def __init__(self, teleoperator: Teleoperator) -> None:
        """Puts the arm of a teleoperator, one whatever it had before, in the middle of its roadmap."""
        self.teleoperator = teleoperator
        self.roadmap, self.rate = teleoperator.roadmap, teleoperator.rate
        roadmap = self.roadmap
        self.home = middles(roadmap)[0]
        vertex = int((roadmap.points == self.home).all(1).nonzero()[0, 0])
        teleoperator.reset(roadmap.configurations[vertex].to(roadmap.robot.lower))
        resolved = roadmap.positions[roadmap.resolved]
        low, high = resolved.amin(0), resolved.amax(0)
        self.low, self.high = low - _BEYOND * (high - low), high + _BEYOND * (high - low)
        self.log = TeleoperationLog(roadmap, self.rate)
        self._target = self.tool = tuple(self.home.tolist())
        self._engaged, self._rearm = True, False

    @property
    def configuration(self) -> Tensor:
        """(n,) where the arm was last sent, not wrapped [rad or m]."""
        q = self.teleoperator.configuration
        assert q is not None
        return q

    @property
    def target(self) -> tuple[float, ...]:
        """(width,) the target."""
        return self._target

    @property
    def engaged(self) -> bool:
        """Whether the arm follows. While the clutch is let go it stands still, wherever the target goes."""
        return self._engaged

    def move(self, target: Sequence[float]) -> None:
        """Moves the target; one beyond the bounds is put on them.

        Raises:
            ParameterError: It is not finite, not of the task's width, or has a direction or quaternion of length zero.
        """
        task, given = self.roadmap.task, torch.tensor([float(value) for value in target], dtype=torch.float64)
        if given.shape != self.home.shape or not bool(given.isfinite().all()):
            raise ParameterError("target", tuple(target), f"finite numbers: {', '.join(task.coordinates)}")
        position = given[: task.dimension].clamp(self.low, self.high)
        self._target = tuple(task.unit(torch.cat([position, given[task.dimension :]])).tolist())

    def nudge(self, axis: int, distance: float) -> None:
        """Moves the target along one of its coordinates [m or rad]."""
        moved = list(self._target)
        moved[axis] += distance
        self.move(moved)

    def go_home(self) -> None:
        """Puts the target back to where it started."""
        self._target = tuple(self.home.tolist())

    def reset(self) -> None:
        """Puts the target to the tool, so that the arm stops, and forgets the last one."""
        self._target, self._rearm = self.tool, True

    def let_go(self) -> None:
        """Lets the clutch go: the arm stops, and the target may be moved to anywhere."""
        self._engaged = False

    def engage(self) -> None:
        """Engages the clutch: the target jumps to the tool, and the arm follows it again."""
        self.reset()
        self._engaged = True

    def residuals(self, step: Step) -> tuple[float, float]:
        """How far the tool is from a step's target [m], and how far turned [rad]; 0 where rotation is free."""
        task, position = self.roadmap.task, self.roadmap.robot.forward_kinematics(step.configuration)
        columns = torch.tensor(step.target, dtype=torch.float64)[:, None]
        error = task.error(columns.to(position[0]), position[0][:, None], position[1][..., None])
        away, turned = task.residuals(error)
        return float(away), float(turned)

    def tick(self, at: float | None = None) -> Step:
        """One control step.

        Args:
            at: When it is, from the start [s]; by default the steps so far over the rate.
        """
        if self._rearm:
            self._rearm = False
            self.teleoperator.reset()
        target = self._target
        start = time.perf_counter()
        # without a target to follow the arm holds, but one that has acceleration limits comes to rest first
        followed = torch.tensor(target if self._engaged else [math.nan] * len(target), dtype=torch.float64)
        command = self.teleoperator.step(followed)
        q, status = command.configuration, str(command.status)
        seconds = time.perf_counter() - start
        tool, clearance = tool_and_clearance(self.roadmap, q)
        self.tool = tuple(tool.tolist())
        step = Step(len(self.log) / self.rate if at is None else at, target, q, status, clearance, seconds)
        self.log.append(step)
        return step
