"""Building a roadmap: seeds, expansion, continuity of every edge, reachability."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict, replace
from typing import Any

import torch

from grr_torch.errors import GrrWarning, ParameterError
from grr_torch.progress import Progress, silent
from grr_torch.projection.continuity import is_continuous
from grr_torch.projection.project import DEFAULT_TOLERANCES, Tolerances
from grr_torch.resolution.auto_seeds import CANDIDATES
from grr_torch.resolution.checkpoint import Checkpoint
from grr_torch.resolution.edges import EdgeCheck
from grr_torch.resolution.memory import require_memory
from grr_torch.resolution.methods import Parts, Work, at_random, by_expansion
from grr_torch.resolution.options import bounded, check_options, describe_build
from grr_torch.resolution.problem import Problem, pose_problem
from grr_torch.resolution.random_grr import SAMPLES
from grr_torch.resolution.reachability import measure_reachability
from grr_torch.resolution.refine import refine as refine_roadmap
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.resolution.roadmap_file import load_roadmap
from grr_torch.resolution.seeds import SeedsLike
from grr_torch.resolution.slopes import left_out_edges, slope_bound, without_steep_edges
from grr_torch.robots.crowding import crowding
from grr_torch.robots.robot import Robot
from grr_torch.spaces.graph import Bounds, TaskGraph
from grr_torch.spaces.task import TaskSpace


def build(
    robot: Robot,
    task: TaskSpace | str | None = None,
    *,
    points: int | TaskGraph | None = None,
    bounds: Bounds | None = None,
    seeds: SeedsLike | str | None = None,
    rotations: int | None = None,
    method: str = "expansion",
    candidates: int | None = None,
    neighbours: int | None = None,
    samples: int | None = None,
    nearest: int | None = None,
    refine: bool = True,
    objectives: Mapping[str, float] | None = None,
    max_slope: float | None = None,
    reachability: int = 0,
    seed: int = 0,
    tolerances: Tolerances = DEFAULT_TOLERANCES,
    checkpoint: str | os.PathLike[str] | None = None,
    resume: bool = False,
    check: EdgeCheck = is_continuous,
    progress: Progress = silent,
) -> Roadmap:
    """Builds a roadmap with Expansion-GRR, or with the baseline Random-GRR, and refines it.

    Whatever is not given is taken from the preset of a bundled robot. Without one, the task is position, the bounds
    hold what the arm reaches, 1,000 points in the plane or 3,000 in space are asked for, and seeds are found.

    Args:
        robot: The robot.
        task: The task space, or the kind of one that the preset has.
        points: How many vertices a staggered grid over `bounds` is asked for, or a task graph.
        bounds: (low, high) of each axis of the grid [m].
        rotations: How many rotations the grid has beside its positions, where rotation varies: yaws on a ring,
            directions on the sphere, or orientations.
        seeds: (S, n) configurations that the expansion starts from, or "auto": they are found.
        candidates: How many sets of seeds are compared, where they are found, 60 by default; more take longer and may
            do better.
        method: "expansion", or "random": random configurations at every vertex and a constraint solver.
        neighbours: How many of the nearest vertices are averaged over; 24 in the plane and 64 in space by default.
            Where rotation varies, the vertices up to so many edges away, 2 by default.
        samples: Random configurations of a vertex, for the method "random"; 100 by default.
        nearest: Of each of these, so many of the nearest ones at a neighbouring vertex are tested for continuity, for
            the method "random"; 6 in the plane and 2 in space by default.
        refine: Whether the roadmap is repaired, relaxed and certified after the expansion.
        objectives: Weights of "clearance", "manipulability" and "limits", which refinement serves besides smoothness;
            at weight 1, 1 % of an objective's mean is worth 1 % of smoothness.
        max_slope: Edges with D_q / D_p above this [rad/m] are not connected, though continuous: there small moves of
            the hand are large ones of the arm. inf: no bound. By default that of the preset's grid, which refinement
            may raise at its end, if it has one and the method is expansion; otherwise none.
        reachability: Random starts for each unresolved vertex, to tell which are reachable; 0: not measured.
        seed: Of all random draws. On the CPU the same inputs give the same tensors.
        tolerances: When a configuration counts as being at a point.
        checkpoint: A folder, absent or empty, in which it is kept what is done, so that a build that was killed can go
            on; the finished roadmap stays in it.
        resume: Whether to go on from what `checkpoint` holds, if it holds anything. The tensors come out as if the
            build had not been interrupted.
        check: What checks batches of edges: `is_continuous`, or a `grr_torch.fleet.edges.SpreadCheck` on a cluster.
        progress: Told what is being done and how far it is.

    Returns:
        The roadmap; its `build_seconds` leave reachability out.

    Raises:
        ParameterError: Something is missing or out of its range, no point lies within the arm's reach, or the build
            would not fit the memory that is free.
        SeedError: No seed can be used.
        FileFormatError: The checkpoint is of another build, or corrupt.
        OutputError: The checkpoint cannot be written, is there without `resume`, or another build is using it.
    """
    problem = pose_problem(robot, task, points, bounds, seeds, rotations)
    problem = bounded(problem, None if max_slope is None else float(max_slope), method)
    options: dict[str, Any] = {
        "method": method,
        "candidates": candidates,
        "neighbours": neighbours,
        "samples": samples,
        "nearest": nearest,
        "refine": refine,
        "objectives": dict(objectives or {}),
        "max_slope": problem.max_slope,
        "connectivity": problem.connectivity,
        "reachability": reachability,
        "seed": seed,
        "tolerances": asdict(tolerances),
    }
    given = {**options, "seeds": seeds if method == "random" else problem.seeds}
    options |= check_options(robot, problem.task, given)
    seed, reachability = options["seed"], options["reachability"]
    if resume and checkpoint is None:
        raise ParameterError("resume", "no checkpoint", "with checkpoint (--checkpoint DIR), the folder to go on from")
    what = None if checkpoint is None else describe_build(robot, problem, options)
    with closing(Checkpoint(checkpoint, what, resume)) as kept:
        if kept.roadmap is not None:
            return load_roadmap(kept.roadmap, robot)
        require_memory(robot, problem, refine)
        with kept.timed("building"):
            work = Work(robot, problem, seed, tolerances, check, progress, kept)
            if method == "random":
                parts = at_random(work, options["samples"] or SAMPLES, options["nearest"])
            else:
                parts = by_expansion(work, options["neighbours"], options["candidates"] or CANDIDATES)
        settings = {
            "margin": robot.margin,
            "seed": seed,
            "max_slope": problem.max_slope,
            "connectivity": problem.connectivity,
            "reachability": reachability,
            "tolerances": asdict(tolerances),
        }
        if crowded := crowding(robot):
            warnings.warn(f"{crowded}: is the sphere model too coarse?", GrrWarning, stacklevel=2)
        parameters = {"method": method, **parts.chosen, **settings}
        assembled = _assemble(robot, problem, parts, parameters, kept.seconds("building"))
        # before refinement too: edges that are left out in the end should not pull at the others
        roadmap = without_steep_edges(assembled)
        if refine:
            roadmap = refine_roadmap(
                roadmap, objectives=objectives, seed=seed, check=check, progress=progress, checkpoint=kept
            )
        if reachability:
            roadmap = _with_reachability(roadmap, tolerances, progress, kept)
        _warn_of_left_out(roadmap)
        if kept.folder is not None:
            roadmap.triangles(progress, kept.stage("triangles"))
            roadmap.squares(progress, kept.stage("squares"))
            kept.finish(roadmap.save)
        return roadmap


def _warn_of_left_out(roadmap: Roadmap) -> None:
    left, between = len(left_out_edges(roadmap)), int(roadmap.resolved[roadmap.edges].all(1).sum())
    if 2 * left > between:
        told = f"{left:,} of {between:,} edges are steeper than max_slope ({slope_bound(roadmap):g} rad/m) and left out"
        warnings.warn(told, GrrWarning, stacklevel=3)


def _with_reachability(roadmap: Roadmap, tolerances: Tolerances, progress: Progress, kept: Checkpoint) -> Roadmap:
    left = ~roadmap.resolved
    attempts, seed = (roadmap.parameters[name] for name in ("reachability", "seed"))
    reachable = roadmap.resolved.clone()
    reachable[left] = measure_reachability(
        roadmap.robot,
        roadmap.task,
        roadmap.points[left],
        attempts,
        seed=seed,
        tolerances=tolerances,
        progress=progress,
        kept=kept.stage("reachability"),
    )
    return replace(roadmap, reachable=reachable)


def _assemble(robot: Robot, problem: Problem, parts: Parts, parameters: dict[str, Any], seconds: float) -> Roadmap:
    points = problem.graph.points
    box = torch.stack([points.amin(0), points.amax(0)], dim=1).tolist()
    return Roadmap(
        robot=robot,
        task=problem.task,
        points=points,
        configurations=parts.configurations.cpu(),
        resolved=parts.wave.cpu() >= 0,
        edges=problem.graph.edges,
        connected=parts.connected.cpu(),
        wave=parts.wave.cpu(),
        reachable=None,
        parameters={**parameters, "points": len(points), "bounds": box},
        build_seconds=seconds,
    )
