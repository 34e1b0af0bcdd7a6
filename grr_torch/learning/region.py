"""The part of the task space where a roadmap is known to be one continuous map, and points drawn from it."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial import Delaunay, QhullError, cKDTree
from torch import Tensor

from grr_torch.errors import ParameterError
from grr_torch.progress import Progress, silent
from grr_torch.spaces.pyramids import pyramid_corners

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap
    from grr_torch.spaces.lattice import Lattice

# simplices round a point, by their centres, in which it may lie
_NEAR = 32


@dataclass(frozen=True, eq=False)
class Region:
    """Simplices of the task graph: triangles in the plane, tetrahedra in space, that fill the certified cells.

    Attributes:
        corners: (S, d + 1, d) their corners [m].
        volumes: (S,) their areas or volumes [m² or m³].
    """

    corners: Tensor
    volumes: Tensor

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Points (count, d), uniform over the region [m]."""
        # multinomial takes no more than 2^24 of them
        share = torch.rand(count, dtype=torch.float64, generator=generator)
        chosen = torch.searchsorted(self._sums, share * self._sums[-1], right=True).clamp_max(len(self._sums) - 1)
        # the exponential law makes barycentric coordinates uniform
        weights = -torch.rand(count, self.corners.shape[1], 1, dtype=torch.float64, generator=generator).log()
        return (self.corners[chosen] * weights).sum(1) / weights.sum(1)

    def contains(self, points: Tensor) -> Tensor:
        """(N,) whether points (N, d) lie in the region; of long, thin simplices some may be overlooked."""
        centres, inverse = self._tables
        near = torch.from_numpy(centres.query(points.numpy(), k=range(1, min(_NEAR, len(self.volumes)) + 1))[1])
        inside = torch.zeros(len(points), dtype=torch.bool)
        for simplices in near.T:
            offsets = points - self.corners[simplices, 0]
            shares = (inverse[simplices] @ offsets[..., None])[..., 0]
            inside |= (shares >= -1e-9).all(1) & (shares.sum(1) <= 1.0 + 1e-9)
        return inside

    @cached_property
    def _sums(self) -> Tensor:
        """(S,) sums of the volumes up to each."""
        return self.volumes.cumsum(0)

    @cached_property
    def _tables(self) -> tuple[cKDTree, Tensor]:
        """A tree of the simplices' centres, and the matrices (S, d, d) that give barycentric coordinates."""
        edges = (self.corners[:, 1:] - self.corners[:, :1]).mT
        return cKDTree(self.corners.mean(1).numpy()), torch.linalg.inv(edges)


def certified_region(roadmap: Roadmap, progress: Progress = silent) -> Region:
    """The cells of a roadmap that are resolved and certified on all sides.

    On a staggered grid these are pyramids, a cell's centre over one of its faces (triangles in the plane), whose
    triangles and square are all certified. On other graphs they are the simplices of the Delaunay triangulation of the
    resolved vertices whose triangles are.

    Args:
        roadmap: The roadmap.
        progress: Told how many cells are measured.

    Raises:
        ParameterError: There is no such cell.
    """
    cells, faces = roadmap.cells(progress)
    count = len(roadmap.points)
    triangles = _keys(cells.corners[cells.certified], count)
    lattice = roadmap.graph.lattice
    if lattice is None:
        simplices = _delaunay(roadmap)
        keep = _all_known(simplices, triangles, count)
    else:
        pyramids = _pyramids(lattice)
        pyramids = pyramids[roadmap.resolved[pyramids].all(1)]
        keep = _all_known(pyramids, triangles, count, apex=pyramids.shape[1] == 5)
        if pyramids.shape[1] == 5:
            keep &= torch.isin(_keys(pyramids[:, 1:], count), _keys(faces.corners[faces.certified], count))
        simplices = pyramids
    simplices = simplices[keep]
    if simplices.shape[1] == 5:
        simplices = torch.cat([simplices[:, [0, 1, 2, 3]], simplices[:, [0, 1, 3, 4]]])
    if len(simplices) == 0:
        resolved = f"{int(roadmap.resolved.sum())} resolved vertices and no certified cell"
        raise ParameterError("roadmap", f"one with {resolved}", "one with certified cells, in which to draw points")
    corners = roadmap.points[simplices, : roadmap.task.dimension]
    volumes = torch.linalg.det(corners[:, 1:] - corners[:, :1]).abs() / math.factorial(corners.shape[2])
    return Region(corners, volumes)


def _keys(corners: Tensor, count: int) -> Tensor:
    """A number for each triangle (C, 3), or square of a grid (C, 4), whatever the order of its corners.

    A grid's square is known by its first and last vertex, which lie across from each other.
    """
    ordered = corners.sort(dim=1).values
    kept = ordered if corners.shape[1] == 3 else ordered[:, [0, 3]]
    powers = torch.tensor([count**k for k in range(kept.shape[1])])
    return kept @ powers


def _all_known(simplices: Tensor, triangles: Tensor, count: int, *, apex: bool = False) -> Tensor:
    """(S,) whether all triangles of simplices, or of pyramids those at the apex, are among the known ones."""
    sides = simplices.shape[1]
    chosen = [(0, k, k % 4 + 1) for k in range(1, 5)] if apex else list(itertools.combinations(range(sides), 3))
    known = torch.ones(len(simplices), dtype=torch.bool)
    for three in chosen:
        known &= torch.isin(_keys(simplices[:, list(three)], count), triangles)
    return known


def _pyramids(lattice: Lattice) -> Tensor:
    """(P, 5) in space, (P, 3) in the plane: the centre of a cell, then the corners round one of its faces."""
    d = len(lattice.cells)
    # by face, so that all of one kind lie together
    corners = pyramid_corners(lattice).unflatten(0, (-1, 2 * d)).transpose(0, 1).flatten(0, 1)
    return corners[:, [2, 0, 1] if d == 2 else [4, 0, 2, 3, 1]]


def _delaunay(roadmap: Roadmap) -> Tensor:
    """(S, d + 1) simplices over the resolved vertices; none where they are too few, or in one plane."""
    d = roadmap.task.dimension
    vertices = roadmap.resolved.nonzero()[:, 0]
    none = torch.empty(0, d + 1, dtype=torch.long)
    if len(vertices) <= d:
        return none
    try:
        simplices = Delaunay(roadmap.points[vertices, :d].numpy()).simplices
    except QhullError:
        return none
    return vertices[torch.from_numpy(simplices.astype(np.int64))]
