"""Slopes of edges, D_q / D_p: which are steep, and what is left out of a map that has a bound."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from grr_torch.projection.project import Tolerances
from grr_torch.resolution.edges import check_edges
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import distance
from grr_torch.spaces.task import TaskSpace

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


def slopes_between(
    robot: Robot, task: TaskSpace, points: Tensor, others: Tensor, configurations: Tensor, other_configurations: Tensor
) -> Tensor:
    """D_q / D_p (…) between configurations (…, n) at points (…, width) and others, on any device.

    In double precision, as in files, whatever the robot computes in.
    """
    wraps = robot.continuous.to(configurations.device)
    moved = distance(configurations.double(), other_configurations.double(), wraps)
    return moved / task.distance(points, others)


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


def slope_bound(roadmap: Roadmap) -> float | None:
    """The slope above which edges of a roadmap are left out [rad/m]; None: it has no such bound.

    Its parameter `max_slope`, or what `with_raised_bound` has raised that to.
    """
    bound: float | None = roadmap.parameters.get("raised_slope") or roadmap.parameters.get("max_slope")
    return bound


def check_slope_bound(parameters: Mapping[str, Any]) -> None:
    """Checks what a file says of the bound of a roadmap's slopes.

    Raises:
        ValueError: A figure is no number above 0.
    """
    for name in ("max_slope", "raised_slope", "connectivity"):
        value = parameters.get(name)
        if value is not None and not (isinstance(value, int | float) and value > 0.0):
            raise ValueError(f"'{name}' is no number above 0")


def left_out_edges(roadmap: Roadmap) -> Tensor:
    """Indices (K,) of edges that are not connected because they are steeper than the roadmap's bound.

    The steepest first, and none if it has no bound. Some of them may not be continuous either.
    """
    limit = slope_bound(roadmap)
    if limit is None:
        return torch.empty(0, dtype=torch.long)
    edges = (roadmap.resolved[roadmap.edges].all(1) & ~roadmap.connected).nonzero()[:, 0]
    slopes = edge_slopes(roadmap, edges)
    order = slopes.argsort(descending=True)
    return edges[order[slopes[order] > limit]]


def without_steep_edges(roadmap: Roadmap) -> Roadmap:
    """The roadmap whose edges steeper than its bound, if it has one, are not connected."""
    limit = slope_bound(roadmap)
    if limit is None:
        return roadmap
    connected = roadmap.connected.clone()
    connected[steep_edges(roadmap, limit)] = False
    return replace(roadmap, connected=connected)


def within_bound(roadmap: Roadmap, edges: Tensor) -> Tensor:
    """(E,) edges (E, 2) that are not steeper than the roadmap's bound; all, if it has none."""
    limit = slope_bound(roadmap)
    if limit is None:
        return torch.ones(len(edges), dtype=torch.bool)
    return _slopes(roadmap, edges) <= limit


def with_raised_bound(roadmap: Roadmap) -> Roadmap:
    """The roadmap with its bound raised as far as its parameter `connectivity` takes, if it has one.

    That is the share of the edges between resolved vertices that are to be connected. The least steep of those that
    were left out are, as far as they are continuous; where that is not enough, all of them. Of edges that just keep a
    bound while a map is refined, each holds its ends where the others suffer; so the bound is raised at the end.
    """
    share = roadmap.parameters.get("connectivity")
    between = int(roadmap.resolved[roadmap.edges].all(1).sum())
    # not one more where the product is rounded up
    missing = math.ceil((share or 0.0) * between - 1e-6) - int(roadmap.connected.sum())
    left_out = torch.zeros_like(roadmap.connected)
    left_out[left_out_edges(roadmap)] = True
    if missing <= 0 or not bool(left_out.any()):
        return roadmap
    continuous = check_edges(roadmap, Tolerances(**roadmap.parameters["tolerances"]), wanted=left_out)
    slopes = edge_slopes(roadmap, continuous).sort().values[:missing]
    if len(slopes) == 0:
        return roadmap
    bound = math.ceil(float(slopes[-1]) * 10**_DECIMALS) / 10**_DECIMALS
    raised = replace(roadmap, parameters={**roadmap.parameters, "raised_slope": bound})
    return replace(raised, connected=roadmap.connected | (continuous & within_bound(raised, raised.edges)))


def _slopes(roadmap: Roadmap, edges: Tensor) -> Tensor:
    first, second = edges.T
    q, points = roadmap.configurations, roadmap.points
    return slopes_between(roadmap.robot, roadmap.task, points[first], points[second], q[first], q[second])
