"""Guesses for many points at once on a device with many processors: matrices instead of trees and look-ups."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from grr_torch.applications.around import FARTHEST, NEIGHBOURS
from grr_torch.pieces import Array, Mask
from grr_torch.spaces.configuration import average, embed

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap

# all distances grow with the vertices, and a tree's look-ups hardly: larger roadmaps are left to the CPU
MOST_VERTICES = 1 << 15
# distances held at once: 256 MiB, and as much again while they are added up
_AT_ONCE = 1 << 26
# what a point takes at least, in distances
_KEYS = 1 << 10
# vertices more than are wanted, as rounding may have put some before others
_SPARE = 3


class ManyGuesses:
    """The weighted averages of `Solver.guess`, computed where the robot's tensors are; see there for what they are.

    Rotation does not vary in the task.
    """

    def __init__(self, roadmap: Roadmap, vertices: Tensor, radius: float) -> None:
        """For the resolved vertices (S,) of a roadmap, whose longest edge is `radius` [m]."""
        d, device = roadmap.task.dimension, roadmap.robot.device
        self._d, self._radius, self._k = d, radius, min(NEIGHBOURS[d], len(vertices))
        self._continuous = roadmap.robot.continuous
        self._points = roadmap.points[vertices, :d].to(device)
        self._embedded = embed(roadmap.configurations[vertices].to(device, torch.float64), self._continuous)
        rank = torch.full((len(roadmap.points),), -1)
        rank[vertices] = torch.arange(len(vertices))
        first, second = rank[roadmap.edges[roadmap.connected]].to(device).T
        self._joined = torch.cat([self._key(first, second), self._key(second, first)]).sort().values

    def __call__(self, points: Tensor) -> tuple[Tensor, Array, Mask]:
        """For points (N, width) on the CPU.

        Returns:
            Averages (N, n) on the device, the nearest vertices' ranks (N,), and which averages there are (N,).
        """
        places = points[:, : self._d].to(self._points)
        parts = [self._guess(part) for part in places.split(max(1, _AT_ONCE // max(len(self._points), _KEYS)))]
        averages, first, known = (torch.cat(part) for part in zip(*parts, strict=True))
        return averages, first.cpu().numpy(), known.cpu().numpy()

    def _guess(self, places: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        distances, nearest = self._nearest(places)
        near = distances[:, : self._k].clamp_min(1e-12)
        reach = distances[:, self._k :].clamp_max(FARTHEST * self._radius)
        # where there is no next one, 1 / d
        weights = torch.where(reach.isfinite(), (reach / near - 1.0).clamp_min(0.0), 1.0 / near)
        weights = weights * self._largest_part(nearest, weights > 0.0)
        sums = embedding_bag(nearest, self._embedded, per_sample_weights=weights, mode="sum")
        known = (distances[:, 0] <= self._radius) & (weights.sum(1) > 0.0)
        return average(sums, self._continuous), nearest[:, 0], known

    def _nearest(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Distances (N, k + 1) of the nearest vertices, infinite where there are no more, and ranks (N, k)."""
        # in single precision, then among a few more than are wanted in double
        squared = places.new_zeros(len(places), len(self._points), dtype=torch.float32)
        centred = ((part - self._points.mean(0)).float().unbind(1) for part in (places, self._points))
        for place, of_all in zip(*centred, strict=True):
            squared.add_((place[:, None] - of_all).square_())
        index = squared.topk(min(self._k + 1 + _SPARE, len(self._points)), largest=False, sorted=False).indices
        apart, order = (places[:, None] - self._points[index]).norm(dim=2).sort(dim=1)
        beyond = apart.new_full((len(places), max(0, self._k + 1 - apart.shape[1])), torch.inf)
        distances = torch.cat([apart, beyond], dim=1)[:, : self._k + 1]
        return distances, index.gather(1, order)[:, : self._k]

    def _largest_part(self, nearest: Tensor, counts: Tensor) -> Tensor:
        """Which of the vertices (N, k) that count lie in the largest part connected by edges among them."""
        k = nearest.shape[1]
        keys = self._key(nearest[:, :, None], nearest[:, None, :])
        joined = torch.zeros_like(keys, dtype=torch.bool)
        if len(self._joined):
            joined = self._joined[torch.searchsorted(self._joined, keys).clamp_max(len(self._joined) - 1)] == keys
        joined = (joined | torch.eye(k, dtype=torch.bool, device=keys.device)) & counts[:, :, None] & counts[:, None, :]
        for _ in range((k - 1).bit_length()):
            # paths of twice as many edges
            steps = joined.to(torch.float32)
            joined = torch.bmm(steps, steps) > 0.0
        # the first of equals
        largest = joined.sum(2).argmax(1)
        return joined.take_along_dim(largest[:, None, None], dim=1)[:, 0]

    def _key(self, first: Tensor, second: Tensor) -> Tensor:
        """One number for a pair of vertices."""
        return first * len(self._points) + second
