"""What happened in a teleoperation, control step by control step, and what is said of it afterwards."""

from __future__ import annotations

import os
from array import array
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from grr_torch.applications.steps import STATUSES
from grr_torch.errors import ParameterError
from grr_torch.output import atomic_write
from grr_torch.pieces import one_thread
from grr_torch.projection.project import tool_points
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.tables import table_writer, unique_names

# an arm stalls when no joint moves more than this in a step [rad or m] though its tool has farther to go than that [m]
STILL, AWAY = 1e-4, 0.01


@dataclass(frozen=True)
class Step:
    """One control step.

    Attributes:
        time: When it was, from the start [s].
        target: (width,) the target.
        configuration: (n,) the configuration that was commanded, not wrapped [rad or m].
        status: Of `STATUSES`.
        clearance: Self-collision distance [m], the margin subtracted; inf without a sphere model.
        seconds: How long the step took to compute [s].
    """

    time: float
    target: tuple[float, ...]
    configuration: Tensor
    status: str
    clearance: float
    seconds: float


@dataclass(frozen=True)
class Summary:
    """Figures of a teleoperation.

    Attributes:
        steps: Control steps.
        seconds: How long it took in the arm's time [s].
        shares: The share of steps with each status.
        joint_step: The most that a joint moved in a step [rad or m].
        stall: The longest time for which no joint moved though the tool was more than 1 cm from its target [s], or
            as good as that turned away; also while the clutch was let go.
        clearance: The smallest self-collision distance, the margin subtracted [m]; None without a sphere model.
        deviation: Mean distance of the tool from its target in the same step [m].
        largest_deviation: The largest such distance [m].
        final_deviation: That of the last step [m].
        turn: Mean rotation of the tool from its target in the same step [rad]; None where rotation is free.
        largest_turn: The largest such rotation [rad].
        final_turn: That of the last step [rad].
        step_milliseconds: Median time to compute a step [ms].
    """

    steps: int
    seconds: float
    shares: dict[str, float]
    joint_step: float
    stall: float
    clearance: float | None
    deviation: float
    largest_deviation: float
    final_deviation: float
    turn: float | None
    largest_turn: float | None
    final_turn: float | None
    step_milliseconds: float

    def to_dict(self) -> dict[str, Any]:
        """As JSON has it."""
        return asdict(self)


def tool_and_clearance(roadmap: Roadmap, q: Tensor) -> tuple[Tensor, float]:
    """Where the tool (width,) is at a configuration (n,), and its self-collision distance, less the margin [m]."""
    # of one configuration, several threads would wait for each other
    with one_thread():
        tool = tool_points(roadmap.robot, roadmap.task, q[None])[0]
        return tool, float(roadmap.robot.self_collision_distance(q)) - roadmap.robot.margin


class TeleoperationLog:
    """The steps of one teleoperation of one arm. Grows by `append`; an hour at 50 Hz takes about 20 MB."""

    def __init__(self, roadmap: Roadmap, rate: float) -> None:
        self.roadmap, self.rate = roadmap, rate
        self._width = 3 + roadmap.task.width + roadmap.robot.n
        self._rows, self._codes = array("d"), array("b")

    def __len__(self) -> int:
        return len(self._codes)

    def append(self, step: Step) -> None:
        """Adds a step."""
        figures = (step.time, step.clearance, step.seconds, *step.target, *step.configuration.tolist())
        assert len(figures) == self._width
        self._rows.extend(figures)
        self._codes.append(STATUSES.tolist().index(step.status))
        self.__dict__.pop("_poses", None)

    @property
    def times(self) -> Tensor:
        """(T,) when steps were, from the start [s]."""
        return self._table()[:, 0]

    @property
    def clearances(self) -> Tensor:
        """(T,) self-collision distances, the margin subtracted [m]."""
        return self._table()[:, 1]

    @property
    def step_seconds(self) -> Tensor:
        """(T,) how long steps took to compute [s]."""
        return self._table()[:, 2]

    @property
    def targets(self) -> Tensor:
        """(T, width) targets."""
        return self._table()[:, 3 : 3 + self.roadmap.task.width]

    @property
    def configurations(self) -> Tensor:
        """(T, n) commanded configurations, not wrapped [rad or m]."""
        return self._table()[:, 3 + self.roadmap.task.width :]

    @property
    def status(self) -> np.ndarray[Any, np.dtype[np.str_]]:
        """(T,) array of text: what `Command.status` says."""
        return STATUSES[np.array(self._codes[:], dtype=np.intp)]

    @property
    def tools(self) -> Tensor:
        """(T, 3) where the tool was [m]."""
        return self._poses[0].T

    @property
    def deviations(self) -> Tensor:
        """(T,) distances of the tool from its target [m]."""
        return self._residuals()[0]

    @property
    def turns(self) -> Tensor | None:
        """(T,) rotations of the tool from its target [rad]; None where rotation is free."""
        task = self.roadmap.task
        return None if task.constraints == task.dimension else self._residuals()[1]

    @cached_property
    def _poses(self) -> tuple[Tensor, Tensor]:
        """The tool's positions (3, T) and rotations (3, 3, T)."""
        position, rotation = self.roadmap.robot.forward_kinematics(self.configurations)
        return position.T.cpu(), rotation.permute(1, 2, 0).cpu()

    def _residuals(self) -> tuple[Tensor, Tensor]:
        task = self.roadmap.task
        return task.residuals(task.error(self.targets.T, *self._poses))

    def summary(self) -> Summary:
        """Figures of the whole.

        Raises:
            ParameterError: There was no step.
        """
        if len(self) == 0:
            raise ParameterError("log", "no step", "at least one")
        motion, deviations, turns = self.configurations.diff(dim=0).abs().amax(1), self.deviations, self.turns
        clearance, task = float(self.clearances.min()), self.roadmap.task
        status = self.status
        away = task.gap_of_few(task.at(*self._poses).T.numpy(), self.targets.numpy()) > AWAY
        still = (motion <= STILL) & torch.from_numpy(away[1:])
        return Summary(
            steps=len(self),
            seconds=float(self.times[-1]),
            shares={name: float((status == name).mean()) for name in STATUSES.tolist()},
            joint_step=float(motion.max()) if len(motion) else 0.0,
            stall=longest_time(still, self.times.diff()),
            clearance=clearance if np.isfinite(clearance) else None,
            deviation=float(deviations.mean()),
            largest_deviation=float(deviations.max()),
            final_deviation=float(deviations[-1]),
            turn=None if turns is None else float(turns.mean()),
            largest_turn=None if turns is None else float(turns.max()),
            final_turn=None if turns is None else float(turns[-1]),
            step_milliseconds=1e3 * float(self.step_seconds.median()),
        )

    def save_trajectory(self, path: str | os.PathLike[str]) -> None:
        """Writes the joint trajectory, by an atomic rename.

        `.csv` and `.parquet`: time and joints, by name; `.npy`: configurations (T, n); `.npz`: `time`,
        `configurations`, `targets`, `tools`, `status`, `clearance` and `joint_names`.

        Raises:
            ParameterError: The name ends in something else.
            OutputError: It cannot be written.
        """
        path, names = Path(path), self.roadmap.robot.joint_names
        if path.suffix.lower() == ".npy":
            # not a table's columns: controllers read an array
            with atomic_write(path) as temporary, temporary.open("wb") as file:
                np.save(file, np.ascontiguousarray(self.configurations.numpy()))
            return
        columns = {"time": ["time"], "configurations": unique_names(names, ("time",))}
        with table_writer(path, columns, len(self), {"joint_names": np.array(names)}) as write:
            write(
                {
                    "time": self.times.numpy(),
                    "configurations": self.configurations.numpy(),
                    "targets": self.targets.numpy(),
                    "tools": self.tools.numpy(),
                    "status": self.status,
                    "clearance": self.clearances.numpy(),
                }
            )

    def _table(self) -> Tensor:
        # an array cannot grow while something looks into it
        return torch.from_numpy(np.array(self._rows[:])).reshape(-1, self._width)


def longest_time(flags: Tensor, durations: Tensor) -> float:
    """The longest time for which steps in a row are flagged [s]."""
    longest = running = 0.0
    for flag, duration in zip(flags.tolist(), durations.tolist(), strict=True):
        running = running + duration if flag else 0.0
        longest = max(longest, running)
    return longest
