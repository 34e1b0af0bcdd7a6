"""Small cycles of graphs: all triangles, and which cycles have all their edges."""

from __future__ import annotations

import torch
from torch import Tensor


def triangles(edges: Tensor, vertices: int) -> Tensor:
    """(C, 3) all triangles of a graph, smallest vertex first.

    Args:
        edges: (E, 2) edges.
        vertices: How many vertices there are.
    """
    edges = edges.sort(dim=1).values
    keys, order = (edges[:, 0] * vertices + edges[:, 1]).sort()
    first, second = edges[order].unbind(1)
    starts = torch.searchsorted(first.contiguous(), torch.arange(vertices + 1))
    # of every edge (a, b), the edges (a, c) with c > b: is (b, c) one too?
    counts = starts[first + 1] - torch.arange(len(first)) - 1
    edge = torch.repeat_interleave(torch.arange(len(first)), counts)
    beyond = edge + 1 + torch.arange(len(edge)) - torch.repeat_interleave(counts.cumsum(0) - counts, counts)
    there = _are_edges(keys, second[edge] * vertices + second[beyond])
    edge, beyond = edge[there], beyond[there]
    return torch.stack([first[edge], second[edge], second[beyond]], dim=1)


def closed(corners: Tensor, edges: Tensor, vertices: int) -> Tensor:
    """Those of cycles, given by their corners (C, k) in order, all of whose sides are edges (E, 2), smaller first."""
    keys = (edges[:, 0] * vertices + edges[:, 1]).sort().values
    sides = torch.stack([corners, corners.roll(-1, dims=1)], dim=-1).sort(dim=-1).values
    return corners[_are_edges(keys, sides[..., 0] * vertices + sides[..., 1]).all(1)]


def draw(count: int, most: int, seed: int = 0) -> Tensor:
    """Numbers (K,) below `count` in order: all of them, or `most` random ones, none twice."""
    if count <= most:
        return torch.arange(count)
    return torch.randint(count, (most,), generator=torch.Generator().manual_seed(seed)).unique()


def _are_edges(keys: Tensor, wanted: Tensor) -> Tensor:
    """Which of the wanted keys are among the sorted ones."""
    if len(keys) == 0:
        return torch.zeros_like(wanted, dtype=torch.bool)
    return keys[torch.searchsorted(keys, wanted).clamp(max=len(keys) - 1)] == wanted
