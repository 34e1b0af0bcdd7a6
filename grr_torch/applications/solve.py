"""The roadmap as an IK solver: the paper's Algorithm 3 for any point of the task space (Section IV-E)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import embedding_bag

from grr_torch.errors import ParameterError
from grr_torch.pieces import one_thread
from grr_torch.progress import Progress, silent
from grr_torch.projection.columns import damped_least_squares
from grr_torch.projection.project import Tolerances, point_columns, project_columns
from grr_torch.spaces.configuration import average, difference, embed
from grr_torch.spaces.graph import find_lattice

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap

# what a status says; the first two are those of valid configurations
STATUSES = ("solved", "uncertified", "outside", "too far", "not converged", "off the map", "self-collision")
_SOLVED, _UNCERTIFIED, _OUTSIDE, _TOO_FAR, _NOT_CONVERGED, _OFF_THE_MAP, _SELF_COLLISION = range(len(STATUSES))

# points worked on together
_AT_ONCE = 1 << 12
# a guess averages over so many vertices, in the plane and in space: a grid's first two shells
_NEIGHBOURS = {2: 8, 3: 14}
# the most vertices of which a matrix of neighbours is made: 16 MiB
_MATRIX = 4096
# no vertex farther than so many of the longest edges counts, and one must lie within one of them
_FARTHEST = 1.5
# radians of self-motion from the average beyond which a configuration is none of the map's
_OFF_MAP = 0.5


@dataclass(frozen=True, eq=False)
class Solution:
    """What a roadmap says of points.

    Attributes:
        configurations: (*batch, n) configurations; NaN where not valid.
        valid: (*batch,) bool: the tool is at the point, within limits and free of self-collision.
        status: (*batch,) array of text. Of valid ones: "solved", or "uncertified" in a cell inside which the map may
            not be continuous. Of others: "outside" the roadmap's bounds, "too far" from every resolved vertex, "not
            converged", "off the map", where the projection ends in another posture than the vertices around have, or
            in "self-collision".
    """

    configurations: Tensor
    valid: Tensor
    status: np.ndarray[Any, np.dtype[np.str_]]


class Solver:
    """A roadmap's tables for guesses at any point. `Roadmap.solve` is what to call.

    A guess is the circular average over the k nearest resolved vertices, weighted by (r / d − 1)², where r is the
    distance of the next one. So weights are those of Algorithm 3, (max d / d)², but vanish where a vertex leaves the
    set, and the guess does not jump: with the paper's, steps along dense lines reach five times the slope.
    """

    def __init__(self, roadmap: Roadmap) -> None:
        """Makes the tables.

        Raises:
            ParameterError: No vertex is resolved.
        """
        self.robot, self.task = roadmap.robot, roadmap.task
        self.tolerances = Tolerances(**roadmap.parameters["tolerances"])
        vertices = roadmap.resolved.nonzero()[:, 0]
        if len(vertices) == 0:
            raise ParameterError("roadmap", "one without a resolved vertex", "one to solve with")
        points = roadmap.points[:, : self.task.dimension]
        self.points, self.configurations, self.vertices = roadmap.points, roadmap.configurations, vertices
        self.low, self.high = points.amin(0), points.amax(0)
        self.radius = roadmap.longest_edge
        # a balanced tree takes twice as long to make and is no faster here
        self._tree = cKDTree(points[vertices].numpy(), balanced_tree=False)
        self._embedded = embed(roadmap.configurations[vertices], self.robot.continuous.cpu())
        self._neighbours = roadmap.neighbours
        self._joined = _neighbour_matrix(roadmap, vertices) if len(vertices) <= _MATRIX else None
        self._lattice = find_lattice(roadmap.points)
        self._suspect = self._uncertified_places(roadmap)

    def __call__(self, points: Tensor, *, progress: Progress = silent) -> Solution:
        """`Roadmap.solve`."""
        columns = point_columns(self.robot, self.task, points)
        batch, count = points.shape[:-1], columns.shape[1]
        q = columns.new_empty(count, self.robot.n)
        codes = torch.empty(count, dtype=torch.uint8)
        with one_thread():
            for start in range(0, count, _AT_ONCE):
                progress("solving", start, count)
                part = slice(start, start + _AT_ONCE)
                solved, codes[part] = self.solve_columns(columns[:, part])
                q[part] = solved.T
        progress("solving", count, count)
        status = np.array(STATUSES)[codes.numpy()].reshape(batch)
        valid = (codes <= _UNCERTIFIED).to(q.device)
        return Solution(q.reshape(*batch, self.robot.n), valid.reshape(batch), status)

    def solve_columns(self, targets: Tensor) -> tuple[Tensor, Tensor]:
        """Configurations (n, N), NaN where not valid, and indices into STATUSES (N,) for points (width, N)."""
        return self.solve_from(targets, *self.guess(targets.T.cpu().to(torch.float64)))

    def solve_from(
        self, targets: Tensor, guesses: Tensor, codes: Tensor, tolerances: Tolerances | None = None
    ) -> tuple[Tensor, Tensor]:
        """`solve_columns` from what `guess` gave."""
        near = (codes <= _UNCERTIFIED).nonzero()[:, 0].to(targets.device)
        q = targets.new_full((self.robot.n, len(guesses)), torch.nan)
        solved, valid = project_columns(
            self.robot,
            self.task,
            targets[:, near],
            guesses.to(targets)[near].T.contiguous(),
            tolerances or self.tolerances,
            check_collision=False,
        )
        codes[near[~valid].cpu()] = _NOT_CONVERGED
        near, solved = near[valid], solved[:, valid]
        kept = self.on_map(solved.T, guesses.to(targets)[near])
        codes[near[~kept].cpu()] = _OFF_THE_MAP
        near, solved = near[kept], solved[:, kept]
        hit = self.robot.columns_in_self_collision(solved)
        codes[near[hit].cpu()] = _SELF_COLLISION
        q[:, near[~hit]] = solved[:, ~hit]
        return q, codes

    def guess(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Averages (N, n) for points (N, width) on the CPU, and what is known of the points so far (N,).

        2n multiply-adds a neighbour, and k³ a doubling of the paths by which connected vertices are found.
        """
        positions = points[:, : self.task.dimension]
        k = min(_NEIGHBOURS[self.task.dimension], len(self.vertices))
        # the one after the k-th is at infinity where there is none
        found = self._tree.query(positions.numpy(), k=range(1, k + 2))
        distances, nearest = torch.from_numpy(found[0]), torch.from_numpy(found[1])[:, :k]
        reach = distances[:, k:].clamp_max(_FARTHEST * self.radius)
        weights = (reach / distances[:, :k].clamp_min(1e-12) - 1.0).clamp_min_(0.0).square_()
        if not math.isfinite(self.radius):
            weights = distances[:, :k].clamp_min(1e-12).square().reciprocal()
        weights *= self._largest_part(nearest)
        sums = embedding_bag(nearest, self._embedded, per_sample_weights=weights, mode="sum")
        codes = torch.full((len(points),), _SOLVED, dtype=torch.uint8)
        if self._suspect is not None:
            codes[self._suspect[self._place(positions, nearest[:, 0])]] = _UNCERTIFIED
        codes[(distances[:, 0] > self.radius) | ~(weights.sum(1) > 0.0)] = _TOO_FAR
        slack = 1e-9
        codes[((positions < self.low - slack) | (positions > self.high + slack)).any(1)] = _OUTSIDE
        return average(sums, self.robot.continuous.cpu()), codes

    def on_map(self, q: Tensor, guesses: Tensor) -> Tensor:
        """Whether configurations (N, n) are the map's, (N,), as far as the averages (N, n) that led to them tell.

        A projection that ends far from its guess along the self-motion manifold has left the map for a posture that
        its vertices do not have. How far it went to reach the point does not count.
        """
        motion = difference(guesses, q, self.robot.continuous)
        far = (motion.norm(dim=1) > _OFF_MAP).nonzero()[:, 0]
        result = q.isfinite().all(1)
        if len(far):
            columns = motion[far].T
            jacobian = self.task.jacobian(self.robot.tree.jacobian(self.robot.tree.frames(q[far].T.contiguous())))
            moved = (jacobian * columns).sum(1)
            across = damped_least_squares(jacobian, moved, torch.full_like(moved[0], 1e-6))
            result[far] &= (columns - across).norm(dim=0) <= _OFF_MAP
        return result

    def nearest(self, points: Tensor, k: int = 1) -> tuple[Tensor, Tensor]:
        """The k nearest resolved vertices of points (N, width) on the CPU: distances (N, k) and vertices (N, k)."""
        positions = points[:, : self.task.dimension].numpy()
        distances, index = self._tree.query(positions, k=range(1, min(k, len(self.vertices)) + 1))
        return torch.from_numpy(distances), self.vertices[torch.from_numpy(index)]

    def _largest_part(self, nearest: Tensor) -> Tensor:
        """Which of the vertices (N, k) lie in the largest part connected by edges among them; the nearest of equals."""
        k = nearest.shape[1]
        if self._joined is not None:
            paths = self._joined[nearest[:, :, None], nearest[:, None, :]].float()
        else:
            near = self.vertices[nearest].to(torch.int32)
            paths = (self._ends(near)[..., None] == near[:, None, None, :]).any(2).float()
        paths.diagonal(dim1=1, dim2=2).fill_(1.0)
        for _ in range(math.ceil(math.log2(max(k, 2)))):
            paths = (paths @ paths).clamp_max_(1.0)
        sizes = paths.sum(2) * k - torch.arange(k)
        return paths[torch.arange(len(paths)), sizes.argmax(1)]

    def _ends(self, vertices: Tensor) -> Tensor:
        """(N, k, D) neighbours along connected edges of vertices (N, k); −1 where there are fewer."""
        starts, ends = self._neighbours
        first = starts[vertices]
        counts = starts[vertices + 1] - first
        column = torch.arange(max(1, int(counts.max()) if counts.numel() else 1))
        index = (first[..., None] + column).clamp_max_(max(len(ends) - 1, 0))
        found = ends[index] if len(ends) else torch.zeros_like(index, dtype=torch.int32)
        return found.masked_fill_(column >= counts[..., None], -1)

    def _place(self, positions: Tensor, nearest: Tensor) -> Tensor:
        """Where in the table of suspects points are looked up: their pyramids in a grid, else their nearest vertex."""
        if self._lattice is None:
            return nearest
        return self._lattice.pyramids(positions - self.low)

    def _uncertified_places(self, roadmap: Roadmap) -> Tensor | None:
        """(P,) bool by `_place`, the last one false for what is outside; None if every cell is certified."""
        cells = [corners for corners in roadmap.uncertified if len(corners)]
        if not cells:
            return None
        if self._lattice is None:
            suspect = torch.zeros(len(roadmap.points), dtype=torch.bool)
            for corners in cells:
                suspect[corners] = True
            return suspect[self.vertices]
        suspect = torch.zeros(2 * len(self._lattice.cells) * math.prod(self._lattice.cells) + 1, dtype=torch.bool)
        for corners in cells:
            suspect[self._lattice.pyramids_at(corners)] = True
        return suspect


def _neighbour_matrix(roadmap: Roadmap, vertices: Tensor) -> Tensor:
    """(R, R) bool, which resolved vertices a connected edge joins: faster to look up, where it is not too large."""
    rank = torch.full((len(roadmap.points),), -1)
    rank[vertices] = torch.arange(len(vertices))
    first, second = rank[roadmap.edges[roadmap.connected]].T
    joined = torch.zeros(len(vertices), len(vertices), dtype=torch.bool)
    joined[first, second] = True
    joined[second, first] = True
    return joined
