"""One rotation out of a roadmap in which rotation varies."""

from __future__ import annotations

from dataclasses import replace

import torch

from grr_torch.resolution.roadmap import Roadmap
from grr_torch.spaces.product import ProductGraph


def fullest_slice(roadmap: Roadmap) -> Roadmap:
    """The part of a roadmap in the rotation in which most vertices are resolved: what can be drawn in space.

    Where rotation does not vary, the roadmap itself.
    """
    graph = roadmap.graph
    if not isinstance(graph, ProductGraph):
        return roadmap
    size = len(graph.positions.points)
    turn = int(roadmap.resolved.reshape(-1, size).sum(1).argmax())
    part = slice(turn * size, (turn + 1) * size)
    kept = (roadmap.edges // size == turn).all(1)
    wave = roadmap.wave[part]
    # waves are counted anew, so that none is empty
    ranks = wave.unique(return_inverse=True)[1].to(wave.dtype)
    return replace(
        roadmap,
        points=roadmap.points[part],
        configurations=roadmap.configurations[part],
        resolved=roadmap.resolved[part],
        edges=roadmap.edges[kept] - turn * size,
        connected=roadmap.connected[kept],
        wave=torch.where(wave < 0, wave, ranks - int((wave < 0).any())),
        reachable=None if roadmap.reachable is None else roadmap.reachable[part],
    )
