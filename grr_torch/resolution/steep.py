"""Edges that are too steep to be of use, whatever the continuity check says of them.

Near the axis of a base joint, or where a map cannot be continuous, an edge may be followed only by turning an arm half
round for a hand's breadth. A roadmap can leave such edges out: no path and no solution then leads over them.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from grr_torch.errors import ParameterError
from grr_torch.resolution.quality import edge_slopes
from grr_torch.resolution.roadmap import Roadmap


def check_max_slope(max_slope: float | None) -> None:
    """Checks what slope edges may have at most.

    Raises:
        ParameterError: It is not above 0.
    """
    if max_slope is not None and not 0.0 < max_slope < math.inf:
        raise ParameterError("max_slope", max_slope, "above 0, in rad/m")


def gentle(roadmap: Roadmap, connected: Tensor, max_slope: float | None) -> Tensor:
    """Which of some edges (E,) between resolved vertices are not steeper than `max_slope` [rad/m]: (E,) bool."""
    if max_slope is None:
        return connected
    kept = connected.clone()
    kept[connected] = edge_slopes(replace(roadmap, connected=connected)) <= max_slope
    return kept


def without_steep_edges(roadmap: Roadmap, max_slope: float) -> Roadmap:
    """The roadmap without its connected edges steeper than this, and without the vertices that had no others.

    Its parameters tell the limit ("max_slope") and what was left out ("left_out"): how many edges, and which vertices.

    Args:
        roadmap: The roadmap.
        max_slope: Largest D_q / D_p [rad/m].
    """
    connected = gentle(roadmap, roadmap.connected, max_slope)
    had, has = (torch.zeros_like(roadmap.resolved) for _ in range(2))
    had[roadmap.edges[roadmap.connected].flatten()] = True
    has[roadmap.edges[connected].flatten()] = True
    lost = had & ~has
    left_out = {
        "edges": int(roadmap.connected.sum() - connected.sum()),
        "vertices": lost.nonzero()[:, 0].tolist(),
    }
    return replace(
        roadmap,
        configurations=torch.where(lost[:, None], torch.nan, roadmap.configurations),
        resolved=roadmap.resolved & ~lost,
        wave=torch.where(lost, -1, roadmap.wave),
        connected=connected,
        parameters={**roadmap.parameters, "max_slope": max_slope, "left_out": left_out},
    )
