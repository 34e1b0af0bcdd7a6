"""Ways: waypoints on straight lines, so dense that none is far from the next, for many lines at once."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from grr_torch.applications.motions import SUBSTEPS
from grr_torch.applications.solve import LAST_VALID, Solver
from grr_torch.projection.project import project_columns, tool_points
from grr_torch.spaces.configuration import difference, distance, interpolate

# bisections after which a line whose configurations are still apart is given up, and pieces
_DEPTH = 20
_PIECES = 1 << 12
# neighbouring waypoints are at most this share of the longest edge apart
_SPACING = 0.25

# of bisected lines, columns of points (width, N) and configurations (n, N) in the middle, and which are valid (N,)
_Middle = Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]


@dataclass(frozen=True, eq=False)
class Stops:
    """Where ways begin and end.

    Attributes:
        points: (S, width) points of the task space.
        configurations: (S, n) configurations there.
        vertices: (S,) vertices of the roadmap, −1 for what is none.
    """

    points: Tensor
    configurations: Tensor
    vertices: Tensor

    def __len__(self) -> int:
        return len(self.points)

    def take(self, rows: Tensor | slice) -> Stops:
        """Some of them, in another order."""
        return Stops(self.points[rows], self.configurations[rows], self.vertices[rows])

    @staticmethod
    def join(*parts: Stops) -> Stops:
        """All of them, one part after the other."""
        fields = ((part.points, part.configurations, part.vertices) for part in parts)
        return Stops(*(torch.cat(tensors) for tensors in zip(*fields, strict=True)))


@dataclass(frozen=True, eq=False)
class Way:
    """Waypoints of one way, both ends included.

    Attributes:
        points: (K, width) points of the task space.
        configurations: (K, n) configurations there.
        straight: Whether its points lie on a straight line of the task space; else its configurations do.
    """

    points: Tensor
    configurations: Tensor
    straight: bool

    def length(self, continuous: Tensor) -> float:
        """Sum of D_q between neighbours [rad]."""
        return float(distance(self.configurations[:-1], self.configurations[1:], continuous).sum())


@dataclass(frozen=True, eq=False)
class WayFinder:
    """Finds ways along straight lines.

    A line is bisected, all lines at once, until neighbouring waypoints are less than a step apart. That is what the
    recursion of IsContinuous (Algorithm 1) comes to.

    Attributes:
        solver: The roadmap's solver.
        step: D_q that neighbouring waypoints stay below [rad].
    """

    solver: Solver
    step: float

    def on_map(self, starts: Stops, ends: Stops) -> list[Way | None]:
        """Ways on straight task-space lines, each waypoint solved by the map (Section IV-E of the paper)."""

        def middle(pa: Tensor, pb: Tensor, qa: Tensor, qb: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            points = self.solver.task.interpolate(pa.T, pb.T, 0.5).T
            q, codes = self.solver.solve_columns(points)
            return points, q, (codes <= LAST_VALID).to(q.device)

        return self._ways(starts, ends, middle, straight=True)

    def on_lines(self, starts: Stops, ends: Stops) -> list[Way | None]:
        """Ways on straight task-space lines, each waypoint projected from the middle of its two neighbours.

        So IsContinuous follows an edge, wherefore this finds a way along every connected one, but for those that graze
        the arm between the points that it looks at: here there are more of them.
        """
        solver = self.solver
        wraps = solver.robot.continuous[:, None]

        def middle(pa: Tensor, pb: Tensor, qa: Tensor, qb: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            points = solver.task.interpolate(pa.T, pb.T, 0.5).T
            guesses = interpolate(qa, qb, 0.5, wraps)
            return points, *project_columns(solver.robot, solver.task, points, guesses, solver.tolerances)

        return self._ways(starts, ends, middle, straight=True)

    def through_joint_space(self, starts: Stops, ends: Stops) -> list[Way | None]:
        """Ways on straight joint-space lines."""
        robot, wraps = self.solver.robot, self.solver.robot.continuous[:, None]

        def middle(pa: Tensor, pb: Tensor, qa: Tensor, qb: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            q = interpolate(qa, qb, 0.5, wraps)
            return tool_points(robot, self.solver.task, q.T).T, q, ~robot.columns_in_self_collision(q)

        return self._ways(starts, ends, middle, straight=False)

    def _ways(self, starts: Stops, ends: Stops, middle: _Middle, *, straight: bool) -> list[Way | None]:
        way, points, q = self._bisect(starts, ends, middle)
        counts = way.bincount(minlength=len(starts)).tolist()
        ways = [
            Way(p, c, straight) if len(p) else None for p, c in zip(points.split(counts), q.split(counts), strict=True)
        ]
        return self._free(ways)

    def _bisect(self, starts: Stops, ends: Stops, middle: _Middle) -> tuple[Tensor, Tensor, Tensor]:
        """The line (M,), point (M, width) and configuration (M, n) of all waypoints of the lines that have a way."""
        wraps = self.solver.robot.continuous[:, None]
        columns = [
            part.T.contiguous() for part in (starts.points, ends.points, starts.configurations, ends.configurations)
        ]
        count = len(starts)
        found = torch.ones(count, dtype=torch.bool, device=columns[0].device)
        way = torch.arange(count, device=columns[0].device)
        low, high = torch.zeros_like(columns[0][0]), torch.ones_like(columns[0][0])
        rows = [(way, low, columns[0], columns[2]), (way, high, columns[1], columns[3])]
        for _ in range(_DEPTH):
            pa, pb, qa, qb = columns
            far = (pb - pa)[: self.solver.task.dimension].norm(dim=0) > self._spacing
            long = (difference(qa, qb, wraps).norm(dim=0) >= self.step) | far
            left = (long & found[way]).nonzero()[:, 0]
            if len(left) == 0:
                break
            way, low, high = way[left], low[left], high[left]
            pa, pb, qa, qb = (part[:, left] for part in columns)
            pm, qm, valid = middle(pa, pb, qa, qb)
            centre = 0.5 * (low + high)
            found[way[~valid]] = False
            found[(way.bincount(minlength=count) > _PIECES)] = False
            rows.append((way, centre, pm, qm))
            way, low, high = torch.cat([way, way]), torch.cat([low, centre]), torch.cat([centre, high])
            columns = [torch.cat(pair, dim=1) for pair in ((pa, pm), (pm, pb), (qa, qm), (qm, qb))]
        else:
            found[way] = False
        owner, fraction, points, q = (torch.cat(parts, dim=-1) for parts in zip(*rows, strict=True))
        order = (2.0 * owner + fraction).argsort(stable=True)
        order = order[found[owner[order]]]
        return owner[order], points[:, order].T, q[:, order].T

    @property
    def _spacing(self) -> float:
        radius = self.solver.radius
        return _SPACING * radius if math.isfinite(radius) else math.inf

    def _free(self, ways: list[Way | None]) -> list[Way | None]:
        """Ways without those that are in self-collision between two waypoints."""
        there = [k for k, way in enumerate(ways) if way is not None]
        found = [way for way in ways if way is not None]
        if not found or self.solver.robot.spheres is None:
            return ways
        robot = self.solver.robot
        between = [substeps(way.configurations, robot.continuous) for way in found]
        hit = robot.in_self_collision(torch.cat([part.reshape(-1, robot.n) for part in between]))
        for k, part in zip(there, hit.split([part.shape[0] * SUBSTEPS for part in between]), strict=True):
            if bool(part.any()):
                ways[k] = None
        return ways


def substeps(q: Tensor, continuous: Tensor) -> Tensor:
    """Configurations (K − 1, S, n) between neighbours of (K, n), each neighbour being the last of its own."""
    fractions = torch.arange(1, SUBSTEPS + 1, dtype=q.dtype, device=q.device) / SUBSTEPS
    return q[:-1, None] + fractions[:, None] * difference(q[:-1], q[1:], continuous)[:, None]
