"""Teleoperation along waypoints that are there beforehand."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from grr_torch.applications.teleoperate import Teleoperator
from grr_torch.applications.teleoperation_log import Step, TeleoperationLog, tool_and_clearance
from grr_torch.errors import ParameterError
from grr_torch.progress import Progress, silent
from grr_torch.spaces.task import TaskSpace
from grr_torch.tables import read_points

# after the last waypoint an arm has so long to arrive [s], and has arrived when its tool is so near [m]
_MORE_SECONDS, _ARRIVED = 2.0, 1e-3


def read_waypoints(path: str | os.PathLike[str], task: TaskSpace) -> Tensor:
    """Waypoints (N, width) of a task, one a row of a .csv, with or without a header, .npy or .parquet.

    Raises:
        ParameterError: The suffix is not known.
        FileFormatError: It is missing, no such table, of another width, or has values that are not finite.
    """
    return torch.from_numpy(np.concatenate(list(read_points(Path(path), task.coordinates))))


def replay(teleoperator: Teleoperator, waypoints: Tensor, *, progress: Progress = silent) -> TeleoperationLog:
    """Lets one arm follow waypoints, one target for each control step, from the first one on.

    It starts where the teleoperator's arm stands, or at the first waypoint if that is nowhere yet. After the last one
    it has up to two more seconds to arrive.

    Args:
        teleoperator: What leads the arm; it is reset.
        waypoints: (N, width) targets.
        progress: Told how many steps are done.

    Raises:
        ParameterError: There is no waypoint, one is not finite or has a direction or quaternion of length zero,
            they are not of the task's width, or the teleoperator has several arms.
    """
    roadmap, rate = teleoperator.roadmap, teleoperator.rate
    width = roadmap.task.width
    if waypoints.ndim != 2 or waypoints.shape[1] != width or len(waypoints) == 0:
        raise ParameterError("waypoints", tuple(waypoints.shape), f"(1 or more, {width})")
    if not bool(waypoints.isfinite().all()):
        raise ParameterError("waypoints", "NaN or infinite values", "finite values")
    task = roadmap.task
    waypoints = task.unit(waypoints.to(torch.float64))
    teleoperator.reset()
    log = TeleoperationLog(roadmap, rate)
    total = len(waypoints) + round(_MORE_SECONDS * rate)
    for k in range(total):
        progress("following", k, total)
        target = waypoints[min(k, len(waypoints) - 1)]
        start = time.perf_counter()
        command = teleoperator.step(target)
        seconds = time.perf_counter() - start
        q = command.configuration
        tool, clearance = tool_and_clearance(roadmap, q)
        log.append(Step(k / rate, tuple(target.tolist()), q, str(command.status), clearance, seconds))
        if k >= len(waypoints) - 1 and float(task.gap_of_few(tool.numpy(), target.to(q).numpy())) <= _ARRIVED:
            break
    progress("following", total, total)
    return log
