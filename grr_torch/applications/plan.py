"""Paths over a roadmap (Section IV-E of the paper, "Task-space path planning")."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from grr_torch.applications.path import Path, no_path, path_of
from grr_torch.applications.retime import per_joint, usual_speeds
from grr_torch.applications.routes import Routes
from grr_torch.applications.shorten import shorten
from grr_torch.applications.ways import Stops, Way, WayFinder
from grr_torch.errors import ParameterError
from grr_torch.pieces import one_thread
from grr_torch.projection.continuity import usual_bounds
from grr_torch.projection.project import point_columns, tool_points
from grr_torch.spaces.configuration import distance

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap

# vertices at which a path may enter the roadmap: of so many nearest ones, and if none of them serves, of so many
_ENTRIES = (8, 64, 512)
# times that an edge which turns out to be blocked is gone round
_DETOURS = 20
# the shortest step that may be asked for [rad]: what the projection leaves open is not small beside shorter ones
_LEAST_STEP = 5e-3


class _Refusal(NamedTuple):
    """Why there is no path."""

    reason: str


class _End(NamedTuple):
    """Where a path starts or ends.

    Attributes:
        stop: The place.
        measured: Whether its configuration was given, and so may be off the map.
    """

    stop: Stops
    measured: bool


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
        _, epsilon = usual_bounds(roadmap.robot)
        if not _LEAST_STEP <= step <= epsilon:
            raise ParameterError("step", step, f"{_LEAST_STEP:g} to {epsilon:.3g} rad, the ε of the continuity check")
        self.roadmap, self.robot, self.task = roadmap, roadmap.robot, roadmap.task
        self.ways = WayFinder(roadmap.solver, step)

    def end(self, name: str, point: Tensor | None, configuration: Tensor | None) -> _End | _Refusal:
        """Where a path starts or ends, or why it cannot.

        Raises:
            ParameterError: Not exactly one of point and configuration is given, its shape is not (width,) or (n,), or
                it is not finite.
        """
        robot = self.robot
        if (point is None) == (configuration is None):
            given = "neither" if point is None else "both"
            valid = f"{name} or {name}_configuration"
            raise ParameterError(name, f"{given} of a point and a configuration", valid)
        if point is not None:
            column = point_columns(robot, self.task, point)
            if point.ndim != 1:
                raise ParameterError(f"{name} shape", tuple(point.shape), f"({self.task.width},): one point")
            solution = self.roadmap.solve(column.T)
            if not bool(solution.valid[0]):
                return _Refusal(f"the {name} cannot be solved: {solution.status[0]}")
            return _End(Stops(column.T, solution.configurations, torch.tensor([-1])), measured=False)
        assert configuration is not None
        q = robot.columns(configuration).T
        if configuration.ndim != 1:
            raise ParameterError(f"{name} configuration shape", tuple(configuration.shape), f"({robot.n},)")
        if not bool(q.isfinite().all()):
            raise ParameterError(f"{name} configuration", "NaN or infinite values", "finite values")
        if not bool(robot.within_limits(q)):
            outside = (q < robot.lower) | (q > robot.upper)
            joints = ", ".join(robot.joint_names[joint] for joint in outside[0].nonzero()[:, 0].tolist())
            return _Refusal(f"the {name} configuration is beyond joint limits ({joints})")
        if bool(robot.in_self_collision(q)):
            return _Refusal(f"the {name} configuration is in self-collision")
        return _End(Stops(tool_points(robot, self.task, q), q, torch.tensor([-1])), measured=True)

    def ways_between(self, start: _End, goal: _End, smooth: bool) -> list[Way] | _Refusal:
        """Ways from start to goal, one after the other, or why there are none."""
        near = self.task.distance(start.stop.points, goal.stop.points) <= self.roadmap.solver.radius
        direct = self.ways.on_map(start.stop, goal.stop)[0] if bool(near) else None
        if direct is not None:
            return [direct]
        open_edges = self.roadmap.connected.clone()
        for detour in range(_DETOURS):
            routes = Routes(self.roadmap, open_edges) if detour else self.roadmap.routes
            stops = self._route(start, goal, routes)
            if isinstance(stops, _Refusal):
                return stops
            off_map = torch.zeros(len(stops) - 1, dtype=torch.bool)
            off_map[0], off_map[-1] = start.measured, goal.measured
            found = self._connect(stops.take(slice(None, -1)), stops.take(slice(1, None)), off_map)
            ways = [way for way in found if way is not None]
            if len(ways) == len(found):
                return shorten(self.ways, ways) if smooth else ways
            for k in (k for k, way in enumerate(found) if way is None):
                open_edges &= ~self._edge(stops.vertices[k : k + 2])
        return _Refusal(f"after {_DETOURS} detours, edges of the path are still in self-collision between waypoints")

    def _edge(self, ends: Tensor) -> Tensor:
        """Which of the edges joins two vertices: (E,) bool."""
        edges = self.roadmap.edges
        return (edges == ends).all(1) | (edges == ends.flip(0)).all(1)

    def _route(self, start: _End, goal: _End, routes: Routes) -> Stops | _Refusal:
        """Start, vertices and goal of the shortest way that enters and leaves the map at near vertices."""
        nothing = np.empty(0, dtype=np.int64), np.empty(0)
        near = [nothing, nothing]
        reason = ""
        for count in _ENTRIES:
            for k, end in enumerate((start, goal)):
                if end.measured or not len(near[k][0]):
                    near[k] = self._entries(end, count)
            (entries, to_entries), (exits, to_exits) = near
            if not len(entries) or not len(exits):
                name = "goal" if len(entries) else "start"
                reason = f"no vertex of the roadmap can be gone to from the {name} without a jump"
                continue
            between = np.stack([routes.towards(int(vertex))[0][entries] for vertex in exits], axis=1)
            total = to_entries[:, None] + between + to_exits
            if np.isfinite(total).any():
                first, last = np.unravel_index(total.argmin(), total.shape)
                path = torch.tensor(routes.between(int(entries[first]), int(exits[last])))
                return Stops.join(start.stop, self._vertices(path), goal.stop)
            sizes = [np.count_nonzero(routes.part == routes.part[ends[0]]) for ends in (entries, exits)]
            reason = (
                "start and goal lie in parts of the roadmap that no edge connects, "
                f"of {sizes[0]:,} and {sizes[1]:,} vertices"
            )
        return _Refusal(reason)

    def _entries(self, end: _End, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Of the vertices nearest to an end by D_q, those that can be gone to, and how far they are [rad]."""
        solver = self.roadmap.solver
        q = self.roadmap.configurations[solver.vertices]
        apart = distance(q, end.stop.configurations.cpu(), self.robot.continuous.cpu())
        vertices = solver.vertices[apart.argsort(stable=True)[:count]]
        starts = end.stop.take(torch.zeros(len(vertices), dtype=torch.long))
        found = self._connect(starts, self._vertices(vertices), torch.full((len(vertices),), end.measured))
        there = [k for k, way in enumerate(found) if way is not None]
        lengths = [way.length(self.robot.continuous) for way in found if way is not None]
        return vertices[there].numpy(), np.array(lengths)

    def _vertices(self, vertices: Tensor) -> Stops:
        robot = self.robot
        points, q = self.roadmap.points[vertices], self.roadmap.configurations[vertices]
        return Stops(points.to(robot.lower), q.to(robot.lower), vertices)

    def _connect(self, starts: Stops, ends: Stops, off_map: Tensor) -> list[Way | None]:
        """Ways by the map; where there is none, by the lines; and for those off the map (L,), through joint space."""
        found = self.ways.on_map(starts, ends)
        for method, allowed in (
            (self.ways.on_lines, torch.ones_like(off_map)),
            (self.ways.through_joint_space, off_map),
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
        first, last = ends
        if isinstance(first, _Refusal):
            return no_path(roadmap, first.reason)
        if isinstance(last, _Refusal):
            return no_path(roadmap, last.reason)
        ways = planner.ways_between(first, last, smooth)
        if isinstance(ways, _Refusal):
            return no_path(roadmap, ways.reason)
        return path_of(roadmap, ways, speeds, acceleration_limits)
