"""Teleoperation on a roadmap: the paper's pipeline (Section IV-E), a control step at a time, for any number of arms."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from grr_torch.applications.arms import Arms
from grr_torch.applications.braking import limit_acceleration
from grr_torch.applications.lines import Follower
from grr_torch.applications.pilot import Pilot
from grr_torch.applications.pursuit import Pursuit
from grr_torch.applications.retime import per_joint, usual_speeds
from grr_torch.applications.routes import Routes
from grr_torch.applications.solve import LAST_VALID
from grr_torch.applications.steps import HOLDING, STATUSES
from grr_torch.errors import GrrWarning, ParameterError, check_kind
from grr_torch.pieces import Array, Mask, norms, one_thread
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.roadmap import Roadmap

# of projections along lines, whose guesses are near; what takes longer is not to be gone to in a control step
_ITERATIONS = 6
# of how much faster than the control steps, as a share, the clock of inputs may seem to go: neither goes exactly
_DRIFT = 0.03
# control steps a second [Hz]
FASTEST = 1e4
# radians or metres beyond limits from which on a configuration is likely to be in other units
_FARTHEST_OUTSIDE = 3.0
# seconds that can be looked ahead
_FARTHEST_AHEAD = 60.0


@dataclass(frozen=True, eq=False)
class Command:
    """What arms are to do next.

    Attributes:
        configuration: (*batch, n) configurations for the next control step [rad or m]; continuous joints are not
            wrapped, so that a controller may subtract.
        status: (*batch,) array of text: "tracking" the target; "detouring", on a planned way to it, to where they
            will meet, or back to the map; "holding", because the input was refused, there is no way on, or the arm
            waits two steps before it sets off on a detour for a target next to it; "unreachable": the target cannot
            be reached, and the arm is at or on its way to the nearest point that can, but for those close to full
            stretch, and those hardly nearer that take much joint motion or a detour.
    """

    configuration: Tensor
    status: np.ndarray[Any, np.dtype[np.str_]]


class Teleoperator:
    """Follows targets with arms, within their velocity limits and free of self-collision (Section IV-E).

    In every step each arm goes straight to its target's configuration on the map, if the line there is continuous.
    If not, its joints go straight there while the tool stays turned as the task asks; where that is not free, a way
    over the roadmap is searched for. Where the target cannot be reached, the arm goes to the nearest point that can,
    and slides along the edge of what is reachable as the target moves. If the target is about to come out on the other
    side of a hole, it goes there in time.

    An arm may start anywhere: off the map, outside a limit, in contact. It then goes back by straight joint-space
    motions, and from a contact never deeper into it.
    """

    def __init__(
        self,
        roadmap: Roadmap,
        rate: float = 50.0,
        *,
        start: Tensor | None = None,
        max_step: float | Tensor | None = None,
        acceleration_limits: float | Tensor | None = None,
        max_jump: float = math.inf,
        timeout: float = math.inf,
        foresight: float = 2.0,
    ) -> None:
        """Makes a teleoperator; nothing moves before `step`.

        Args:
            roadmap: The roadmap.
            rate: Control steps in a second [Hz].
            start: (*batch, n) where the arms stand, as measured; by default at the first target's configuration on
                the map, or at the nearest resolved vertex where it has none.
            max_step: The most that a joint moves in a step [rad or m], one number or (n,); by default the robot's
                velocity limits over the rate, 1 rad/s or 1 m/s where it has none.
            acceleration_limits: Of the joints [rad/s² or m/s²], one number or (n,); by default none. An arm that has
                them never moves so fast that it could not stop free of self-collision. It is ready to stop where its
                target is, so it falls behind one that moves by what stopping takes.
            max_jump: A target farther from the last one than this [m] is refused, until `reset`; where rotation
                varies, a radian counts as 0.3 m.
            timeout: An input older than this [s] is refused, where `step` is told its `time`.
            foresight: For how long at most a target is taken to go on straight by an arm that cannot follow it, and
                heads for where they will meet [s]; with 0, it heads for where the target is.

        Raises:
            ParameterError: A parameter is out of its range, no vertex is resolved, or the robot is not on the CPU.
        """
        check_kind("roadmap", roadmap, Roadmap, "Roadmap.load(file)")
        robot = roadmap.robot
        if robot.device.type != "cpu":
            raise ParameterError("device of the robot", str(robot.device), "cpu, where few arms are fastest")
        if not 0.0 < rate <= FASTEST:
            raise ParameterError("rate", rate, f"above 0 and up to {FASTEST:,.0f} Hz")
        for name, value in (("max_jump", max_jump), ("timeout", timeout)):
            if not value > 0.0:
                raise ParameterError(name, value, "above 0")
        if not 0.0 <= foresight <= _FARTHEST_AHEAD:
            raise ParameterError("foresight", foresight, f"0 to {_FARTHEST_AHEAD:g} s")
        self.roadmap, self.rate, self.max_jump, self.timeout = roadmap, rate, max_jump, timeout
        longest = (
            usual_speeds(robot.velocity_limits) / rate
            if max_step is None
            else per_joint("max_step", max_step, robot.lower)
        )
        self._gain = None
        if acceleration_limits is not None:
            self._gain = per_joint("acceleration_limits", acceleration_limits, robot.lower) / rate**2
        tolerances = replace(Tolerances(**roadmap.parameters["tolerances"]), iterations=_ITERATIONS)
        self._follower = Follower(robot, roadmap.task, tolerances, longest)
        routes = Routes(roadmap, length=self._follower.duration)
        pursuit = Pursuit(self._follower, roadmap.solver, rate, foresight)
        self._pilot = Pilot(self._follower, roadmap.solver, routes, pursuit)
        self._batch: torch.Size = torch.Size()
        self._arms: Arms | None = None
        self.reset(start)

    @property
    def configuration(self) -> Tensor | None:
        """(*batch, n) where the arms are, as last commanded or reset; None before the first target where none is."""
        return None if self._arms is None else self._shaped(self._arms.q)

    def reset(self, configuration: Tensor | None = None) -> None:
        """Starts anew: the next target is taken wherever it is, and no input is too old.

        Args:
            configuration: (*batch, n) where the arms stand, as measured, at rest; by default they are where they were
                commanded to, as fast as they are.

        Raises:
            ParameterError: It is not finite, or its last axis is not n.
        """
        robot = self.roadmap.robot
        if configuration is not None:
            q = robot.columns(configuration).detach().T
            if not bool(q.isfinite().all()):
                raise ParameterError("configuration", "NaN or infinite values", "finite values")
            if not bool(robot.within_limits(q, _FARTHEST_OUTSIDE).all()):
                far = f"a joint is more than {_FARTHEST_OUTSIDE:g} rad or m beyond its limits: is it in degrees?"
                warnings.warn(f"configuration: {far}", GrrWarning, stacklevel=2)
            self._batch, self._arms = configuration.shape[:-1], Arms.at(self._follower, q.numpy().copy())
        elif self._arms is not None:
            speed, self._arms = self._arms.speed, Arms.at(self._follower, self._arms.q)
            self._arms.speed = speed
        self._last: Array | None = None
        self._now, self._freshest, self._early = 0.0, math.inf, math.nan

    def step(self, target: Tensor, time: float | None = None) -> Command:
        """One control step.

        A target that is not finite, whose direction or quaternion has no length, that is too far from the last one or
        too old is refused: the arm holds.

        Args:
            target: (*batch, width) points of the task space, one for each arm.
            time: When the target was given [s], on any clock. An input is as old as it has fallen behind the control
                steps since `reset`, compared with the one that was least behind. 3 % of the time that has passed since
                is put down to clocks that differ, so that a delay that grows no faster is not noticed. One that comes
                too early, by more than `timeout`, is refused, until the next one says the same.

        Returns:
            The configurations to go to next, and what the arms are doing.

        Raises:
            ParameterError: The shape is not that of the arms; or it is not known where they stand, and the first target
                of one is not valid.
        """
        task, robot = self.roadmap.task, self.roadmap.robot
        if not isinstance(target, Tensor) or target.ndim == 0 or target.shape[-1] != task.width:
            given = tuple(target.shape) if isinstance(target, Tensor) else type(target).__name__
            raise ParameterError("target", given, f"a tensor of shape (*batch, {task.width})")
        if self._arms is not None and target.shape[:-1] != self._batch:
            raise ParameterError("target shape", tuple(target.shape), f"{(*self._batch, task.width)}: one for each arm")
        targets = target.detach().to(robot.lower).reshape(-1, task.width).numpy().copy()
        # targets beyond all numbers are only far away
        with torch.no_grad(), one_thread(), np.errstate(over="ignore", invalid="ignore"):
            proper = self._normalise(targets)
            accepted = proper & self._in_time(time)
            if self._arms is None:
                if not proper.all():
                    valid = "valid points, where the arms start; or start or reset says where they are"
                    raise ParameterError("first target", "NaN, infinite or zero", valid)
                self._start(target.shape[:-1], targets)
            if self._last is not None:
                # comparison with NaN, where there was no target yet, is false
                accepted &= ~(task.gap_of_few(targets, self._last) > self.max_jump)
                targets = np.where(accepted[:, None], targets, self._last)
            self._last = np.where(accepted[:, None], targets, np.nan) if self._last is None else targets
            return self._advance(accepted, targets)

    def _advance(self, accepted: Mask, targets: Array) -> Command:
        arms = self._arms
        assert arms is not None
        arms.meeting.unchanged += 1
        q, goals, points = arms.q.copy(), arms.q.copy(), arms.p.copy()
        codes = np.full(len(targets), HOLDING)
        which = accepted.nonzero()[0]
        if len(which):
            q[which], goals[which], points[which], codes[which] = self._pilot.steps(arms, which, targets[which])
        if self._gain is not None:
            moving = (torch.from_numpy(array) for array in (arms.q, arms.speed, q, goals))
            arms.speed = limit_acceleration(self._follower, self._gain, *moving).numpy()
            q, points = arms.q + arms.speed, np.full_like(points, np.nan)
        arms.q, arms.p = q, points
        unknown = (~(norms(points) < np.inf)).nonzero()[0]
        if len(unknown):
            arms.look(self._follower, unknown)
        return Command(self._shaped(q), STATUSES[codes].reshape(self._batch))

    def _shaped(self, q: Array) -> Tensor:
        """Configurations (B, n) as (*batch, n), a copy."""
        return torch.from_numpy(q.reshape(*self._batch, self.roadmap.robot.n).copy())

    def _start(self, batch: torch.Size, targets: Array) -> None:
        """Arms at their first targets."""
        solver, points = self.roadmap.solver, torch.from_numpy(targets)
        q, codes = solver.solve_columns(points.T.contiguous())
        vertices = solver.nearest(points)[1][:, 0]
        placed = torch.where((codes <= LAST_VALID)[:, None], q.T, solver.configurations[vertices])
        self._batch, self._arms = batch, Arms.at(self._follower, placed.numpy())

    def _normalise(self, targets: Array) -> Mask:
        """Makes the rotations of targets (B, width) those that points have; which targets are proper ones (B,)."""
        task = self.roadmap.task
        proper: Mask = np.asarray(np.isfinite(targets).all(1), dtype=bool)
        if task.rotations is not None:
            proper &= task.rotations.are_rotations(torch.from_numpy(targets[:, task.dimension :])).numpy()
            targets[proper] = task.unit(torch.from_numpy(targets[proper])).numpy()
        return proper

    def _in_time(self, time: float | None) -> bool:
        """Whether an input is younger than the time-out; the control clock advances."""
        self._now += 1.0 / self.rate
        self._freshest += _DRIFT / self.rate
        if time is None:
            return True
        if not math.isfinite(time):
            return False
        behind = self._now - time
        early = self._freshest < math.inf and behind < self._freshest - self.timeout
        believed = not early or abs(behind - self._early) <= self.timeout
        self._early = behind if early else math.nan
        if not believed:
            return False
        self._freshest = min(self._freshest, behind)
        return behind - self._freshest <= self.timeout
