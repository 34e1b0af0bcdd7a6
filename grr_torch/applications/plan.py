"""Paths over a roadmap (Section IV-E of the paper, "Task-space path planning")."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from grr_torch.applications.retime import per_joint, retime, usual_speeds
from grr_torch.applications.routes import Routes
from grr_torch.applications.shorten import shorten
from grr_torch.applications.ways import Stops, Way, WayFinder, substeps
from grr_torch.errors import ParameterError
from grr_torch.pieces import one_thread
from grr_torch.projection.project import point_columns
from grr_torch.spaces.configuration import difference, distance

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap

# vertices at which a path may enter the roadmap: of so many nearest ones, and if none of them serves, of so many
_ENTRIES = (8, 64, 512)
# times that an edge which turns out to be blocked is gone round
_DETOURS = 20
# waypoints nearer to each other [rad or m] are one
_SAME = 1e-9
# the shortest step that may be asked for [rad]
_LEAST_STEP = 1e-3


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
    """

    points: Tensor
    configurations: Tensor
    times: Tensor
    vertices: Tensor
    max_deviation: float
    mean_deviation: float
    reason: str = ""

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
        return float(self.points.diff(dim=0).norm(dim=1).sum()) if self.found else math.nan

    @property
    def joint_length(self) -> float:
        """Sum of D_q between neighbouring waypoints [rad]."""
        return float(self.configurations.diff(dim=0).norm(dim=1).sum()) if self.found else math.nan


class _Refusal(NamedTuple):
    """Why a start or goal does not serve."""

    reason: str


class Planner:
    """Plans paths over a roadmap. `Roadmap.plan` is what to call."""

    def __init__(self, roadmap: Roadmap, step: float = 0.05) -> None:
        """Makes a planner.

        Args:
            roadmap: The roadmap.
            step: D_q that neighbouring waypoints stay below [rad].

        Raises:
            ParameterError: The step is out of its range, or no vertex is resolved.
        """
        epsilon = 0.05 * math.sqrt(roadmap.robot.n)
        if not _LEAST_STEP <= step <= epsilon:
            raise ParameterError("step", step, f"{_LEAST_STEP:g} to {epsilon:.3g} rad, the ε of the continuity check")
        self.roadmap, self.robot, self.task = roadmap, roadmap.robot, roadmap.task
        self.ways = WayFinder(roadmap.solver, step)

    def end(self, name: str, point: Tensor | None, configuration: Tensor | None) -> Stops | _Refusal:
        """Where a path starts or ends, or why it cannot.

        Raises:
            ParameterError: Not exactly one of point and configuration is given, its shape is not (width,) or (n,), or
                it is not finite.
        """
        robot = self.robot
        if (point is None) == (configuration is None):
            given = "neither" if point is None else "both"
            raise ParameterError(name, f"{given} of a point and a configuration", "one of them")
        if point is not None:
            column = point_columns(robot, self.task, point)
            if point.ndim != 1:
                raise ParameterError(f"{name} shape", tuple(point.shape), f"({self.task.width},): one point")
            solution = self.roadmap.solve(column.T)
            if not bool(solution.valid[0]):
                return _Refusal(f"the {name} cannot be solved: {solution.status[0]}")
            return Stops(column.T, solution.configurations, torch.tensor([-1]))
        assert configuration is not None
        q = robot.columns(configuration).T
        if configuration.ndim != 1:
            raise ParameterError(f"{name} configuration shape", tuple(configuration.shape), f"({robot.n},)")
        if not bool(q.isfinite().all()):
            raise ParameterError(f"{name} configuration", "NaN or infinite values", "finite values")
        if not bool(robot.within_limits(q)):
            return _Refusal(f"the {name} configuration is beyond joint limits")
        if bool(robot.in_self_collision(q)):
            return _Refusal(f"the {name} configuration is in self-collision")
        position, _ = robot.forward_kinematics(q)
        return Stops(position[:, : self.task.width], q, torch.tensor([-1]))

    def ways_between(self, start: Stops, goal: Stops, smooth: bool) -> list[Way] | _Refusal:
        """Ways from start to goal, one after the other, or why there are none."""
        near = (start.points - goal.points).norm() <= self.roadmap.solver.radius
        direct = self.ways.on_map(start, goal)[0] if bool(near) else None
        if direct is not None:
            return [direct]
        open_edges = self.roadmap.connected.clone()
        for _ in range(_DETOURS):
            stops = self._route(start, goal, Routes(self.roadmap, open_edges))
            if isinstance(stops, _Refusal):
                return stops
            found = self._connect(stops.take(slice(None, -1)), stops.take(slice(1, None)))
            ways = [way for way in found if way is not None]
            if len(ways) == len(found):
                return shorten(self.ways, ways) if smooth else ways
            for k in (k for k, way in enumerate(found) if way is None):
                open_edges &= ~self._edge(stops.vertices[k : k + 2])
        return _Refusal(f"more than {_DETOURS} times, edges of the path were in self-collision between their waypoints")

    def _edge(self, ends: Tensor) -> Tensor:
        """Which of the edges joins two vertices: (E,) bool."""
        edges = self.roadmap.edges
        return (edges == ends).all(1) | (edges == ends.flip(0)).all(1)

    def _route(self, start: Stops, goal: Stops, routes: Routes) -> Stops | _Refusal:
        """Start, vertices and goal of the shortest way that enters and leaves the map at near vertices."""
        reason = ""
        for count in _ENTRIES:
            (entries, to_entries), (exits, to_exits) = (self._entries(end, count) for end in (start, goal))
            for name, vertices in (("start", entries), ("goal", exits)):
                if not len(vertices):
                    reason = f"no vertex of the roadmap can be gone to from the {name} without a jump"
            if not len(entries) or not len(exits):
                continue
            between = np.stack([routes.towards(int(vertex))[0][entries] for vertex in exits], axis=1)
            total = to_entries[:, None] + between + to_exits
            if np.isfinite(total).any():
                first, last = np.unravel_index(total.argmin(), total.shape)
                path = torch.tensor(routes.between(int(entries[first]), int(exits[last])))
                return Stops.join(start, self._vertices(path), goal)
            parts = [np.count_nonzero(routes.part == routes.part[ends[0]]) for ends in (entries, exits)]
            reason = (
                f"start and goal lie in parts of the roadmap that no edge connects, of {parts[0]} and {parts[1]} vertices"
            )
        return _Refusal(reason)

    def _entries(self, end: Stops, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Of the vertices nearest to an end by D_q, those that can be gone to, and how far they are [rad]."""
        solver = self.roadmap.solver
        q = self.roadmap.configurations[solver.vertices]
        apart = distance(q, end.configurations.cpu(), self.robot.continuous.cpu())
        vertices = solver.vertices[apart.argsort(stable=True)[:count]]
        found = self._connect(end.take(torch.zeros(len(vertices), dtype=torch.long)), self._vertices(vertices))
        there = [k for k, way in enumerate(found) if way is not None]
        lengths = [way.length(self.robot.continuous) for way in found if way is not None]
        return vertices[there].numpy(), np.array(lengths)

    def _vertices(self, vertices: Tensor) -> Stops:
        robot = self.robot
        points, q = self.roadmap.points[vertices], self.roadmap.configurations[vertices]
        return Stops(points.to(robot.lower), q.to(robot.lower), vertices)

    def _connect(self, starts: Stops, ends: Stops) -> list[Way | None]:
        """Ways by the map; where there is none, by the lines; and for what is off the map, through joint space."""
        found = self.ways.on_map(starts, ends)
        joins = (starts.vertices < 0) | (ends.vertices < 0)
        for method, allowed in (
            (self.ways.on_lines, torch.ones_like(joins)),
            (self.ways.through_joint_space, joins),
        ):
            rest = [k for k, way in enumerate(found) if way is None and bool(allowed[k])]
            if rest:
                rows = torch.tensor(rest)
                for k, way in zip(rest, method(starts.take(rows), ends.take(rows)), strict=True):
                    found[k] = way
        return found


def plan(
    roadmap: Roadmap,
    start: Tensor | None,
    goal: Tensor | None,
    *,
    start_configuration: Tensor | None = None,
    goal_configuration: Tensor | None = None,
    smooth: bool = False,
    step: float = 0.05,
    velocity_limits: float | Tensor | None = None,
    acceleration_limits: float | Tensor | None = None,
) -> Path:
    """`Roadmap.plan`."""
    robot = roadmap.robot
    like = robot.lower.cpu()
    speeds = usual_speeds(robot.velocity_limits.cpu())
    if velocity_limits is not None:
        speeds = per_joint("velocity_limits", velocity_limits, like)
    if acceleration_limits is not None:
        acceleration_limits = per_joint("acceleration_limits", acceleration_limits, like)
    planner = Planner(roadmap, step)
    with torch.no_grad(), one_thread():
        ends = planner.end("start", start, start_configuration), planner.end("goal", goal, goal_configuration)
        ways: list[Way] | _Refusal | None = None
        for end in ends:
            if isinstance(end, _Refusal):
                return _no_path(roadmap, end.reason)
        first, last = ends
        assert isinstance(first, Stops)
        assert isinstance(last, Stops)
        ways = planner.ways_between(first, last, smooth)
        if isinstance(ways, _Refusal):
            return _no_path(roadmap, ways.reason)
        points, q = _joined(ways, robot.continuous)
        largest, mean = _deviation(roadmap, ways)
        times = retime(q.cpu(), speeds, acceleration_limits)
        return Path(points.cpu(), q.cpu(), times, _passed(roadmap, ways), largest, mean)


def _no_path(roadmap: Roadmap, reason: str) -> Path:
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
    found = [torch.zeros(1, dtype=robot.dtype)]
    for way in ways:
        if way.straight:
            q = torch.cat([way.configurations, substeps(way.configurations, robot.continuous).flatten(0, 1)])
            position = robot.forward_kinematics(q)[0][:, :d]
            start, line = way.points[0, :d], way.points[-1, :d] - way.points[0, :d]
            share = ((position - start) @ line / line.square().sum().clamp_min(1e-24)).clamp(0.0, 1.0)
            found.append((position - start - share[:, None] * line).norm(dim=1).cpu())
    every = torch.cat(found)
    return float(every.max()), float(every.mean())


def _passed(roadmap: Roadmap, ways: list[Way]) -> Tensor:
    """Vertices at which ways begin or end, in order."""
    ends = torch.stack([ways[0].configurations[0], *(way.configurations[-1] for way in ways)]).cpu()
    points = torch.stack([ways[0].points[0], *(way.points[-1] for way in ways)]).cpu()
    nearest = roadmap.solver.nearest(points)[1][:, 0]
    there = distance(roadmap.configurations[nearest], ends, roadmap.robot.continuous.cpu()) <= _SAME
    return torch.unique_consecutive(nearest[there & ((roadmap.points[nearest] - points).norm(dim=1) <= _SAME)])
