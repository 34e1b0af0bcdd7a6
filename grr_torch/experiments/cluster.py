"""What a build costs by the vertex and the edge, and what a cluster makes of its continuity checks.

One roadmap that is too large for one machine would be cut in space: each machine holds a block of the grid's vertices,
their edges, and a rim of those vertices of other blocks that its own average over (24 neighbours in the plane and 64 in
space: a few layers). Then,

- the continuity of edges needs nothing but the edges' own ends: `grr_torch.fleet.edges` spreads it already;
- a wave of the expansion averages over resolved neighbours: blocks exchange the rim's new configurations after each;
- a sweep of the relaxation moves a vertex by its neighbours: blocks exchange the rim after each, as in any solver of
  sparse systems; its step length needs one sum over all blocks;
- repair takes a broken edge's ends and their neighbours: by the block that holds the edge;
- cells, quality and reachability are sums over what a block holds; seeds are found on a coarse grid, by one machine;
- a file is written by block, and one index beside them says which block holds a point.

`measure_cluster` gives the figures that decide when this is worth it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import torch

from grr_torch.errors import GrrError, ParameterError
from grr_torch.fleet.cluster import cluster
from grr_torch.fleet.edges import SpreadCheck
from grr_torch.pieces import one_thread
from grr_torch.progress import Progress, silent
from grr_torch.projection.continuity import is_continuous
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.build import build
from grr_torch.resolution.edges import EdgeCheck, continuous_edges
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.robots.load import load_robot


@dataclass(frozen=True)
class ClusterCost:
    """What a roadmap costs, and its continuity checks on a cluster.

    Attributes:
        vertices: Of its task graph.
        edges: Of its task graph.
        checked: Edges between resolved vertices, which are checked.
        bytes_vertex: Of the tensors, for a vertex.
        bytes_edge: Of the tensors, for an edge.
        expansion_seconds: The build without refinement and without the checks.
        refinement_seconds: Repair, relaxation and certification.
        check_seconds: The checks, in this process on one thread.
        cluster_seconds: The checks on so many workers.
        start_seconds: Starting a cluster and sending the robot to its workers.
    """

    vertices: int
    edges: int
    checked: int
    bytes_vertex: float
    bytes_edge: float
    expansion_seconds: float
    refinement_seconds: float
    check_seconds: float
    cluster_seconds: dict[int, float]
    start_seconds: dict[int, float]


def measure_cluster(
    robot: str,
    task: str | None = None,
    points: int | None = None,
    *,
    workers: int = 2,
    repeats: int = 3,
    progress: Progress = silent,
) -> ClusterCost:
    """Builds a roadmap and checks its edges here and on clusters of one to `workers` workers, the fastest of each.

    Args:
        robot: A bundled robot.
        task: The kind of a task; the preset's default.
        points: Vertices that are asked for; the preset's.
        workers: The most workers.
        repeats: How often each is timed.
        progress: Told what is measured.

    Raises:
        ParameterError: A number is below one.
        MissingPackageError: Ray is not installed.
        GrrError: A cluster found other edges continuous.
    """
    for name, value in (("workers", workers), ("repeats", repeats)):
        if value < 1:
            raise ParameterError(name, value, "1 or more")
    arm = load_robot(robot)
    roadmap = build(arm, task, points=points, refine=False, check=_alone, progress=progress)
    refined = build(arm, task, points=points, progress=progress)
    expected = roadmap.connected
    here = min(_timed(roadmap, _alone, expected) for _ in range(repeats))
    there: dict[int, float] = {}
    starts: dict[int, float] = {}
    for count in range(1, workers + 1):
        progress("checking on clusters", count - 1, workers)
        begin = time.perf_counter()
        with cluster(cpus=count) as ray:
            check = SpreadCheck(ray)
            _timed(roadmap, check, expected)
            starts[count] = time.perf_counter() - begin
            there[count] = min(_timed(roadmap, check, expected) for _ in range(repeats))
    progress("checking on clusters", workers, workers)
    of_vertices = (roadmap.points, roadmap.configurations, roadmap.resolved, roadmap.wave)
    return ClusterCost(
        vertices=len(roadmap.points),
        edges=len(roadmap.edges),
        checked=int(roadmap.resolved[roadmap.edges].all(1).sum()),
        bytes_vertex=sum(tensor.nbytes for tensor in of_vertices) / len(roadmap.points),
        bytes_edge=(roadmap.edges.nbytes + roadmap.connected.nbytes) / max(1, len(roadmap.edges)),
        expansion_seconds=max(0.0, roadmap.build_seconds - here),
        refinement_seconds=refined.parameters["refinement"]["seconds"],
        check_seconds=here,
        cluster_seconds=there,
        start_seconds=starts,
    )


def _alone(*edges: Any, **options: Any) -> torch.Tensor:
    """`is_continuous` in this process and on one thread: what is not that function itself is called in no copies."""
    with one_thread():
        return is_continuous(*edges, **options)


def _timed(roadmap: Roadmap, check: EdgeCheck, expected: torch.Tensor) -> float:
    """How long it takes to check all edges [s].

    Raises:
        GrrError: The result is another one.
    """
    begin = time.perf_counter()
    parts = (roadmap.robot, roadmap.task, roadmap.points, roadmap.configurations, roadmap.resolved, roadmap.edges)
    found = continuous_edges(*parts, Tolerances(**roadmap.parameters["tolerances"]), silent, check=check)
    seconds = time.perf_counter() - begin
    if not torch.equal(found, expected):
        raise GrrError(f"{int((found != expected).sum())} edges were judged otherwise")
    return seconds
