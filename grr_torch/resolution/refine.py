"""Refinement of a roadmap: repair, then relaxation, without losing what was connected."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from grr_torch.progress import Progress, silent
from grr_torch.projection.continuity import is_continuous
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.cells import triangles
from grr_torch.resolution.certify import certify
from grr_torch.resolution.quality import Quality
from grr_torch.resolution.relax import Network, relax
from grr_torch.resolution.repair import repair
from grr_torch.resolution.roadmap import Roadmap

# what `parameters["refinement"]` keeps of the quality before
BEFORE = ("resolved_vertices", "connected_edges", "smoothness", "triangles_wound", "triangles_spread")


def refine(roadmap: Roadmap, *, seed: int = 0, progress: Progress = silent) -> Roadmap:
    """Improves a roadmap: more vertices, more edges, and a smaller mean of D_q / D_p.

    Unresolved vertices and the ends of broken edges are tried again from all their neighbours and from random starts;
    then all configurations move along their self-motion manifolds at once. No vertex and no connected edge is lost:
    where the relaxed map breaks an edge, its ends go back to where they were.

    Args:
        roadmap: The roadmap.
        seed: Of the random starts.
        progress: Told what is being done and how far it is.

    Returns:
        The refined roadmap; its `build_seconds` include the refinement, and `parameters["refinement"]` tells what it
        was before.
    """
    before = roadmap.quality()
    begin = time.perf_counter()
    tolerances = Tolerances(**roadmap.parameters["tolerances"])
    repaired = repair(roadmap, tolerances, seed)
    refined = _relaxed(repaired, tolerances, progress)
    seconds = time.perf_counter() - begin
    kept = {name: getattr(before, name) for name in BEFORE}
    return replace(
        refined,
        parameters={**roadmap.parameters, "refinement": {**kept, "seconds": seconds}},
        build_seconds=roadmap.build_seconds + seconds,
    )


def _relaxed(roadmap: Roadmap, tolerances: Tolerances, progress: Progress) -> Roadmap:
    """The relaxed map, but for the surroundings of edges that it would break."""
    robot, task = roadmap.robot, roadmap.task
    edges = roadmap.edges[roadmap.connected]
    if len(edges) == 0:
        return roadmap
    vertices = roadmap.resolved.nonzero()[:, 0]
    rank = torch.full((len(roadmap.points),), -1).index_put_((vertices,), torch.arange(len(vertices)))
    network = Network(
        robot,
        task,
        roadmap.points[vertices].to(robot.lower).T.contiguous(),
        rank[edges].T.contiguous().to(robot.device),
        task.distance(roadmap.points[edges[:, 0]], roadmap.points[edges[:, 1]]).to(robot.lower),
    )
    old = roadmap.configurations[vertices].to(robot.lower)
    new = relax(network, old.T.contiguous(), tolerances, progress)
    cells = rank[triangles(edges, len(roadmap.points))].to(robot.device)
    new = certify(network, cells, new, tolerances, progress).T
    configurations = roadmap.configurations.clone()
    configurations[vertices] = new.cpu()
    connected = torch.zeros_like(roadmap.connected)
    stale = torch.ones_like(roadmap.connected)
    while True:
        check = (stale & roadmap.resolved[roadmap.edges].all(1)).nonzero()[:, 0]
        connected[check] = _continuous(roadmap, configurations, check, tolerances)
        lost = roadmap.edges[roadmap.connected & ~connected].unique()
        if len(lost) == 0:
            return replace(roadmap, configurations=configurations, connected=connected)
        moved = (configurations != roadmap.configurations).any(1) & roadmap.resolved
        if not bool(moved.any()):
            # an edge was called connected that is not
            return replace(roadmap, connected=connected)
        back = lost[moved[lost]] if bool(moved[lost].any()) else moved.nonzero()[:, 0]
        configurations[back] = roadmap.configurations[back]
        stale = torch.isin(roadmap.edges, back).any(1)


def _continuous(roadmap: Roadmap, configurations: Tensor, edges: Tensor, tolerances: Tolerances) -> Tensor:
    first, second = roadmap.edges[edges].unbind(1)
    return is_continuous(
        roadmap.robot,
        roadmap.task,
        roadmap.points[first],
        roadmap.points[second],
        configurations[first],
        configurations[second],
        tolerances=tolerances,
    ).cpu()


def check_refinement(parameters: Mapping[str, Any]) -> None:
    """Checks what a file says of a roadmap before its refinement.

    Raises:
        ValueError: A figure is missing or is no number.
    """
    before = parameters.get("refinement")
    if before is None:
        return
    for name in (*BEFORE, "seconds"):
        if not isinstance(before, dict) or not isinstance(before.get(name), int | float | None):
            raise ValueError(f"'refinement' without a number '{name}'")


def summary(roadmap: Roadmap, quality: Quality) -> str:
    """What the refinement of a roadmap changed, in one line; empty if it was not refined."""
    before = roadmap.parameters.get("refinement")
    if before is None:
        return ""
    named = (
        ("vertices", "resolved_vertices"),
        ("edges", "connected_edges"),
        ("windings", "triangles_wound"),
        ("spread triangles", "triangles_spread"),
    )
    changes = [f"{name} {before[key]:,} → {getattr(quality, key):,}" for name, key in named]
    if before["smoothness"] is not None and quality.smoothness is not None:
        changes.insert(0, f"smoothness {before['smoothness']:.3f} → {quality.smoothness:.3f}")
    return ", ".join(changes) + f", in {before['seconds']:.2f} s"
