"""Sphere self-collision of many configurations at once: one bounding sphere a link first, then the near pairs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from grr_torch.robots.kinematics import Frame, KinematicTree
from grr_torch.robots.spheres import Sphere, SphereModel

# sphere-pair distances held at once: they should stay in the cache
_PAIRS_AT_ONCE = 1 << 17
# configurations whose link poses are held at once
_COLUMNS_AT_ONCE = 4096


class _Body(NamedTuple):
    """The spheres of one link: rows start … start + spheres of its frame's points; row `start` bounds them all."""

    frame: int
    start: int
    spheres: int


@dataclass(frozen=True, eq=False)
class SphereKernel:
    """Constants of a sphere model over a kinematic tree.

    Attributes:
        points: For each frame that has spheres, (K, 4) homogeneous centres in that frame [m].
        radii: For each frame that has spheres, (K, 1) radii [m].
        bodies: The links that take part.
        pairs: (2, P) indices into `bodies`: the pairs that are checked.
        bounds: (P, 1) sums of the bounding radii of each pair [m].
        cores: For each body the row of the sphere nearest to its bounding centre.
    """

    points: dict[int, Tensor]
    radii: dict[int, Tensor]
    bodies: tuple[_Body, ...]
    pairs: Tensor
    bounds: Tensor
    cores: tuple[int, ...]

    @staticmethod
    def compile(model: SphereModel, tree: KinematicTree, like: Tensor) -> SphereKernel | None:
        """Prepares a model; None if no two links that can move against each other are to be checked."""
        pairs = [pair for pair in model.checked if tree.links[pair[0]][0] != tree.links[pair[1]][0]]
        names = [link for link in model.spheres if any(link in pair for pair in pairs)]
        if not pairs:
            return None
        points: dict[int, list[Tensor]] = {}
        radii: dict[int, list[Tensor]] = {}
        bodies: list[_Body] = []
        cores: list[int] = []
        for link in names:
            frame, pose = tree.links[link]
            centres, sizes = _with_bound(model.spheres[link])
            start = sum(map(len, points.setdefault(frame, [])))
            points[frame].append(centres.to(pose) @ pose.T)
            radii.setdefault(frame, []).append(sizes.to(pose))
            bodies.append(_Body(frame, start, len(sizes) - 1))
            cores.append(start + 1 + int((centres[1:] - centres[0]).norm(dim=1).argmin()))
        index = like.new_tensor([[names.index(link) for link in side] for side in zip(*pairs, strict=True)])
        bound = torch.stack([radii[body.frame][_position(bodies, body)][0] for body in bodies])
        index = index.long()
        return SphereKernel(
            {frame: torch.cat(parts).contiguous() for frame, parts in points.items()},
            {frame: torch.cat(parts)[:, None] for frame, parts in radii.items()},
            tuple(bodies),
            index,
            (bound[index[0]] + bound[index[1]])[:, None],
            tuple(cores),
        )

    def distance(self, frames: Sequence[Frame]) -> Tensor:
        """Signed distance (N,) [m] of the closest checked pair of links.

        Pairs are skipped where their bounding spheres are farther apart than two of the robot's spheres are.
        """
        centres = self._centres(frames)
        with torch.no_grad():
            lower = self._bound_distances(centres)
            cutoff = self._core_distances(centres).amin(0)
        columns: list[Tensor] = []
        distances: list[Tensor] = []
        for pair, near in enumerate(lower <= cutoff):
            for chunk, squared, reach in self._sphere_pairs(centres, pair, near.nonzero()[:, 0]):
                columns.append(chunk)
                # the floor keeps the gradient finite where two centres coincide
                distances.append((squared.clamp_min(1e-24).sqrt() - reach).flatten(0, 1).amin(0))
        result = torch.where(cutoff.isnan(), torch.nan, torch.inf).to(lower)
        if not columns:
            return result
        return result.scatter_reduce(0, torch.cat(columns), torch.cat(distances), "amin")

    def collides(self, tree: KinematicTree, q: Tensor, margin: float) -> Tensor:
        """Whether any checked pair of links is nearer than `margin` [m]: (N,) bool for columns q (n, N)."""
        return torch.cat([self._collides(tree.frames(part), margin) for part in q.split(_COLUMNS_AT_ONCE, dim=1)])

    def _collides(self, frames: Sequence[Frame], margin: float) -> Tensor:
        centres = self._centres(frames)
        bound_distances = self._bound_distances(centres)
        near_pairs = bound_distances < margin
        hit = bound_distances.isnan().any(0)
        for pair in near_pairs.any(1).nonzero()[:, 0].tolist():
            near = (near_pairs[pair] & ~hit).nonzero()[:, 0]
            for chunk, squared, reach in self._sphere_pairs(centres, pair, near):
                hit[chunk] = (squared < (reach + margin) ** 2).flatten(0, 1).any(0)
        return hit

    def _centres(self, frames: Sequence[Frame]) -> dict[int, Tensor]:
        """Sphere centres (K, 3, N) of each frame."""
        return {frame: frames[frame].place(points) for frame, points in self.points.items()}

    def _bound_distances(self, centres: dict[int, Tensor]) -> Tensor:
        """(P, N) distances [m] of the bounding spheres of each pair: never more than that of the spheres inside."""
        bounds = torch.stack([centres[body.frame][body.start] for body in self.bodies])
        return (bounds[self.pairs[0]] - bounds[self.pairs[1]]).norm(dim=1) - self.bounds

    def _core_distances(self, centres: dict[int, Tensor]) -> Tensor:
        """(P, N) distances [m] of one sphere of each link: never less than that of the pair."""
        cores = torch.stack([centres[b.frame][core] for b, core in zip(self.bodies, self.cores, strict=True)])
        radii = torch.stack([self.radii[b.frame][core] for b, core in zip(self.bodies, self.cores, strict=True)])
        first, second = self.pairs
        return (cores[first] - cores[second]).norm(dim=1) - (radii[first] + radii[second])

    def _sphere_pairs(
        self, centres: dict[int, Tensor], pair: int, columns: Tensor
    ) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Columns, squared centre distances (A, B, M) and radius sums (A, B, 1) of one pair, in chunks."""
        first, second = (self.bodies[int(side)] for side in self.pairs[:, pair])
        rows_a, rows_b = _rows(first), _rows(second)
        reach = self.radii[first.frame][rows_a][:, None] + self.radii[second.frame][rows_b]
        for chunk in columns.split(max(1, _PAIRS_AT_ONCE // (first.spheres * second.spheres))):
            if chunk.numel() == 0:
                return
            a = centres[first.frame][rows_a][:, :, chunk].unbind(1)
            b = centres[second.frame][rows_b][:, :, chunk].unbind(1)
            squared = (a[0][:, None] - b[0]).square()
            for axis in (1, 2):
                squared = squared + (a[axis][:, None] - b[axis]).square()
            yield chunk, squared, reach


def _rows(body: _Body) -> slice:
    return slice(body.start + 1, body.start + 1 + body.spheres)


def _position(bodies: Sequence[_Body], body: _Body) -> int:
    """How many bodies of the same frame come before this one."""
    return sum(1 for other in bodies if other.frame == body.frame and other.start < body.start)


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
