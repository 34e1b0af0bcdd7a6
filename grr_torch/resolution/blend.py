"""Blending a relaxed roadmap with what it was, so that no connected edge is lost."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from grr_torch.progress import Progress
from grr_torch.projection.project import Tolerances, project_columns
from grr_torch.resolution.checkpoint import Stage
from grr_torch.resolution.edges import EdgeCheck
from grr_torch.resolution.losses import FlagCheck, without_losses
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.spaces.configuration import difference, distance, normalise

# a configuration that would move by less than this share of its way stays where it was
_LEAST_SHARE = 0.1
# a blended configuration is projected no farther than this [rad]
_NEAR = 0.1


def blended(
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
    share = roadmap.resolved.to(configurations.dtype)

    def send_back(changed: Roadmap, back: Tensor) -> Roadmap:
        share[back] *= 0.5
        share[share < _LEAST_SHARE] = 0.0
        nearer = changed.configurations.clone()
        nearer[back], there = _part_way(roadmap, configurations, back, share[back], tolerances)
        share[back[~there]] = 0.0
        return replace(changed, configurations=nearer)

    moved = replace(roadmap, configurations=configurations.clone())
    return without_losses(roadmap, moved, send_back, FlagCheck(tolerances, check, progress, kept))


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
