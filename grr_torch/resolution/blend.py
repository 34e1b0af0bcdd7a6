"""Blending a relaxed roadmap with what it was, so that no connected edge is lost."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from grr_torch.progress import Progress, silent
from grr_torch.projection.project import Tolerances, project_columns
from grr_torch.resolution.checkpoint import UNKEPT, Stage
from grr_torch.resolution.edges import EdgeCheck, check_edges, continuous_edges
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.spaces.configuration import difference, distance, normalise

# a configuration that would move by less than this share of its way stays where it was
_LEAST_SHARE = 0.1
# a blended configuration is projected no farther than this [rad]
_NEAR = 0.1


def without_losses(
    roadmap: Roadmap,
    configurations: Tensor,
    tolerances: Tolerances,
    check: EdgeCheck,
    progress: Progress,
    kept: Stage,
) -> Roadmap:
    """The roadmap with new configurations, but for the surroundings of edges that would be lost.

    The ends of such edges go half of the way only, then a quarter of it, and in the end none. Sent back at once, they
    would break the edges to those of their neighbours that have gone all the way, and the whole map might follow.

    Args:
        roadmap: The roadmap as it was.
        configurations: (V, n) new ones of its resolved vertices.
        tolerances: Of the projections.
        check: What checks batches of edges.
        progress: Told how many edges are checked.
        kept: Where it is kept which edges are connected at first, which takes nearly all of the time.
    """
    robot, task, points, resolved = roadmap.robot, roadmap.task, roadmap.points, roadmap.resolved

    def continuous(which: Tensor, progress: Progress = silent, kept: Stage = UNKEPT) -> Tensor:
        found = blended, resolved, roadmap.edges[which]
        return continuous_edges(robot, task, points, *found, tolerances, progress, kept, check).cpu()

    blended, share = configurations.clone(), resolved.to(configurations.dtype)
    connected = continuous(torch.ones_like(roadmap.connected), progress, kept)
    claimed, settled = roadmap.connected.clone(), torch.zeros_like(connected)
    while True:
        unmoved = ~(share > 0.0)[roadmap.edges].any(1)
        doubtful = claimed & ~connected & unmoved & ~settled
        if bool(doubtful.any()):
            # either they were called connected and are not, or they barely passed and come out otherwise in another
            # batch: they are told apart in the batches in which all edges are checked
            claimed[doubtful] = check_edges(roadmap, tolerances, wanted=doubtful)[doubtful]
            settled |= doubtful
        connected[unmoved] = claimed[unmoved]
        ends = roadmap.edges[claimed & ~connected].unique()
        if len(ends) == 0:
            return replace(roadmap, configurations=blended, connected=connected)
        back = ends[share[ends] > 0.0]
        share[back] *= 0.5
        share[share < _LEAST_SHARE] = 0.0
        blended[back], there = _part_way(roadmap, configurations, back, share[back], tolerances)
        share[back[~there]] = 0.0
        changed = torch.zeros_like(resolved)
        changed[back] = True
        stale = changed[roadmap.edges].any(1)
        connected[stale] = continuous(stale)


def _part_way(
    roadmap: Roadmap, configurations: Tensor, vertices: Tensor, share: Tensor, tolerances: Tolerances
) -> tuple[Tensor, Tensor]:
    """Configurations (K, n) of vertices after a share (K,) of their way, and which are there; others are as before."""
    robot = roadmap.robot
    wraps = robot.continuous.cpu()
    before = roadmap.configurations[vertices]
    guesses = normalise(before + share[:, None] * difference(before, configurations[vertices], wraps), wraps)
    targets = roadmap.points[vertices].to(robot.lower).T.contiguous()
    solved, valid = project_columns(robot, roadmap.task, targets, guesses.to(robot.lower).T.contiguous(), tolerances)
    found = solved.T.to(before)
    there = valid.cpu() & (share > 0.0) & (distance(guesses, found, wraps) <= _NEAR)
    return torch.where(there[:, None], found, before), there
