"""Small cycles of graphs: all triangles, and which cycles have all their edges."""

from __future__ import annotations

import torch
from torch import Tensor

# edges or cycles that are looked at together
_AT_ONCE = 1 << 17


def triangles(edges: Tensor, vertices: int) -> Tensor:
    """(C, 3) all triangles of a graph, smallest vertex first.

    Args:
        edges: (E, 2) edges.
        vertices: How many vertices there are.
    """
    first, second = edges.amin(1), edges.amax(1)
    keys, order = (first * vertices + second).sort()
    first, second = first[order], second[order]
    starts = torch.searchsorted(first, torch.arange(vertices + 1))
    found: list[Tensor] = [edges.new_empty(0, 3)]
    for part in torch.arange(len(keys)).split(_AT_ONCE):
        # of every edge (a, b), the edges (a, c) with c > b: is (b, c) one too?
        counts = starts[first[part] + 1] - part - 1
        edge = torch.repeat_interleave(part, counts)
        beyond = edge + 1 + torch.arange(len(edge)) - torch.repeat_interleave(counts.cumsum(0) - counts, counts)
        there = _are_edges(keys, second[edge] * vertices + second[beyond])
        edge, beyond = edge[there], beyond[there]
        found.append(torch.stack([first[edge], second[edge], second[beyond]], dim=1))
    return torch.cat(found)


def closed(corners: Tensor, edges: Tensor, vertices: int) -> Tensor:
    """Those of cycles, given by their corners (C, k) in order, all of whose sides are edges (E, 2), smaller first."""
    return corners[are_closed(corners, edges, vertices)]


def are_closed(corners: Tensor, edges: Tensor, vertices: int) -> Tensor:
    """(C,) which of cycles, given as to `closed`, it keeps."""
    keys = (edges[:, 0] * vertices + edges[:, 1]).sort().values
    result = torch.zeros(len(corners), dtype=torch.bool)
    for part, whole in zip(corners.split(_AT_ONCE), result.split(_AT_ONCE), strict=True):
        following = part.roll(-1, dims=1)
        wanted = torch.minimum(part, following) * vertices + torch.maximum(part, following)
        whole.copy_(_are_edges(keys, wanted).all(1))
    return result


def draw(count: int, most: int, seed: int = 0) -> Tensor:
    """Numbers (K,) below `count` in order: all of them, or `most` random ones, none twice."""
    if count <= most:
        return torch.arange(count)
    generator = torch.Generator().manual_seed(seed)
    if count <= 4 * most:
        return torch.randperm(count, generator=generator)[:most].sort().values
    # of so many, half as many again are drawn: enough are left when the same ones are counted once
    drawn = torch.randint(count, (most + most // 2,), generator=generator).unique()
    return drawn[torch.randperm(len(drawn), generator=generator)[:most]].sort().values


def _are_edges(keys: Tensor, wanted: Tensor) -> Tensor:
    """Which of the wanted keys are among the sorted ones."""
    if len(keys) == 0:
        return torch.zeros_like(wanted, dtype=torch.bool)
    return keys[torch.searchsorted(keys, wanted).clamp(max=len(keys) - 1)] == wanted
