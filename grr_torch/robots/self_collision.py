"""Sphere self-collision of many configurations at once: one bounding sphere a link first, then the near pairs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from grr_torch.robots.few_self_collision import FewSpheres
from grr_torch.robots.kinematics import KinematicTree, place
from grr_torch.robots.spheres import Sphere, SphereModel

# sphere-pair distances held at once: on the CPU they should stay in the cache
_PAIRS_ON_CPU = 1 << 17
_PAIRS_ON_GPU = 1 << 26
# of no more pairs, links filled up to equally many spheres, numpy that places all spheres is faster (but near contact,
# where it takes up to twice as long), unless filling up makes them so many times as many
_PAIRS_OF_FEW = 6 << 20
_FILLED = 4


class _Pair(NamedTuple):
    """Two links that are checked against each other.

    Attributes:
        first: (A, 5) rows −2x, −2y, −2z, |a|², 1 of the first link's spheres, in its frame.
        second: (B, 4) homogeneous centres of the second link's spheres, in its frame [m].
        reach: (A, B, 1) sums of radii [m].
    """

    first: Tensor
    second: Tensor
    reach: Tensor

    def squared_distances(self, relative: Tensor) -> Iterator[tuple[slice, Tensor]]:
        """Squared centre distances (A, B, M) for pieces of poses (4, 3, M) of the second frame in the first.

        |a|² − 2 a·b + |b|² as one matrix product: 5 multiply-adds a pair of spheres.
        """
        at_once = max(1, (_PAIRS_ON_CPU if relative.device.type == "cpu" else _PAIRS_ON_GPU) // self.reach.numel())
        for start in range(0, relative.shape[2], at_once):
            part = relative[:, :, start : start + at_once]
            b = place(part, self.second).transpose(0, 1)
            rows = torch.cat([b, torch.ones_like(b[:1]), b.square().sum(0, keepdim=True)])
            squared = torch.mm(self.first, rows.view(5, -1)).view(len(self.first), *b.shape[1:])
            yield slice(start, start + b.shape[2]), squared


@dataclass(frozen=True, eq=False)
class SphereKernel:
    """Constants of a sphere model over a kinematic tree.

    Attributes:
        bounds: (L, 1, 4) homogeneous centres of spheres that hold all of a link's, in its frame [m].
        cores: (L, 1, 4) and for each link the centre of the one of its spheres that is nearest to that.
        frames: (L,) frame of each link.
        names: The P pairs of links that are checked.
        pairs: (2, P) indices of these.
        bound_reach: (P, 1) sums of the bounding radii of each pair [m].
        core_reach: (P, 1) sums of the core spheres' radii [m].
        spheres: For each pair, its spheres.
        levers: (P, n) how far the bounding spheres of each pair move against each other, at most, when an entry of the
            configuration moves by so much [m/rad or 1].
    """

    bounds: Tensor
    cores: Tensor
    frames: Tensor
    names: tuple[tuple[str, str], ...]
    pairs: Tensor
    bound_reach: Tensor
    core_reach: Tensor
    spheres: tuple[_Pair, ...]
    levers: Tensor

    @staticmethod
    def compile(model: SphereModel, tree: KinematicTree, like: Tensor) -> SphereKernel | None:
        """Prepares a model; None if no two links that can move against each other are to be checked."""
        pairs = [pair for pair in model.checked if tree.links[pair[0]][0] != tree.links[pair[1]][0]]
        names = [link for link in model.spheres if any(link in pair for pair in pairs)]
        if not pairs:
            return None
        centres: dict[str, Tensor] = {}
        radii: dict[str, Tensor] = {}
        cores: dict[str, int] = {}
        for link in names:
            local, sizes = _with_bound(model.spheres[link])
            centres[link], radii[link] = local.to(like) @ tree.links[link][1], sizes.to(like)
            cores[link] = 1 + int((local[1:] - local[0]).norm(dim=1).argmin())
        index = torch.tensor([[names.index(link) for link in side] for side in zip(*pairs, strict=True)])
        bound_radii = torch.stack([radii[link][0] for link in names])
        core_radii = torch.stack([radii[link][cores[link]] for link in names])
        index = index.to(like.device)
        return SphereKernel(
            bounds=torch.stack([centres[link][:1] for link in names]),
            cores=torch.stack([centres[link][cores[link]][None] for link in names]),
            frames=torch.tensor([tree.links[link][0] % (len(tree.joints) + 2) for link in names], device=like.device),
            names=tuple(pairs),
            pairs=index,
            bound_reach=bound_radii[index].sum(0)[:, None],
            core_reach=core_radii[index].sum(0)[:, None],
            spheres=tuple(_pair(centres, radii, *pair) for pair in pairs),
            levers=torch.stack([_levers(tree, centres, *pair) for pair in pairs]).to(like),
        )

    def distance(self, frames: Tensor) -> Tensor:
        """Signed distance (N,) [m] of the closest checked pair of links; NaN where a frame is.

        Pairs are skipped where their bounding spheres are farther apart than two of the robot's spheres are.
        """
        with torch.no_grad():
            cutoff = (self._squared(frames, self.cores).sqrt() - self.core_reach).amin(0)
            near = self._squared(frames, self.bounds).sqrt() - self.bound_reach <= cutoff
        columns: list[Tensor] = []
        distances: list[Tensor] = []
        for _, pair, chosen, relative in self._near(frames, near):
            for part, squared in pair.squared_distances(relative):
                columns.append(chosen[part])
                # the floor keeps the gradient finite where two centres coincide
                distances.append((squared.clamp_min(1e-24).sqrt() - pair.reach).flatten(0, 1).amin(0))
        result = torch.where(cutoff.isnan(), torch.nan, torch.inf).to(frames)
        if not columns:
            return result
        return result.scatter_reduce(0, torch.cat(columns), torch.cat(distances), "amin")

    def collides(self, frames: Tensor, margin: float) -> Tensor:
        """Whether any checked pair of links is nearer than `margin` [m]: (N,) bool; true where a frame is NaN."""
        if frames.device.type == "cpu" and frames.shape[3] <= self.most_of_few:
            return torch.from_numpy(self.few.collides(frames.detach().numpy(), margin))
        hit = torch.zeros(frames.shape[3], dtype=torch.bool, device=frames.device)
        for _, columns, touching in self._touching(frames, margin):
            hit[columns] |= touching
        return hit

    def touching(self, frames: Tensor, margin: float) -> Tensor:
        """Which pairs of links are nearer than `margin` [m]: (P, N) bool."""
        hits = torch.zeros(len(self.names), frames.shape[3], dtype=torch.bool, device=frames.device)
        for index, columns, touching in self._touching(frames, margin):
            hits[index, columns] = touching
        return hits

    def _touching(self, frames: Tensor, margin: float) -> Iterator[tuple[int, Tensor, Tensor]]:
        """Of each pair whose bounding spheres are near, which it is, some of its columns (M,), and where it touches."""
        near = ~(self._squared(frames, self.bounds) >= (self.bound_reach + margin).square())
        if not bool(near.any()):
            return
        for index, pair, chosen, relative in self._near(frames, near):
            limit = (pair.reach + margin).square()
            for part, squared in pair.squared_distances(relative):
                yield index, chosen[part], ~(squared >= limit).flatten(0, 1).all(0)

    @cached_property
    def most_of_few(self) -> int:
        """Configurations up to which all spheres are placed by numpy."""
        pairs = sum(pair.reach.numel() for pair in self.spheres)
        filled = len(self.spheres) * max(max(pair.reach.shape[:2]) for pair in self.spheres) ** 2
        return _PAIRS_OF_FEW // filled if filled <= _FILLED * pairs else 0

    @cached_property
    def few(self) -> FewSpheres:
        """For a few configurations on the CPU."""
        return FewSpheres(self)

    def _squared(self, frames: Tensor, points: Tensor) -> Tensor:
        """(P, N) squared distances of one point (L, 1, 4) of each link. 25 multiply-adds a link, 3 a pair."""
        links, width = len(points), frames.shape[3]
        poses = frames.index_select(0, self.frames).reshape(links, 4, 3 * width)
        placed = torch.bmm(points, poses).view(links, 3, width)
        first, second = (placed.index_select(0, side) for side in self.pairs)
        return (first - second).square().sum(1)

    def _near(self, frames: Tensor, near: Tensor) -> Iterator[tuple[int, _Pair, Tensor, Tensor]]:
        """Of each pair with a near column: number, spheres, those columns (M,), poses (4, 3, M), second in first."""
        pairs, columns = near.nonzero().unbind(1)
        first, second = (_take_poses(frames, self.frames[side][pairs], columns) for side in self.pairs)
        # rows of the second frame, its origin relative to the first's, along the axes of the first: 36 multiply-adds
        rows = torch.cat([second[:3], second[3:] - first[3:]])
        relative = (rows[:, None] * first[:3]).sum(2)
        counts = near.sum(1).tolist()
        numbers = range(len(self.spheres))
        parts = zip(numbers, self.spheres, columns.split(counts), relative.split(counts, dim=2), strict=True)
        return (part for part in parts if len(part[2]))


def _take_poses(frames: Tensor, index: Tensor, columns: Tensor) -> Tensor:
    """Poses (4, 3, M) of frame index[m] in column columns[m]."""
    width = frames.shape[3]
    entries = torch.arange(12, device=frames.device)[:, None] * width + (index * (12 * width) + columns)
    return frames.reshape(-1)[entries].view(4, 3, -1)


def _pair(centres: dict[str, Tensor], radii: dict[str, Tensor], first: str, second: str) -> _Pair:
    a = centres[first][1:, :3]
    rows = torch.cat([-2.0 * a, a.square().sum(1, keepdim=True), torch.ones_like(a[:, :1])], dim=1)
    reach = radii[first][1:, None] + radii[second][1:]
    return _Pair(rows, centres[second][1:].contiguous(), reach[..., None])


def _levers(tree: KinematicTree, centres: dict[str, Tensor], first: str, second: str) -> Tensor:
    """(n,) `SphereKernel.levers` of a pair: by the lengths of the chains that move one of the two only."""
    levers = torch.zeros(tree.n, dtype=torch.float64)
    above = [set(tree.above(tree.links[link][0])) for link in (first, second)]
    for link, others in ((first, above[1]), (second, above[0])):
        length = float(centres[link][0, :3].norm())
        for index in tree.above(tree.links[link][0]):
            joint = tree.joints[index]
            if index not in others:
                levers[joint.dof] += abs(joint.multiplier) * (length if joint.revolute else 1.0)
            # what slides has no length that is known
            length = length + float(tree.mounts[index][3, :3].norm()) if joint.revolute else math.inf
    return levers


def _with_bound(spheres: Sequence[Sphere]) -> tuple[Tensor, Tensor]:
    """Homogeneous centres (1 + S, 4) and radii (1 + S,): first a sphere that holds all others."""
    centres = torch.tensor([sphere.center for sphere in spheres], dtype=torch.float64)
    radii = torch.tensor([sphere.radius for sphere in spheres], dtype=torch.float64)
    centre = centres.mean(0)
    for step in range(1, 200):  # Bădoiu–Clarkson: step ever less towards the farthest sphere
        farthest = int(((centres - centre).norm(dim=1) + radii).argmax())
        offset = centres[farthest] - centre
        length = offset.norm()
        if length > 0.0:
            centre = centre + offset / length * (length + radii[farthest]) / (step + 1)
    radius = ((centres - centre).norm(dim=1) + radii).max()
    ones = torch.ones(len(spheres) + 1, 1, dtype=torch.float64)
    return torch.cat([torch.cat([centre[None], centres]), ones], dim=1), torch.cat([radius[None], radii])
