"""Slopes of edges, D_q / D_p: which are steep, and what is left out of a map that has a bound."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from grr_torch.projection.project import Tolerances
from grr_torch.resolution.edges import check_edges
from grr_torch.spaces.configuration import distance

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap


# slopes above so many times the median are suspect
STEEP = 10.0
# decimals that a bound is rounded up to [rad/m]
_DECIMALS = 3


def edge_slopes(roadmap: Roadmap, edges: Tensor | None = None) -> Tensor:
    """D_q / D_p (K,) of edges between resolved vertices [rad/m], (E,) bool or their indices; by default the connected.

    Where D_q and D_p are distances of joint and of task space (Section IV-B of the paper).
    """
    return _slopes(roadmap, roadmap.edges[roadmap.connected if edges is None else edges])


def steep_edges(roadmap: Roadmap, max_slope: float | None = None) -> Tensor:
    """Indices (K,) of connected edges with D_q / D_p above `max_slope` [rad/m], the steepest first.

    The paper's continuity check lets pass an edge between unrelated configurations that a self-motion joins; its slope
    gives it away.

    Args:
        roadmap: The roadmap.
        max_slope: Ten times the median by default.
    """
    slopes = edge_slopes(roadmap)
    if len(slopes) == 0:
        return torch.empty(0, dtype=torch.long)
    limit = STEEP * float(slopes.median()) if max_slope is None else max_slope
    steep = (slopes > limit).nonzero()[:, 0]
    return roadmap.connected.nonzero()[:, 0][steep[slopes[steep].argsort(descending=True)]]


def left_out_edges(roadmap: Roadmap) -> Tensor:
    """Indices (K,) of edges that are not connected because they are steeper than what the roadmap was built with.

    Steeper than its `max_slope`, that is; the steepest first, and none if it has no such bound. Some of them may
    not be continuous either.
    """
    limit = roadmap.parameters.get("max_slope")
    if limit is None:
        return torch.empty(0, dtype=torch.long)
    edges = (roadmap.resolved[roadmap.edges].all(1) & ~roadmap.connected).nonzero()[:, 0]
    slopes = edge_slopes(roadmap, edges)
    order = slopes.argsort(descending=True)
    return edges[order[slopes[order] > limit]]


def without_steep_edges(roadmap: Roadmap) -> Roadmap:
    """The roadmap whose edges steeper than its parameter `max_slope` [rad/m], if it has one, are not connected."""
    limit = roadmap.parameters.get("max_slope")
    if limit is None:
        return roadmap
    connected = roadmap.connected.clone()
    connected[steep_edges(roadmap, limit)] = False
    return replace(roadmap, connected=connected)


def within_bound(roadmap: Roadmap, edges: Tensor) -> Tensor:
    """(E,) edges (E, 2) that are not steeper than the roadmap's parameter `max_slope`; all, if it has none."""
    limit = roadmap.parameters.get("max_slope")
    if limit is None:
        return torch.ones(len(edges), dtype=torch.bool)
    return _slopes(roadmap, edges) <= limit


def with_raised_bound(roadmap: Roadmap, connectivity: float) -> Roadmap:
    """The roadmap with its parameter `max_slope` as high as this share of its edges takes, if it is lower.

    The least steep of the edges that were left out are connected, as far as they are continuous. Of edges that just
    keep a bound while a map is relaxed, each holds its ends where the others suffer; so the bound is raised at the end.

    Args:
        roadmap: The roadmap.
        connectivity: Connected edges by edges between resolved vertices.
    """
    limit = roadmap.parameters.get("max_slope")
    between = int(roadmap.resolved[roadmap.edges].all(1).sum())
    missing = math.ceil(connectivity * between) - int(roadmap.connected.sum())
    left_out = torch.zeros_like(roadmap.connected)
    left_out[left_out_edges(roadmap)] = True
    if limit is None or missing <= 0 or not bool(left_out.any()):
        return roadmap
    continuous = check_edges(roadmap, Tolerances(**roadmap.parameters["tolerances"]), wanted=left_out)
    slopes = edge_slopes(roadmap, continuous).sort().values[:missing]
    if len(slopes) == 0:
        return roadmap
    limit = math.ceil(float(slopes[-1]) * 10**_DECIMALS) / 10**_DECIMALS
    raised = replace(roadmap, parameters={**roadmap.parameters, "max_slope": limit})
    return replace(raised, connected=roadmap.connected | (continuous & within_bound(raised, raised.edges)))


def _slopes(roadmap: Roadmap, edges: Tensor) -> Tensor:
    first, second = edges.T
    q, points = roadmap.configurations, roadmap.points
    moved = distance(q[first], q[second], roadmap.robot.continuous.cpu())
    return moved / roadmap.task.distance(points[first], points[second])
