"""The options of a build: what they may be, and what of them determines its roadmap."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch

from grr_torch.errors import ParameterError, UnknownNameError, check_seed, check_whole
from grr_torch.resolution.auto_seeds import check_candidates
from grr_torch.resolution.checkpoint import digest
from grr_torch.resolution.expand import check_neighbours
from grr_torch.resolution.objectives import check_objectives
from grr_torch.resolution.problem import Problem
from grr_torch.resolution.roadmap_file import robot_to_json
from grr_torch.resolution.seeds import check_seeds
from grr_torch.robots.robot import Robot
from grr_torch.spaces.graph import TaskGraph, check_bounds, check_count
from grr_torch.spaces.product import rotating
from grr_torch.spaces.rotations import check_rotations
from grr_torch.spaces.task import TaskSpace
from grr_torch.tensor_file import tensor_hash
from grr_torch.version import __version__

# each method, and which arguments are none of it
METHODS = {"expansion": ("samples", "nearest"), "random": ("seeds", "neighbours", "candidates")}
# of what stages keep, and of how they come to it
CHECKPOINT_VERSION = 10
_MOST_STARTS = 100_000


def check_options(robot: Robot, task: TaskSpace, options: Mapping[str, Any]) -> dict[str, int]:
    """Checks what `build` is asked for, as far as no grid has to be laid for it.

    Args:
        robot: The robot.
        task: The task space.
        options: Arguments of `build` by their names; of the problem's (points, bounds, rotations, seeds), those there
            are.

    Returns:
        The whole numbers that are given, as such: numpy's are none that JSON knows.

    Raises:
        ParameterError: A parameter is out of its range, or does not go with another.
        UnknownNameError: No such method or objective.
        SeedError: Seeds are given, and none can be used.
    """
    numbers = {"seed": check_seed(options["seed"])}
    objectives, reachability, method = (options[name] for name in ("objectives", "reachability", "method"))
    check_objectives(robot, objectives)
    if objectives and not options["refine"]:
        raise ParameterError("objectives", tuple(objectives), "none without refinement, which serves them")
    numbers["reachability"] = check_whole("reachability", reachability, 0, _MOST_STARTS)
    max_slope = options["max_slope"]
    if max_slope is not None and not max_slope > 0.0:
        raise ParameterError("max_slope", max_slope, "above 0, in rad/m; inf: no bound")
    if method not in METHODS:
        raise UnknownNameError("method", method, tuple(METHODS))
    for name in METHODS[method]:
        if (given := options.get(name)) is not None:
            told = given if isinstance(given, str | int) else "some"
            raise ParameterError(name, told, f'none with method "{method}"')
    seeds, candidates = options.get("seeds"), options["candidates"]
    if candidates is not None:
        if seeds is not None and not isinstance(seeds, str):
            raise ParameterError("candidates", candidates, 'none with seeds that are given; they are for seeds "auto"')
        numbers["candidates"] = check_candidates(candidates)
    for name in ("samples", "nearest"):
        if options[name] is not None:
            numbers[name] = check_whole(name, options[name], 1)
    if options["neighbours"] is not None:
        numbers["neighbours"] = check_neighbours(task, options["neighbours"])
    _check_problem(robot, task, *(options.get(name) for name in ("points", "bounds", "rotations", "seeds")))
    return numbers


def _check_problem(robot: Robot, task: TaskSpace, points: Any, bounds: Any, rotations: Any, seeds: Any) -> None:
    if points is not None and not isinstance(points, TaskGraph):
        check_count(points)
    if bounds is not None:
        check_bounds(bounds)
    if rotations is not None:
        rotating(task, rotations)
        check_rotations(rotations)
    if seeds is not None and not isinstance(seeds, str):
        check_seeds(robot, seeds)


def bounded(problem: Problem, max_slope: float | None, method: str) -> Problem:
    """A problem with the bound of slopes of a build: what is given, or for an expansion the problem's own."""
    if max_slope is None and method == "expansion":
        return problem
    return problem._replace(max_slope=None if max_slope == math.inf else max_slope, connectivity=None)


def describe_build(robot: Robot, problem: Problem, options: Mapping[str, Any]) -> dict[str, Any]:
    """All that determines a build, by name, as JSON: what is long, by its SHA-256."""
    arm = {
        name: value for name, value in robot_to_json(robot).items() if name not in ("urdf_directory", "package_dirs")
    }
    seeds = problem.seeds if isinstance(problem.seeds, str) else tensor_hash(check_seeds(robot, problem.seeds).cpu())
    graph = {"points": tensor_hash(problem.graph.points), "edges": tensor_hash(problem.graph.edges)}
    packages = {
        "grr-torch": __version__,
        "checkpoint": CHECKPOINT_VERSION,
        "torch": torch.__version__,
        "device": robot.device.type,
    }
    what = {"robot": robot.name, "arm": digest(arm), "task": problem.task.to_json(), **graph, "seeds": seeds}
    return {**packages, **what, **options}
