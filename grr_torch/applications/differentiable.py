"""The roadmap as a differentiable function of the point: `Roadmap.solve` with `differentiable=True`.

A point lies in one pyramid of the staggered grid (in the plane, a triangle). The configuration is the one on its
self-motion manifold that is nearest to the average over the pyramid's corners, by their barycentric weights. So inside
a pyramid it is a smooth function of the point, and its derivative is that of the conditions which define it.

On a face between two pyramids only its own corners have weight, so there is no jump, as long as the same ones count on
both sides. Corners that are not resolved, or not joined to the others of the pyramid, do not count.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from grr_torch.applications.nearest import Manifolds, MovedBy
from grr_torch.applications.solve import LAST_VALID, STATUSES, Solution, Solver
from grr_torch.errors import ParameterError
from grr_torch.pieces import one_thread
from grr_torch.progress import Progress, silent
from grr_torch.projection.project import point_columns, project_columns
from grr_torch.spaces.configuration import average, embed, normalise
from grr_torch.spaces.pyramids import pyramid_corners, pyramid_weights
from grr_torch.spaces.task import FixedRotation, Position

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap

_SOLVED, _UNCERTIFIED, _OUTSIDE, _NO_CELL, _NOT_CONVERGED, _OFF_THE_MAP, _SELF_COLLISION = (
    STATUSES.index(name)
    for name in ("solved", "uncertified", "outside", "no cell", "not converged", "off the map", "self-collision")
)
# corners that count must have so much of the weight
_LEAST_WEIGHT = 0.25
# points worked on together
_AT_ONCE = 1 << 12


class DifferentiableSolver:
    """A roadmap's tables for differentiable solving. `Roadmap.solve` is what to call."""

    def __init__(self, roadmap: Roadmap) -> None:
        """Makes the tables.

        Raises:
            ParameterError: The rotation varies over the task, the points are no staggered grid, the robot does not
                compute in float64, or no vertex is resolved.
        """
        if type(roadmap.task) not in (Position, FixedRotation):
            raise ParameterError(
                "task", roadmap.task.kind, f"{Position.kind} or {FixedRotation.kind}, to differentiate"
            )
        if roadmap.robot.dtype != torch.float64:
            raise ParameterError("robot", roadmap.robot.dtype, "torch.float64, to differentiate")
        if roadmap.graph.lattice is None:
            raise ParameterError("roadmap", "one over other points", "one over a staggered grid, to differentiate")
        self._solver: Solver = roadmap.solver
        self._manifolds = Manifolds(roadmap.robot, roadmap.task)
        self._lattice = roadmap.graph.lattice
        self._corners = pyramid_corners(self._lattice)
        self._counted, whole = _parts(roadmap, self._corners)
        resolved = roadmap.resolved[:, None]
        self._embedded = torch.where(resolved, embed(roadmap.configurations, roadmap.robot.continuous.cpu()), 0.0)
        self._suspect = ~whole
        for corners in roadmap.uncertified:
            self._suspect[self._lattice.pyramids_at(corners)] = True

    def __call__(self, points: Tensor, *, progress: Progress = silent) -> Solution:
        """`Roadmap.solve`."""
        robot = self._solver.robot
        columns = point_columns(robot, self._solver.task, points)
        batch, count = points.shape[:-1], columns.shape[1]
        found: list[tuple[Tensor, Tensor]] = []
        with one_thread():
            for start in range(0, max(count, 1), _AT_ONCE):
                progress("solving", start, count)
                found.append(self._solve(columns[:, start : start + _AT_ONCE]))
        progress("solving", count, count)
        q, codes = (torch.cat(parts, -1) for parts in zip(*found, strict=True))
        status = np.array(STATUSES)[codes.numpy()].reshape(batch)
        valid = (codes <= LAST_VALID).to(q.device)
        return Solution(q.T.reshape(*batch, robot.n), valid.reshape(batch), status)

    def _solve(self, targets: Tensor) -> tuple[Tensor, Tensor]:
        """Configurations (n, N), NaN where not valid, and indices into STATUSES (N,) for points (width, N)."""
        robot, task = self._solver.robot, self._solver.task
        averages, places, codes = self._averages(targets)
        aims = targets[:, places]
        with torch.no_grad():
            start, reached = project_columns(
                robot, task, aims, averages, self._solver.tolerances, check_collision=False
            )
            kept = self._solver.on_map(start.T, averages.T)
            nearest = self._manifolds.nearest(averages, aims, start)
            free = ~robot.columns_in_self_collision(nearest.q)
        for good, code in ((free, _SELF_COLLISION), (kept, _OFF_THE_MAP), (reached & nearest.valid, _NOT_CONVERGED)):
            codes[places[~good].cpu()] = code
        good = (free & kept & reached & nearest.valid).nonzero()[:, 0]
        moved = MovedBy.apply(averages[:, good], aims[:, good], self._manifolds, nearest.take(good))  # type: ignore[no-untyped-call]
        solved = normalise(moved, robot.continuous[:, None])
        q = torch.full((robot.n, targets.shape[1]), torch.nan, dtype=targets.dtype, device=targets.device)
        return q.index_copy(1, places[good], solved), codes

    def _averages(self, targets: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Averages (n, M) for those points (width, N) with enough corners, which these are, and what is known (N,)."""
        solver = self._solver
        offsets = targets.T.cpu() - solver.low
        pyramids = self._lattice.pyramids(offsets.detach())
        codes = torch.where(self._suspect[pyramids], _UNCERTIFIED, _SOLVED)
        codes[pyramids < 0] = _OUTSIDE
        places = (pyramids >= 0).nonzero()[:, 0]
        pyramids = pyramids[places]
        weights = pyramid_weights(self._lattice, offsets[places], pyramids) * self._counted[pyramids]
        enough = weights.detach().sum(1) >= _LEAST_WEIGHT
        codes[places[~enough]] = _NO_CELL
        places, pyramids = places[enough], pyramids[enough]
        sums = torch.einsum("nk,nkj->nj", weights[enough], self._embedded[self._corners[pyramids]])
        q = average(sums, solver.robot.continuous.cpu())
        return q.T.contiguous().to(targets.device), places.to(targets.device), codes


def _parts(roadmap: Roadmap, corners: Tensor) -> tuple[Tensor, Tensor]:
    """Of pyramids (P, K): corners that count (P, K), and whether all do and no edge is broken (P,).

    Those count that lie in the largest part which connected edges join; of equal parts, the one of the first corner.
    """
    graph, k = roadmap.graph, corners.shape[1]
    # the ring of the face, and the centre to each of its corners
    ring = [(0, 1)] if k == 3 else [(0, 1), (1, 3), (3, 2), (2, 0)]
    joined = torch.eye(k).repeat(len(corners), 1, 1)
    whole = roadmap.resolved[corners].all(1)
    for first, second in ring + [(corner, k - 1) for corner in range(k - 1)]:
        connected = roadmap.connected[graph.edge_between(corners[:, first], corners[:, second])]
        joined[:, first, second] = joined[:, second, first] = connected.float()
        whole &= connected
    paths = (torch.linalg.matrix_power(joined, k - 1) > 0) & roadmap.resolved[corners][:, None]
    largest = paths.sum(2).argmax(1)
    return paths[torch.arange(len(paths)), largest], whole
