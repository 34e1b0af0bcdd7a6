"""The resolved vertices round any point of a task space, and how much each of them counts in a guess."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from grr_torch.pieces import Array, cores
from grr_torch.spaces.product import ProductGraph

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap

# a guess averages over so many vertices, in the plane and in space: a grid's first two shells
NEIGHBOURS = {2: 8, 3: 14}
# and where rotation varies, over so many positions, in so many rotations each, by the entries of these
_PLACES = {2: 4, 3: 8}
_TURNS = {1: 2, 3: 4, 4: 6}
# no vertex farther than so many of the longest edges counts, and one must lie within one of them
FARTHEST = 1.5
# of more points than so many the neighbours are searched for on all cores
_MANY = 1000
# distances to all vertices that are held at once
_AT_ONCE = 1 << 21


class Around:
    """The vertices nearest by position, weighted by r / d − 1, where r is the distance of the next one."""

    def __init__(self, roadmap: Roadmap, vertices: Tensor, radius: float) -> None:
        """For the resolved vertices (S,) of a roadmap, whose longest edge is `radius` [m]."""
        self._d, self._radius, self._count = roadmap.task.dimension, radius, len(vertices)
        # a balanced tree takes twice as long to make and is no faster here
        self._tree = cKDTree(roadmap.points[vertices, : self._d].numpy(), balanced_tree=False)

    def weigh(self, points: Tensor) -> tuple[Array, Array, Array]:
        """The vertices round points (N, width).

        Returns:
            Ranks (N, K) among the resolved ones, the nearest first, their weights (N, K), and which points (N,) lie
            near enough to one.
        """
        k = min(NEIGHBOURS[self._d], self._count)
        places = points[:, : self._d].numpy()
        # the one after the k-th is at infinity where there is none
        distances, nearest = self._tree.query(places, k + 1, workers=cores() if len(points) > _MANY else 1)
        weights = _weights(distances, k, FARTHEST * self._radius)
        return self._ranks(nearest[:, :k]), weights, distances[:, 0] <= self._radius

    def _ranks(self, nearest: Array) -> Array:
        """Ranks that there are: from a point beyond all numbers the tree finds none."""
        return np.minimum(nearest, self._count - 1)

    def nearest(self, points: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """The k nearest: distances (N, k) [m] and ranks (N, k)."""
        distances, index = self._tree.query(points[:, : self._d].numpy(), k=range(1, min(k, self._count) + 1))
        return torch.from_numpy(distances), torch.from_numpy(self._ranks(index))


class AroundProduct:
    """Where rotation varies: the nearest positions in the nearest rotations, weighted by both.

    By D_p alone, all of them would be rotations at one position.
    """

    def __init__(self, roadmap: Roadmap, vertices: Tensor, radius: float) -> None:
        """As of `Around`."""
        assert isinstance(roadmap.graph, ProductGraph)
        self._graph, self._task, self._radius = roadmap.graph, roadmap.task, radius
        self._tree = cKDTree(self._graph.positions.points.numpy())
        self._points = roadmap.points[vertices]
        self._rank = torch.full((len(roadmap.points),), -1)
        self._rank[vertices] = torch.arange(len(vertices))

    def weigh(self, points: Tensor) -> tuple[Array, Array, Array]:
        """As of `Around`; what is not resolved has no weight, and a rank of some other vertex."""
        d, size = self._task.dimension, len(self._graph.positions.points)
        k = min(_PLACES[d], size)
        distances, near = self._tree.query(points[:, :d].numpy(), k + 1)
        # from a point beyond all numbers the tree finds none
        places = torch.from_numpy(np.minimum(near[:, :k], size - 1))
        wanted = min(_TURNS[points.shape[1] - d], max(1, len(self._graph.rotations.values) - 1))
        turns, apart = self._graph.nearest_rotations(points[:, d:], wanted + 1)
        # the root of 1 − cos grows with the angle
        by_turn = torch.from_numpy(_weights(apart.clamp_min(0.0).sqrt().numpy(), wanted, math.inf))
        by_place = torch.from_numpy(_weights(distances, k, FARTHEST * self._radius))
        ranks = self._rank[(turns[:, :wanted, None] * size + places[:, None]).flatten(1)]
        weights = torch.where(ranks >= 0, (by_turn[:, :, None] * by_place[:, None]).flatten(1), 0.0)
        weights, order = weights.sort(dim=1, descending=True)
        return ranks.gather(1, order).clamp_min(0).numpy(), weights.numpy(), distances[:, 0] <= self._radius

    def nearest(self, points: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """The k nearest by D_p: distances (N, k) and ranks (N, k)."""
        k = min(k, len(self._points))
        found = [
            self._task.distance(part[:, None], self._points).topk(k, largest=False)
            for part in points.split(max(1, _AT_ONCE // len(self._points)))
        ]
        return torch.cat([part.values for part in found]), torch.cat([part.indices for part in found])


def _weights(distances: Array, k: int, farthest: float) -> Array:
    """Weights r / d − 1 (N, k) of the k nearest, by distances (N, k or more); where there is no next one, 1 / d."""
    near = np.maximum(distances[:, :k], 1e-12)
    reach = np.minimum(distances[:, k:], farthest)
    if reach.shape[1] == 0 or not np.isfinite(reach).all():
        return 1.0 / near
    return np.maximum(reach / near - 1.0, 0.0)
