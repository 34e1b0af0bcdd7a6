"""What is measured of a teleoperated path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from grr_torch.applications.teleoperation_log import AWAY, STILL, longest_time
from grr_torch.errors import MissingPackageError
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.spaces.configuration import difference

# a path succeeds if it ends so near its goal [m, rad]
_NEAR_POSITION, _NEAR_ROTATION = 0.1, 0.1
# configurations between two steps at which self-collision is looked for
_SUBSTEPS = 8


@dataclass(frozen=True, eq=False)
class Figures:
    """Metrics (paths,) of trajectories.

    Attributes:
        deviation: Mean distance over the pairs that dynamic time warping matches between the waypoints and the tool's
            positions at the control steps [m].
        tilt: Mean rotation error over the steps [rad].
        smoothness: Σ|Δq| / Σ|Δp| of the path [rad/m].
        success: Ends within 0.1 m and 0.1 rad of the goal, free of self-collision at 8 configurations a step.
        joint_step: The largest that a joint moves in a step [rad or m].
        acceleration: The largest of a joint [rad/s² or m/s²].
        closure: Largest joint difference between end and start, continuous joints modulo 2π [rad or m]; NaN for
            paths that are not closed.
        stall: Longest time for which the arm stood still more than 1 cm away from its target [s].
    """

    deviation: Tensor
    tilt: Tensor
    smoothness: Tensor
    success: Tensor
    joint_step: Tensor
    acceleration: Tensor
    closure: Tensor
    stall: Tensor


def measure(roadmap: Roadmap, waypoints: Tensor, trajectories: Tensor, rate: float, *, closed: bool) -> Figures:
    """Measures trajectories that followed waypoints.

    Args:
        roadmap: Whose robot and task space are meant.
        waypoints: (paths, waypoints, width).
        trajectories: (paths, steps, n), the start first, NaN after a path's end.
        rate: Control steps in a second [Hz].
        closed: Whether the paths end where they began.

    Raises:
        MissingPackageError: dtw-python is not installed.
    """
    rows = [
        _measure_one(roadmap, path, trajectory[trajectory.isfinite().all(1)], rate, closed)
        for path, trajectory in zip(waypoints, trajectories, strict=True)
    ]
    columns = {name: [row[name] for row in rows] for name in (field.name for field in fields(Figures))}
    return Figures(**{name: torch.tensor(values) for name, values in columns.items()})


def _measure_one(roadmap: Roadmap, path: Tensor, q: Tensor, rate: float, closed: bool) -> dict[str, float | bool]:
    """The figures of one path (waypoints, width) and trajectory (steps, n)."""
    robot, task = roadmap.robot, roadmap.task
    d = task.dimension
    position, rotation = (part.cpu() for part in robot.forward_kinematics(q))
    # the target at each step, the last one from then on
    targets = path[torch.arange(len(q)).clamp_max(len(path) - 1)]
    errors = task.residuals(task.error(targets.T, position.T, rotation.permute(1, 2, 0)))
    final = task.residuals(task.error(path[-1:].T, position[-1:].T, rotation[-1:].permute(1, 2, 0)))
    motion = q.diff(dim=0)
    travelled = float(position[:, :d].diff(dim=0).norm(dim=1).sum())
    fractions = torch.arange(1, _SUBSTEPS + 1, dtype=q.dtype)[:, None, None] / _SUBSTEPS
    collides = bool(robot.in_self_collision(q[:-1] + fractions * motion).any())
    still = (motion.abs().amax(1) <= STILL) & (errors[0][1:] > AWAY)
    near = float(final[0]) <= _NEAR_POSITION and float(final[1]) <= _NEAR_ROTATION
    back = difference(q[0], q[-1], robot.continuous.cpu()).abs().max()
    return {
        "deviation": _warped_distance(path[:, :d].numpy(), position[:, :d].numpy()),
        "tilt": float(errors[1].mean()),
        "smoothness": float(motion.norm(dim=1).sum()) / travelled if travelled > 0.0 else 0.0,
        "success": near and not collides,
        "joint_step": float(motion.abs().max()) if len(motion) else 0.0,
        "acceleration": float(motion.diff(dim=0).abs().max()) * rate**2 if len(motion) > 1 else 0.0,
        "closure": float(back) if closed else float("nan"),
        "stall": longest_time(still, torch.full_like(errors[0][1:], 1.0 / rate)),
    }


def warping() -> Callable[..., Any]:
    """Dynamic time warping, from the library that does it.

    Raises:
        MissingPackageError: dtw-python is not installed.
    """
    try:
        from dtw import dtw
    except ImportError as error:
        raise MissingPackageError("dtw-python", "bench", "the deviation from a path") from error
    return dtw


def _warped_distance(waypoints: np.ndarray, positions: np.ndarray) -> float:
    """Mean distance [m] over the pairs that dynamic time warping matches."""
    from scipy.spatial.distance import cdist

    distances = cdist(waypoints, positions)
    matched = warping()(distances, step_pattern="symmetric1")
    return float(distances[matched.index1, matched.index2].mean())
