"""Paths: waypoints with times, and how far the tool strays between them."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from grr_torch.applications.retime import retime
from grr_torch.applications.ways import Way, substeps
from grr_torch.errors import ParameterError
from grr_torch.spaces.configuration import difference, distance
from grr_torch.tables import table_writer, unique_names

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap

# waypoints nearer to each other [rad or m] are one
_SAME = 1e-9


@dataclass(frozen=True, eq=False)
class Path:
    """A path over a roadmap, or why there is none; then it has no waypoints.

    Attributes:
        points: (K, width) points of the task space [m].
        configurations: (K, n) configurations there [rad or m]; continuous joints are unwrapped: a controller may
            subtract neighbours.
        times: (K,) when they are passed [s], from 0.
        vertices: (S,) vertices of the roadmap that it goes through.
        max_deviation: Largest distance of the tool from the straight lines between the vertices [m], also between
            waypoints; a configuration's way to the map does not count where it is straight in joint space.
        mean_deviation: Its mean.
        reason: Why there is no path; empty if there is one.
        dimension: How many of a point's entries, the first ones, are its position.
    """

    points: Tensor
    configurations: Tensor
    times: Tensor
    vertices: Tensor
    max_deviation: float
    mean_deviation: float
    reason: str = ""
    dimension: int = 3

    @property
    def found(self) -> bool:
        """Whether there is a path."""
        return not self.reason

    @property
    def duration(self) -> float:
        """Time that it takes [s]."""
        return float(self.times[-1]) if self.found else math.nan

    @property
    def task_length(self) -> float:
        """Length of the tool's way [m]."""
        return float(self.points[:, : self.dimension].diff(dim=0).norm(dim=1).sum()) if self.found else math.nan

    @property
    def joint_length(self) -> float:
        """Sum of D_q between neighbouring waypoints [rad]."""
        return float(self.configurations.diff(dim=0).norm(dim=1).sum()) if self.found else math.nan


def path_of(roadmap: Roadmap, ways: list[Way], velocity_limits: Tensor, acceleration_limits: Tensor | None) -> Path:
    """The path that ways make, one after the other, with its times."""
    points, q = _joined(ways, roadmap.robot.continuous)
    largest, mean = _deviation(roadmap, ways)
    times = retime(q.cpu(), velocity_limits, acceleration_limits)
    passed = _passed(roadmap, ways)
    return Path(points.cpu(), q.cpu(), times, passed, largest, mean, dimension=roadmap.task.dimension)


def save_path(roadmap: Roadmap, path: Path, file: str | os.PathLike[str]) -> None:
    """Writes a row for each waypoint: time, coordinates, joints; an .npz has `vertices` and `joint_names` as well.

    Raises:
        ParameterError: There is no path, or the file does not end in .csv, .npy, .npz or .parquet.
        OutputError: It cannot be written.
    """
    if not path.found:
        raise ParameterError("path", path.reason, "one that was found")
    axes = roadmap.task.coordinates
    joints = unique_names(roadmap.robot.joint_names, (*axes, "time"))
    columns = {"times": ["time"], "points": axes, "configurations": joints}
    constants = {"vertices": path.vertices.numpy(), "joint_names": np.array(roadmap.robot.joint_names)}
    with table_writer(FilePath(file), columns, len(path.times), constants) as write:
        write({name: getattr(path, name).numpy() for name in columns})


def no_path(roadmap: Roadmap, reason: str) -> Path:
    """A path that was not found."""
    points, q = roadmap.points[:0], roadmap.configurations[:0]
    return Path(points, q, points.new_empty(0), torch.empty(0, dtype=torch.long), math.nan, math.nan, reason)


def _joined(ways: list[Way], continuous: Tensor) -> tuple[Tensor, Tensor]:
    """Points (K, width) and unwrapped configurations (K, n) of ways one after the other, without repetitions."""
    points = torch.cat([way.points for way in ways])
    q = torch.cat([way.configurations for way in ways])
    moved = difference(q[:-1], q[1:], continuous)
    new = torch.cat([torch.ones_like(moved[:1, 0], dtype=torch.bool), moved.norm(dim=1) > _SAME])
    points, q = points[new], q[new]
    return points, torch.cat([q[:1], q[:1] + difference(q[:-1], q[1:], continuous).cumsum(0)])


def _deviation(roadmap: Roadmap, ways: list[Way]) -> tuple[float, float]:
    """Largest and mean distance of the tool from the ways' straight lines [m], at the substeps of a controller."""
    robot = roadmap.robot
    d = roadmap.task.dimension
    found: list[Tensor] = []
    for way in ways:
        if way.straight:
            # a way begins where the one before it ended
            start = way.configurations[: 0 if found else 1]
            q = torch.cat([start, substeps(way.configurations, robot.continuous).flatten(0, 1)])
            position = robot.forward_kinematics(q)[0][:, :d]
            origin, line = way.points[0, :d], way.points[-1, :d] - way.points[0, :d]
            share = ((position - origin) @ line / line.square().sum().clamp_min(1e-24)).clamp(0.0, 1.0)
            found.append((position - origin - share[:, None] * line).norm(dim=1).cpu())
    every = torch.cat(found) if found else torch.zeros(1)
    return float(every.max()), float(every.mean())


def _passed(roadmap: Roadmap, ways: list[Way]) -> Tensor:
    """Vertices at which ways begin or end, in order."""
    ends = torch.stack([ways[0].configurations[0], *(way.configurations[-1] for way in ways)]).cpu()
    points = torch.stack([ways[0].points[0], *(way.points[-1] for way in ways)]).cpu()
    nearest = roadmap.solver.nearest(points)[1][:, 0]
    there = distance(roadmap.configurations[nearest], ends, roadmap.robot.continuous.cpu()) <= _SAME
    return torch.unique_consecutive(nearest[there & (roadmap.task.distance(roadmap.points[nearest], points) <= _SAME)])
