"""What a roadmap is built for: task, graph and seeds, from what is given and the robot's preset."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import torch

from grr_torch.errors import GrrWarning, ParameterError, UnknownNameError, check_kind
from grr_torch.resolution.reachability import reach, reach_box, stays_in_plane, stays_upright, within_reach
from grr_torch.resolution.seeds import SeedsLike
from grr_torch.robots.presets import Problem as Preset
from grr_torch.robots.robot import Robot
from grr_torch.spaces.graph import Bounds, TaskGraph, check_bounds, staggered_grid
from grr_torch.spaces.product import ProductGraph, product_graph
from grr_torch.spaces.task import FixedRotation, Position, TaskSpace, make_task

# vertices of the grid where neither they nor a preset say how many, by its axes
_POINTS = {2: 1000, 3: 3000}


class Problem(NamedTuple):
    """What a roadmap is built for.

    Attributes:
        task: The task space.
        graph: Its task graph.
        seeds: A table of configurations, or "auto".
        max_slope: D_q / D_p above which edges are left out unless told otherwise [rad/m]; None: no bound.
        connectivity: Share of the edges for which refinement raises that bound, if fewer keep it; None: for none.
    """

    task: TaskSpace
    graph: TaskGraph
    seeds: SeedsLike | str
    max_slope: float | None = None
    connectivity: float | None = None


def pose_problem(
    robot: Robot,
    task: TaskSpace | str | None = None,
    points: int | TaskGraph | None = None,
    bounds: Bounds | None = None,
    seeds: SeedsLike | str | None = None,
    rotations: int | None = None,
) -> Problem:
    """Task, graph and seeds, with what was not given taken from the robot's preset; as `build` takes them.

    Without a preset the task is position, the bounds hold what the arm reaches, and seeds are found.

    Raises:
        UnknownNameError: No such task or seeds.
        ParameterError: Something is missing, does not fit the robot, or lies beyond its reach.
    """
    check_kind("robot", robot, Robot, "load_robot('kinova')")
    problem = _complete(robot, task, points, bounds, seeds, rotations)
    check_task(robot, problem.task)
    own_graph = isinstance(points, TaskGraph)
    if not own_graph and problem.task.dimension == 2 and not stays_in_plane(robot):
        text = f"bounds of x and y leave z free, and {robot.name} moves in space: six bounds give a map in space"
        warnings.warn(text, GrrWarning, stacklevel=3)
    _check_reach(robot, problem.task, problem.graph, warn=not own_graph)
    return problem


def complete_task(
    robot: Robot,
    kind: str | None,
    axes: int | None,
    *,
    rpy: Sequence[float] | None = None,
    axis: Sequence[float] | None = None,
) -> TaskSpace:
    """A task space, with what is not given taken from the robot's preset.

    Args:
        robot: The robot.
        kind: The kind of task; by default the preset's, but fixed rotation where one is given, and position without a
            preset.
        axes: Of the grid, 2 or 3; by default as many as the preset has bounds for, without one 2 for arms whose tool
            stays in a plane.
        rpy: As `make_task` takes it; by default the preset's, if that has as many axes.
        axis: As `make_task` takes it.

    Raises:
        UnknownNameError: No such kind, or none that the preset says the bounds of.
        ParameterError: What is said excludes itself.
    """
    preset = robot.preset
    if kind is None:
        without = preset.default_task if preset else Position.kind
        kind = without if rpy is None else FixedRotation.kind
    problem = preset.problems.get(kind) if preset else None
    if axes is None and problem is None:
        if preset is not None:
            raise UnknownNameError("task", kind, tuple(preset.problems))
        axes = 2 if stays_in_plane(robot) else 3
    axes = axes or (len(problem.bounds) if problem else 0)
    if rpy is None and problem is not None and len(problem.bounds) == axes:
        rpy = problem.rotation
    return make_task(kind, axes, rpy, axis)


def _turned(task: TaskSpace, positions: TaskGraph, rotations: int | None, problem: Preset | None) -> TaskGraph:
    """The product of positions and rotations."""
    if rotations is None and problem is not None:
        rotations = problem.rotations
    if rotations is None:
        valid = f"how many rotations the grid of the task '{task.kind}' has (--rotations)"
        raise ParameterError("rotations", "nothing", valid)
    if positions.points.shape[1] != task.dimension:
        given = f"{positions.points.shape[1]} coordinates"
        raise ParameterError("points", given, f"{task.dimension}: positions, or a product_graph")
    return product_graph(task, positions, rotations)


def check_task(robot: Robot, task: TaskSpace) -> None:
    """Checks that a robot can be asked for this task.

    Raises:
        ParameterError: The task takes more joints than there are, it is in SE(2) and the robot leaves the plane, or it
            is in space and the robot does not.
    """
    given = f"{task.kind} in {task.name}"
    if task.dimension == 2 and task.constraints > 2 and not stays_upright(robot):
        raise ParameterError("task", given, f"SE(3) for {robot.name}, whose tool leaves the plane")
    if task.dimension == 3 and stays_in_plane(robot):
        raise ParameterError("task", given, f"two axes for {robot.name}, whose tool stays in a plane")
    if robot.n < 2:
        raise ParameterError("robot", f"{robot.name}, which has 1 joint", "one with 2 joints or more")
    if robot.n < task.constraints:
        asked = f"{given}, which fixes {task.constraints} coordinates"
        raise ParameterError("task", asked, f"one that fixes no more than {robot.name} has joints, {robot.n}")


def _check_reach(robot: Robot, task: TaskSpace, graph: TaskGraph, *, warn: bool) -> None:
    """Warns, if asked to, where next to nothing of a graph lies within the arm's reach.

    Raises:
        ParameterError: Nothing does.
    """
    inside = int(within_reach(robot, task, graph.points).sum())
    centre, radius = reach(robot)
    place = ", ".join(f"{value:.3f}" for value in centre.tolist())
    if inside == 0:
        raise ParameterError("bounds", "no point within reach", f"points within {radius:.3f} m of ({place})")
    if warn and inside < 0.02 * len(graph.points):
        text = f"only {inside} of {len(graph.points)} points lie within {radius:.3f} m of ({place}), the arm's reach"
        warnings.warn(f"{text}: are the bounds in metres?", GrrWarning, stacklevel=4)


def _complete(
    robot: Robot,
    task: TaskSpace | str | None,
    points: int | TaskGraph | None,
    bounds: Bounds | None,
    seeds: SeedsLike | str | None,
    rotations: int | None,
) -> Problem:
    """Task, graph and seeds, with what was not given taken from the robot's preset."""
    preset = robot.preset
    kind = task.kind if isinstance(task, TaskSpace) else task or (preset.default_task if preset else None)
    problem = preset.problems.get(kind or "") if preset else None
    if isinstance(task, str) and preset and problem is None and bounds is None:
        raise UnknownNameError("task", task, tuple(preset.problems))
    for name, given, kind_of in (("bounds", bounds, TaskGraph), ("rotations", rotations, ProductGraph)):
        if given is not None and isinstance(points, kind_of):
            raise ParameterError(name, given, f"none with a graph given as points, which has its own {name}")
    graph = points if isinstance(points, TaskGraph) else _grid(robot, task, points, bounds, problem)
    # the preset's seeds and bound are those of all its joints
    whole = problem is not None and all(len(seed) == robot.n for seed in problem.seeds)
    if seeds is None:
        seeds = problem.seeds if problem is not None and whole else "auto"
    if isinstance(seeds, str) and seeds != "auto":
        raise UnknownNameError("seeds", seeds, ("auto",), " Or a table of configurations.")
    if not isinstance(task, TaskSpace):
        positions = graph.positions if isinstance(graph, ProductGraph) else graph
        task = complete_task(robot, kind, positions.points.shape[1])
    if not isinstance(graph, ProductGraph) and (rotations is not None or task.rotations is not None):
        graph = _turned(task, graph, rotations, problem)
    if graph.points.shape[1] != task.width:
        raise ParameterError("points", f"{graph.points.shape[1]} coordinates", f"{task.width} for {task.name}")
    if problem is None or not whole or problem.max_slope is None or not _is_grid_of(graph, problem):
        return Problem(task, graph, seeds)
    return Problem(task, graph, seeds, problem.max_slope, problem.connectivity)


def _is_grid_of(graph: TaskGraph, problem: Preset) -> bool:
    """Whether a graph is the preset's grid: slopes depend on how fine a grid is."""
    own = staggered_grid(problem.bounds, problem.points)
    return torch.equal(graph.points, own.points) and torch.equal(graph.edges, own.edges)


def _grid(
    robot: Robot, task: TaskSpace | str | None, points: int | None, bounds: Bounds | None, problem: Preset | None
) -> TaskGraph:
    """The staggered grid of the preset, or over what the arm reaches, as far as it is not given."""
    if bounds is None and problem is not None:
        bounds = problem.bounds
    if bounds is None:
        axes = task.dimension if isinstance(task, TaskSpace) else 2 if stays_in_plane(robot) else 3
        bounds = reach_box(robot, axes)
    if points is None:
        points = problem.points if problem is not None else _POINTS[len(check_bounds(bounds))]
    return staggered_grid(bounds, points)
