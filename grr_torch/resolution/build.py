"""Building a roadmap: seeds, expansion, continuity of every edge, reachability."""

from __future__ import annotations

import time
import warnings
from dataclasses import asdict, replace
from typing import Any

import torch
from torch import Tensor

from grr_torch.errors import GrrWarning, ParameterError, UnknownNameError, check_seed
from grr_torch.progress import Progress, silent
from grr_torch.projection.continuity import is_continuous
from grr_torch.projection.project import DEFAULT_TOLERANCES, Tolerances
from grr_torch.resolution.auto_seeds import find_seeds
from grr_torch.resolution.expand import Expansion, default_neighbours, expand
from grr_torch.resolution.random_grr import random_grr
from grr_torch.resolution.reachability import measure_reachability, reach, within_reach
from grr_torch.resolution.refine import refine as refine_roadmap
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.resolution.seeds import SeedsLike
from grr_torch.robots.robot import Robot
from grr_torch.spaces.graph import Bounds, TaskGraph, staggered_grid
from grr_torch.spaces.task import TaskSpace, make_task

# edges whose continuity is checked together
_EDGES_AT_ONCE = 16384
_MOST_STARTS = 100_000


def build(
    robot: Robot,
    task: TaskSpace | str | None = None,
    *,
    points: int | TaskGraph | None = None,
    bounds: Bounds | None = None,
    seeds: SeedsLike | str | None = None,
    method: str = "expansion",
    neighbours: int | None = None,
    samples: int = 100,
    refine: bool = True,
    reachability: int = 0,
    seed: int = 0,
    tolerances: Tolerances = DEFAULT_TOLERANCES,
    progress: Progress = silent,
) -> Roadmap:
    """Builds a roadmap with Expansion-GRR, or with the baseline Random-GRR, and refines it.

    Whatever is not given is taken from the preset of a bundled robot; without one, task, bounds and points must be
    given, and seeds are found.

    Args:
        robot: The robot.
        task: The task space, or the kind of one that the preset has.
        points: How many vertices a staggered grid over `bounds` is asked for, or a task graph.
        bounds: (low, high) of each axis of the grid [m].
        seeds: (S, n) configurations that the expansion starts from, or "auto": they are found.
        method: "expansion", or "random": random configurations at every vertex and a constraint solver.
        neighbours: How many of the nearest vertices are averaged over; 24 in the plane and 64 in space by default.
        samples: Random configurations of a vertex, for the method "random".
        refine: Whether the roadmap is repaired, relaxed and certified after the expansion.
        reachability: Random starts for each unresolved vertex, to tell which are reachable; 0: not measured.
        seed: Of all random draws. The same inputs give the same tensors.
        tolerances: When a configuration counts as being at a point.
        progress: Told what is being done and how far it is.

    Returns:
        The roadmap; its `build_seconds` leave reachability out.

    Raises:
        ParameterError: Something is missing or out of its range, or no point lies within the arm's reach.
        SeedError: No seed can be used.
    """
    task, graph, given = _problem(robot, task, points, bounds, seeds)
    check_task(robot, task)
    _check_reach(robot, task, graph)
    check_seed(seed)
    if not 0 <= reachability <= _MOST_STARTS:
        raise ParameterError("reachability", reachability, f"0 to {_MOST_STARTS:,} random starts a vertex")
    if method not in ("expansion", "random"):
        raise UnknownNameError("method", method, ("expansion", "random"))
    begin = time.perf_counter()
    if method == "random":
        found = random_grr(robot, task, graph, samples=samples, seed=seed, tolerances=tolerances, progress=progress)
        expansion, connected = Expansion(found.configurations, found.wave), found.connected
        chosen: dict[str, Any] = {"samples": samples, "seeds": []}
    else:
        table = (
            find_seeds(robot, task, graph, seed=seed, tolerances=tolerances, progress=progress)
            if isinstance(given, str)
            else given
        )
        expansion = expand(robot, task, graph, table, neighbours=neighbours, tolerances=tolerances, progress=progress)
        connected = _connected(robot, task, graph, expansion.configurations, expansion.resolved, tolerances, progress)
        chosen = {
            "neighbours": default_neighbours(task) if neighbours is None else neighbours,
            "seeds": torch.as_tensor(table, dtype=torch.float64).tolist(),
        }
    seconds = time.perf_counter() - begin
    roadmap = Roadmap(
        robot=robot,
        task=task,
        points=graph.points,
        configurations=expansion.configurations.cpu(),
        resolved=expansion.resolved.cpu(),
        edges=graph.edges,
        connected=connected.cpu(),
        wave=expansion.wave.cpu(),
        reachable=None,
        parameters={
            "method": method,
            **chosen,
            "points": len(graph.points),
            "bounds": torch.stack([graph.points.amin(0), graph.points.amax(0)], dim=1).tolist(),
            "margin": robot.margin,
            "seed": seed,
            "reachability": reachability,
            "tolerances": asdict(tolerances),
        },
        build_seconds=seconds,
    )
    if refine:
        roadmap = refine_roadmap(roadmap, seed=seed, progress=progress)
    if not reachability:
        return roadmap
    left = ~roadmap.resolved
    reachable = roadmap.resolved.clone()
    reachable[left] = measure_reachability(
        robot, task, graph.points[left], reachability, seed=seed, tolerances=tolerances, progress=progress
    )
    return replace(roadmap, reachable=reachable)


def check_task(robot: Robot, task: TaskSpace) -> None:
    """Checks that a robot can be asked for this task.

    Raises:
        ParameterError: An SE(2) task for a robot that leaves the plane, or a task in space for one that does not.
    """
    position, rotation = robot.forward_kinematics(robot.sample(64, torch.Generator().manual_seed(0)))
    upright = bool(((rotation[:, 2, 2].abs() - 1.0).abs() < 1e-5).all())
    flat = upright and bool((position[:, 2] - position[0, 2]).abs().max() < 1e-5)
    given = f"{task.kind} in {task.name}"
    if task.dimension == 2 and task.constraints > 2 and not upright:
        raise ParameterError("task", given, f"SE(3) for {robot.name}, whose tool leaves the plane")
    if task.dimension == 3 and flat:
        raise ParameterError("task", given, f"two axes for {robot.name}, whose tool stays in a plane")


def _check_reach(robot: Robot, task: TaskSpace, graph: TaskGraph) -> None:
    """Warns where next to nothing of a graph lies within the arm's reach.

    Raises:
        ParameterError: Nothing does.
    """
    inside = int(within_reach(robot, task, graph.points).sum())
    centre, radius = reach(robot)
    place = ", ".join(f"{value:.3f}" for value in centre.tolist())
    if inside == 0:
        raise ParameterError("bounds", "no point within reach", f"points within {radius:.3f} m of ({place})")
    if inside < 0.02 * len(graph.points):
        text = f"only {inside} of {len(graph.points)} points lie within {radius:.3f} m of ({place}), the arm's reach"
        warnings.warn(f"{text}: are the bounds in metres?", GrrWarning, stacklevel=3)


def _problem(
    robot: Robot,
    task: TaskSpace | str | None,
    points: int | TaskGraph | None,
    bounds: Bounds | None,
    seeds: SeedsLike | str | None,
) -> tuple[TaskSpace, TaskGraph, SeedsLike | str]:
    """Task, graph and seeds, with what was not given taken from the robot's preset."""
    preset = robot.preset
    kind = task.kind if isinstance(task, TaskSpace) else task or (preset.default_task if preset else None)
    problem = preset.problems.get(kind or "") if preset else None
    if isinstance(task, str) and preset and problem is None and bounds is None:
        raise UnknownNameError("task", task, tuple(preset.problems))
    if bounds is None and problem is not None:
        bounds = problem.bounds
    if points is None and problem is not None:
        points = problem.points
    if points is None or (bounds is None and not isinstance(points, TaskGraph)):
        missing = "bounds" if points is not None else "points" if bounds is not None else "points and bounds"
        raise ParameterError(missing, "nothing", f"they must be given for {robot.name}, which has no preset for this")
    graph = points if isinstance(points, TaskGraph) else staggered_grid(bounds or (), points)
    if seeds is None:
        seeds = "auto" if problem is None else problem.seeds
    if isinstance(seeds, str) and seeds != "auto":
        raise UnknownNameError("seeds", seeds, ("auto",), " Or a table of configurations.")
    if not isinstance(task, TaskSpace):
        if kind is None:
            raise ParameterError("task", "not given", "'position' or 'fixed-rotation'")
        task = make_task(kind, graph.points.shape[1], problem.rotation if problem else None)
    if graph.points.shape[1] != task.width:
        raise ParameterError("points", f"{graph.points.shape[1]} coordinates", f"{task.width} for {task.name}")
    return task, graph, seeds


def check_edges(roadmap: Roadmap, tolerances: Tolerances, progress: Progress = silent) -> Tensor:
    """Which edges of a roadmap are continuous, checked anew: (E,) bool."""
    robot = roadmap.robot
    configurations = roadmap.configurations.to(robot.lower)
    resolved = roadmap.resolved.to(robot.device)
    return _connected(robot, roadmap.task, roadmap.graph, configurations, resolved, tolerances, progress).cpu()


def _connected(
    robot: Robot,
    task: TaskSpace,
    graph: TaskGraph,
    configurations: Tensor,
    resolved: Tensor,
    tolerances: Tolerances,
    progress: Progress,
) -> Tensor:
    """Which edges between resolved vertices are continuous: (E,) bool."""
    edges = graph.edges.to(robot.device)
    points = graph.points.to(configurations)
    connected = torch.zeros(len(edges), dtype=torch.bool, device=robot.device)
    candidates = resolved[edges].all(1).nonzero()[:, 0]
    for start in range(0, len(candidates), _EDGES_AT_ONCE):
        progress("checking edges", start, len(candidates))
        part = candidates[start : start + _EDGES_AT_ONCE]
        a, b = edges[part].T
        connected[part] = is_continuous(
            robot, task, points[a], points[b], configurations[a], configurations[b], tolerances=tolerances
        )
    progress("checking edges", len(candidates), len(candidates))
    return connected
