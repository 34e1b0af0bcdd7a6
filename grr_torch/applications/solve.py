"""The roadmap as an IK solver: the paper's Algorithm 3 for any point of the task space (Section IV-E)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import embedding_bag

from grr_torch.applications.around import Around, AroundProduct
from grr_torch.applications.joined import Joined
from grr_torch.applications.many_guesses import MOST_VERTICES, ManyGuesses
from grr_torch.errors import ParameterError
from grr_torch.pieces import FEW, Array, Mask, cores, one_thread
from grr_torch.progress import Progress, silent
from grr_torch.projection.columns import damped_least_squares
from grr_torch.projection.project import Tolerances, point_columns, project_columns
from grr_torch.spaces.configuration import average, average_of_few, difference, embed
from grr_torch.spaces.graph import find_lattice
from grr_torch.spaces.pyramids import pyramid_corners, pyramid_weights, whole_pyramids

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap

# what a status says; the first two are those of valid configurations
STATUSES = ("solved", "uncertified", "outside", "too far", "not converged", "off the map", "self-collision", "no cell")
_SOLVED, _UNCERTIFIED, _OUTSIDE, _TOO_FAR, _NOT_CONVERGED, _OFF_THE_MAP, _SELF_COLLISION, _ = range(len(STATUSES))
# configurations of these statuses and those before are valid
LAST_VALID = _UNCERTIFIED

# points worked on together, on the CPU and on a GPU: enough that the few that do not converge cost little beside them,
# and on the CPU, where rotation varies and a point has three times as many vertices around it, fewer for the memory
_AT_ONCE, _TURNING, _ON_GPU = 1 << 14, 1 << 12, 1 << 16
# a corner of a pyramid that has no more weight at a point has none: the point is on a face without it
_ON_FACE = 1e-9
# radians of self-motion from the average beyond which a configuration is none of the map's
_OFF_MAP = 0.5


@dataclass(frozen=True, eq=False)
class Solution:
    """What a roadmap says of points.

    Attributes:
        configurations: (*batch, n) configurations; NaN where not valid.
        valid: (*batch,) bool: the tool is at the point, within limits and free of self-collision.
        status: (*batch,) array of text. Of valid ones: "solved", or "uncertified" in a cell inside which the map may
            not be continuous, or of which a corner is not resolved (where rotation varies, or without a grid, next to
            a corner of a cell of the first kind, as far as cells were measured). Of
            others: "outside" the roadmap's bounds, "too far" from every resolved vertex, "not converged", "off the
            map", where the projection ends in another posture than the vertices around have, or in "self-collision";
            and of the differentiable map, "no cell" where a corner of the cell is not resolved or an edge of it is
            broken.
    """

    configurations: Tensor
    valid: Tensor
    status: np.ndarray[Any, np.dtype[np.str_]]


class Solver:
    """A roadmap's tables for guesses at any point. `Roadmap.solve` is what to call.

    A guess is the circular average over the k nearest resolved vertices, weighted by r / d − 1, where r is the distance
    of the next one. Like those of Algorithm 3, (max d / d)², these weights make it the vertex's configuration at a
    vertex; but they vanish where a vertex leaves the set, so the guess does not jump, and it is less flat round each
    vertex and less steep between them.
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
        kept = (part.to(self.robot.dtype) for part in (roadmap.points, roadmap.configurations))
        self.points, self.configurations = kept
        self.vertices = vertices
        self.low = points.amin(0)
        slack = 1e-9
        self.bounds = self.low.numpy() - slack, points.amax(0).numpy() + slack
        self.radius = roadmap.longest_edge
        turning = self.task.rotations is not None
        self._around = (AroundProduct if turning else Around)(roadmap, vertices, self.radius)
        many = self.robot.device.type != "cpu" and not turning and len(vertices) <= MOST_VERTICES
        self._many = ManyGuesses(roadmap, vertices, self.radius) if many else None
        self._continuous = self.robot.continuous.cpu()
        self._embedded = embed(roadmap.configurations[vertices].to(torch.float64), self._continuous)
        self._embedded_array, self._continuous_array = self._embedded.numpy(), self._continuous.numpy()
        self._joined = Joined(roadmap, vertices)
        # where rotation varies, suspects are looked up by their nearest vertices
        self._lattice, self._resolved = None if turning else find_lattice(roadmap.points), roadmap.resolved
        self._suspect = self._uncertified_places(roadmap)
        if self._lattice is not None:
            # what is outside lacks nothing
            lacking = ~whole_pyramids(self._lattice, self._resolved)
            self._lacking = torch.cat([lacking, lacking.new_zeros(1)])

    def __call__(self, points: Tensor, *, progress: Progress = silent) -> Solution:
        """`Roadmap.solve`."""
        columns = point_columns(self.robot, self.task, points.detach() if isinstance(points, Tensor) else points)
        batch, count = points.shape[:-1], columns.shape[1]
        q = columns.new_empty(count, self.robot.n)
        codes = torch.empty(count, dtype=torch.uint8)
        done = 0
        progress("solving", done, count)
        for solved, found in self._in_parts(columns):
            part = slice(done, done + len(found))
            q[part], codes[part] = solved.T, found
            done = part.stop
            progress("solving", done, count)
        status = np.array(STATUSES)[codes.numpy()].reshape(batch)
        valid = (codes <= LAST_VALID).to(q.device)
        return Solution(q.reshape(*batch, self.robot.n), valid.reshape(batch), status)

    def _in_parts(self, columns: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """`solve_columns` for parts of points (width, N), one after the other.

        On the CPU as many are worked on at a time as torch has threads: with so many points calls are long, and Python
        can do something else meanwhile.
        """
        on_cpu = columns.device.type == "cpu"
        size = _AT_ONCE if self.task.rotations is None else _TURNING
        parts = columns.split(size if on_cpu else _ON_GPU, dim=1)
        with one_thread():
            if len(parts) == 1 or not on_cpu:
                yield from map(self.solve_columns, parts)
                return
            with ThreadPoolExecutor(cores()) as threads:
                yield from threads.map(self.solve_columns, parts)

    def solve_columns(self, targets: Tensor) -> tuple[Tensor, Tensor]:
        """Configurations (n, N), NaN where not valid, and indices into STATUSES (N,) for points (width, N).

        Where that comes to nothing, as near a vertex that lies in the smaller part itself, the part of the nearest
        vertex is tried.
        """
        points = targets.T.cpu().to(torch.float64)
        q, codes = self.solve_from(targets, *self.guess(points))
        failed = (codes >= _NOT_CONVERGED).nonzero()[:, 0]
        if len(failed):
            again, second = self.solve_from(targets[:, failed], *self.guess(points[failed], of_nearest=True))
            good = second <= LAST_VALID
            q[:, failed[good]], codes[failed[good]] = again[:, good], _UNCERTIFIED
        return q, codes

    def solve_from(self, targets: Tensor, guesses: Tensor, codes: Tensor) -> tuple[Tensor, Tensor]:
        """`solve_columns` from what `guess` gave."""
        near = (codes <= LAST_VALID).nonzero()[:, 0].to(targets.device)
        q = targets.new_full((self.robot.n, len(guesses)), torch.nan)
        solved, valid = project_columns(
            self.robot,
            self.task,
            targets[:, near],
            guesses.to(targets)[near].T.contiguous(),
            self.tolerances,
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

    # points beyond all numbers are outside
    @np.errstate(over="ignore", invalid="ignore")
    def guess(self, points: Tensor, *, certified: bool = True, of_nearest: bool = False) -> tuple[Tensor, Tensor]:
        """Averages (N, n) for points (N, width) on the CPU, and what is known of the points so far (N,).

        The averages may be on the robot's device. 2n multiply-adds a neighbour, and the search for the connected ones.
        Whether the points' cells are certified is looked up only if asked for. The averages are over the largest part
        of the vertices around, or over that `of_nearest`.
        """
        positions = points[:, : self.task.dimension].numpy()
        many = None if of_nearest else self._many
        averages, nearest, known = self._known(points, of_nearest) if many is None else many(points)
        codes = np.full(len(points), _SOLVED, dtype=np.uint8)
        if certified:
            self._mark_uncertified(codes, positions, nearest)
        codes[~known] = _TOO_FAR
        codes[((positions < self.bounds[0]) | (positions > self.bounds[1])).any(1)] = _OUTSIDE
        return averages, torch.from_numpy(codes)

    def _known(self, points: Tensor, of_nearest: bool) -> tuple[Tensor, Array, Mask]:
        """Averages (N, n) for points (N, width), their nearest vertices' ranks (N,), and which there are (N,)."""
        nearest, weights, near = self._around.weigh(points)
        weights = weights * self._joined.one_part(nearest, weights > 0.0, of_nearest)
        return self._averages(nearest, weights), nearest[:, 0], near & (weights.sum(1) > 0.0)

    def _averages(self, nearest: Array, weights: Array) -> Tensor:
        """(N, n) circular averages over vertices (N, k), weighted (N, k)."""
        if len(nearest) <= FEW:
            sums = np.matmul(weights[:, None], self._embedded_array[nearest])[:, 0]
            return torch.from_numpy(average_of_few(sums, self._continuous_array))
        indices, counts = torch.from_numpy(nearest), torch.from_numpy(weights)
        sums = embedding_bag(indices, self._embedded, per_sample_weights=counts, mode="sum")
        return average(sums, self._continuous)

    def on_map(self, q: Tensor, guesses: Tensor) -> Tensor:
        """Whether configurations (N, n) are the map's, (N,), as far as the averages (N, n) that led to them tell.

        A projection that ends far from its guess along the self-motion manifold has left the map for a posture that
        its vertices do not have. How far it went to reach the point does not count.
        """
        motion = difference(guesses, q, self.robot.continuous)
        lengths = motion.square().sum(1)
        far = (lengths > _OFF_MAP**2).nonzero()[:, 0]
        result = lengths.isfinite()
        if len(far):
            columns = motion[far].T
            frames = self.robot.tree.frames(q[far].T.contiguous())
            points = self.task.at(*self.robot.tree.tool_pose(frames))
            jacobian = self.task.jacobian(self.robot.tree.jacobian(frames), points)
            moved = (jacobian * columns).sum(1)
            across = damped_least_squares(jacobian, moved, torch.full_like(moved[0], 1e-6))
            result[far] &= (columns - across).norm(dim=0) <= _OFF_MAP
        return result

    def nearest(self, points: Tensor, k: int = 1) -> tuple[Tensor, Tensor]:
        """The k nearest resolved vertices of points (N, width) on the CPU: distances (N, k) and vertices (N, k)."""
        distances, index = self._around.nearest(points, k)
        return distances, self.vertices[index]

    def _mark_uncertified(self, codes: NDArray[np.uint8], positions: NDArray[Any], nearest: NDArray[Any]) -> None:
        """Sets the codes of points in uncertified cells: by their pyramids in a grid, else by their nearest vertex.

        In a grid, no more is known where a pyramid lacks a corner, but for its faces that do not have that.
        """
        if self._lattice is None:
            codes[self._suspect[nearest].numpy()] = _UNCERTIFIED
            return
        offsets = torch.from_numpy(positions) - self.low
        places = self._lattice.pyramids(offsets)
        suspect = self._suspect[places]
        rows = self._lacking[places].nonzero()[:, 0]
        if len(rows):
            lacking = ~self._resolved[pyramid_corners(self._lattice, places[rows])]
            weights = pyramid_weights(self._lattice, offsets[rows], places[rows])
            suspect[rows] |= (lacking & (weights > _ON_FACE)).any(1)
        codes[suspect.numpy()] = _UNCERTIFIED

    def _uncertified_places(self, roadmap: Roadmap) -> Tensor:
        """(P,) bool by pyramid, the last one for what is outside; without a grid, (R,) by resolved vertex."""
        if self._lattice is None:
            corners = torch.cat([cells.reshape(-1) for cells in roadmap.uncertified])
            return torch.isin(self.vertices, corners)
        suspect = torch.zeros(2 * len(self._lattice.cells) * math.prod(self._lattice.cells) + 1, dtype=torch.bool)
        for corners in roadmap.uncertified:
            suspect[self._lattice.pyramids_at(corners)] = True
        return suspect
