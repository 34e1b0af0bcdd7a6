"""The roadmap G_q: one configuration for every resolved point of a task graph."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from grr_torch.progress import Progress, silent
from grr_torch.resolution.cells import Cells, doubtful_cells, measure_cells
from grr_torch.resolution.checkpoint import UNKEPT, Stage
from grr_torch.resolution.quality import Quality, measure_quality
from grr_torch.robots.robot import Robot
from grr_torch.spaces.graph import TaskGraph, find_lattice
from grr_torch.spaces.product import find_product
from grr_torch.spaces.task import TaskSpace

if TYPE_CHECKING:
    import networkx

    from grr_torch.applications.differentiable import DifferentiableSolver
    from grr_torch.applications.path import Path
    from grr_torch.applications.routes import Routes
    from grr_torch.applications.solve import Solution, Solver

_EDGES_AT_ONCE = 1 << 18


@dataclass(frozen=True, eq=False)
class Roadmap:
    """A global redundancy resolution roadmap. Immutable; its tensors live on the CPU.

    Attributes:
        robot: The robot.
        task: The task space.
        points: (V, width) points of the task space [m, rad, or parts of unit vectors].
        configurations: (V, n) configurations [rad or m], NaN where unresolved; continuous joints in [−π, π].
        resolved: (V,) bool, vertices that have a configuration.
        edges: (E, 2) vertex indices of the task graph's edges.
        connected: (E,) bool, edges that passed the continuity check.
        wave: (V,) int32, the wave of the expansion that resolved a vertex, later numbers where it was repaired;
            −1 where unresolved.
        reachable: (V,) bool, vertices that are resolved or were reached from a random start; None if not measured.
        parameters: What the roadmap was built with.
        build_seconds: How long the algorithm took.
    """

    robot: Robot
    task: TaskSpace
    points: Tensor
    configurations: Tensor
    resolved: Tensor
    edges: Tensor
    connected: Tensor
    wave: Tensor
    reachable: Tensor | None
    parameters: Mapping[str, Any]
    build_seconds: float

    def __repr__(self) -> str:
        return (
            f"Roadmap({self.robot.name}, {self.task.kind} in {self.task.name}, "
            f"{int(self.resolved.sum())} of {len(self.points)} vertices resolved, "
            f"{int(self.connected.sum())} edges connected)"
        )

    @property
    def positions(self) -> Tensor:
        """(V, d) where the tool is at the vertices [m]."""
        return self.points[:, : self.task.dimension]

    @cached_property
    def graph(self) -> TaskGraph:
        """The task graph G_p."""
        if self.task.rotations is not None:
            return find_product(self.task, self.points, self.edges)
        return TaskGraph(self.points, self.edges, find_lattice(self.points))

    def quality(self, progress: Progress = silent) -> Quality:
        """Connectivity, smoothness, coverage, cells and residuals, computed once from the tensors.

        Of a roadmap from a file they are those of the file; `grr-torch info FILE --verify` computes them again.

        Args:
            progress: Told how many cells are measured.
        """
        if "quality" not in self._measured:
            self._measured["quality"] = measure_quality(self, progress)
        return self._measured["quality"]

    def cells(self, progress: Progress = silent) -> tuple[Cells, Cells]:
        """The triangles of the roadmap, and in R³ the faces of its grid's cells, with their winding and spread.

        Where rotation varies, the faces are also those of an edge between positions and one between rotations; and of
        triangles and faces, a random 20,000 each stand for all.

        Args:
            progress: Told how many cells are measured.
        """
        return self.triangles(progress), self.squares(progress)

    def triangles(self, progress: Progress = silent, kept: Stage = UNKEPT) -> Cells:
        """The first of `cells`, measured once; `kept` is where it is kept how far that is."""
        if "triangles" not in self._measured:
            corners = self.graph.triangles(self.connected)
            self._measured["triangles"] = measure_cells(self, corners, progress, kept)
        return self._measured["triangles"]

    def squares(self, progress: Progress = silent, kept: Stage = UNKEPT) -> Cells:
        """The second of `cells`, measured once; `kept` is where it is kept how far that is."""
        if "squares" not in self._measured:
            self._measured["squares"] = measure_cells(self, self.graph.faces(self.connected), progress, kept)
        return self._measured["squares"]

    @cached_property
    def _measured(self) -> dict[str, Any]:
        return {}

    def remember(self, quality: Quality) -> None:
        """Takes the figures of `quality` from where the roadmap was read."""
        self._measured["quality"] = quality

    @cached_property
    def neighbours(self) -> tuple[Tensor, Tensor]:
        """Compressed rows of the connected edges: those of vertex v lead to ends[starts[v] : starts[v + 1]].

        starts (V + 1,) int64 and ends (2 E_q,) int32.
        """
        starts, ends = replace(self.graph, edges=self.edges[self.connected]).adjacency
        return starts, ends.to(torch.int32)

    @cached_property
    def longest_edge(self) -> float:
        """How far apart the positions of the ends of an edge are, at most [m]; inf without edges."""
        if len(self.edges) == 0:
            return math.inf
        columns = self.points[:, : self.task.dimension].T.contiguous()
        longest = 0.0
        for first, second in (part.T for part in self.edges.split(_EDGES_AT_ONCE)):
            longest = max(longest, float((columns[:, first] - columns[:, second]).square_().sum(0).max()))
        return math.sqrt(longest)

    @cached_property
    def uncertified(self) -> tuple[Tensor, Tensor]:
        """Corners (C, 3) and (C, 4) of the triangles and faces inside which the map may not be continuous.

        Cells that are not certified, and what would be cells if none of its edges were broken; files hold them.
        """
        return doubtful_cells(self)

    @cached_property
    def solver(self) -> Solver:
        """Tables for `solve`, made when they are first needed."""
        from grr_torch.applications.solve import Solver

        return Solver(self)

    @cached_property
    def differentiable_solver(self) -> DifferentiableSolver:
        """Tables for differentiable `solve`, made when they are first needed."""
        from grr_torch.applications.differentiable import DifferentiableSolver

        return DifferentiableSolver(self)

    @cached_property
    def routes(self) -> Routes:
        """Shortest paths along connected edges by D_q, made when they are first needed."""
        from grr_torch.applications.routes import Routes

        return Routes(self)

    def solve(self, points: Tensor, *, differentiable: bool = False, progress: Progress = silent) -> Solution:
        """The map as an IK solver: one configuration for any points of the task space (Section IV-E of the paper).

        Each point's guess is the weighted, circular average over its nearest resolved vertices, of which only those in
        the largest part that edges of the map connect count. It is projected onto the point as in building, with the
        same limits and self-collision.

        With `differentiable`, the map is a function of its own, a little beside the other one: the configuration at the
        point that is nearest to the average over the corners of the point's cell (in the plane a triangle of the grid,
        in space the pyramid of a cell's centre and face) by their barycentric weights, polished to 1e-10. It is smooth
        inside a cell, and its gradients come from the implicit function theorem. It has no jump where cells meet whose
        edges are connected, but its derivative has. A joint whose limit is in the way is held there; where that begins,
        the derivative jumps too. Only whole, certified cells are "solved" here; where a corner is missing, valid
        points are "uncertified" too. Points that are not valid get no gradient: leave them out of a loss.

        Args:
            points: (*batch, width) points [m]; one or a million.
            differentiable: Whether gradients flow from configurations to points, once; torch.func cannot.
            progress: Told how many are solved.

        Returns:
            Configurations, which of them are valid, and a status that says why not.

        Raises:
            ParameterError: The width is not the task's, a value is not finite, or no vertex is resolved. To
                differentiate: the rotation varies, the points are no staggered grid, or the robot is not in float64.
        """
        return (self.differentiable_solver if differentiable else self.solver)(points, progress=progress)

    def plan(
        self,
        start: Tensor | None = None,
        goal: Tensor | None = None,
        *,
        start_configuration: Tensor | None = None,
        goal_configuration: Tensor | None = None,
        smooth: bool = False,
        step: float = 0.05,
        velocity_limits: float | Tensor | None = None,
        acceleration_limits: float | Tensor | None = None,
    ) -> Path:
        """A path over the map: the shortest along connected edges by D_q (Section IV-E of the paper).

        Its waypoints lie on the edges, each solved by the map, and where the map's averages do not follow an edge,
        projected along it as in the continuity check. Neighbours are less than `step` apart, and the straight motion
        between them is free of self-collision. Configurations off the map join it at near vertices, along a
        task-space line where the task is met, else through joint space.

        Args:
            start: (width,) point [m].
            goal: (width,) point [m].
            start_configuration: (n,) configuration [rad or m], instead of `start`; the path begins at its very values.
            goal_configuration: (n,) configuration, instead of `goal`; met modulo 2π.
            smooth: Shorten it by straight task-space lines on the map.
            step: D_q below which neighbouring waypoints stay [rad], from 0.005 to 0.05 √n. The shorter, the longer an
                arm with acceleration limits takes round the corners.
            velocity_limits: Of the joints [rad/s or m/s], one number or (n,); by default the robot's, and 1 where it
                has none.
            acceleration_limits: Of the joints [rad/s² or m/s²], one number or (n,); by default none. With them, the
                path begins and ends at rest.

        Returns:
            The path; if there is none, `found` is false and `reason` says why.

        Raises:
            ParameterError: A shape or parameter is not valid, a value is not finite, a start or goal is given twice
                or not at all, or no vertex is resolved.
        """
        from grr_torch.applications.plan import plan

        return plan(
            self,
            start,
            goal,
            start_configuration=start_configuration,
            goal_configuration=goal_configuration,
            smooth=smooth,
            step=step,
            velocity_limits=velocity_limits,
            acceleration_limits=acceleration_limits,
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the roadmap to one safetensors file (`.grr`), in pieces and by an atomic rename.

        Raises:
            OutputError: It cannot be written.
        """
        from grr_torch.resolution.roadmap_file import save_roadmap

        save_roadmap(self, path)

    @staticmethod
    def load(path: str | os.PathLike[str], *, device: torch.device | str | None = None) -> Roadmap:
        """Opens a `.grr` file; neither the URDF nor the meshes it was built from are needed.

        The tensors are mapped: only what is used is read, and not checked; `grr-torch info FILE --verify` does that.

        Args:
            path: The file.
            device: Where its robot computes, and what is solved comes out; the CPU by default, where its tables,
                plans, teleoperation and evaluation stay.

        Raises:
            ParameterError: There is no such device.
            FileFormatError: It is missing, truncated, of another version, not a roadmap, or tensors do not fit.
        """
        from grr_torch.resolution.roadmap_file import load_roadmap

        return load_roadmap(path, device=device)

    def to_networkx(self) -> networkx.Graph[int]:
        """The roadmap as a networkx graph.

        Resolved vertices carry `point` and `configuration` as numpy arrays, connected edges `point_distance` D_p and
        `configuration_distance` D_q.

        Raises:
            ImportError: networkx is not installed.
        """
        from grr_torch.resolution.networkx_graph import to_networkx

        return to_networkx(self)
