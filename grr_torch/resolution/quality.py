"""How good a roadmap is: the paper's two metrics (Section V-A), coverage, and what every vertex must keep."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from grr_torch.progress import Progress, silent
from grr_torch.resolution.slopes import edge_slopes, steep_edges

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap


@dataclass(frozen=True)
class Quality:
    """Figures of a roadmap. None: not measured, or nothing to measure it on.

    Attributes:
        vertices: Vertices of the task graph.
        edges: Edges of the task graph.
        resolved_vertices: Vertices that have a configuration.
        reachable_vertices: Vertices that are resolved or were reached from a random start.
        coverage: resolved / reachable vertices.
        connected_edges: Edges that passed the continuity check.
        reachable_edges: Edges between reachable vertices.
        connectivity: Connected edges / edges between reachable vertices.
        resolved_edges: Edges between resolved vertices.
        connectivity_resolved: Connected edges / edges between resolved vertices (the paper's implementation).
        smoothness: S, the mean of D_q / D_p over connected edges [rad/m].
        smoothness_median: Median of the same ratios [rad/m].
        smoothness_p99: Their 99th percentile [rad/m].
        smoothness_max: The largest of them [rad/m].
        steep_edges: Connected edges whose ratio is more than ten times the median: suspect.
        triangles: Triangles of the graph with three connected edges; where rotation varies, of these and of squares, at
            most 20,000 that were drawn and measured.
        triangles_wound: Those round which some joint makes a full turn.
        triangles_spread: Others whose corners lead to configurations more than 1 rad apart at the centre.
        triangles_certified: The rest, as a share.
        squares: Faces of a spatial grid's cells with four connected edges; where rotation varies, also those between
            two neighbouring positions in two neighbouring rotations.
        squares_wound: As of triangles.
        squares_spread: As of triangles.
        squares_certified: As of triangles.
        max_position_error: Largest distance of a tool from its point [m].
        max_rotation_error: Largest angle of a tool from its rotation [rad]; 0 where rotation is free.
        min_self_collision_distance: Smallest distance of two links [m]; None without a sphere model.
        self_collisions: Resolved vertices nearer to self-collision than the margin; None without a sphere model.
        joint_limit_violations: Resolved vertices with a joint outside its limits.
    """

    vertices: int
    edges: int
    resolved_vertices: int
    reachable_vertices: int | None
    coverage: float | None
    connected_edges: int
    reachable_edges: int | None
    connectivity: float | None
    resolved_edges: int
    connectivity_resolved: float | None
    smoothness: float | None
    smoothness_median: float | None
    smoothness_p99: float | None
    smoothness_max: float | None
    steep_edges: int
    triangles: int
    triangles_wound: int
    triangles_spread: int
    triangles_certified: float | None
    squares: int
    squares_wound: int
    squares_spread: int
    squares_certified: float | None
    max_position_error: float | None
    max_rotation_error: float | None
    min_self_collision_distance: float | None
    self_collisions: int | None
    joint_limit_violations: int

    def to_dict(self) -> dict[str, Any]:
        """The figures by name."""
        return asdict(self)


def measure_quality(roadmap: Roadmap, progress: Progress = silent) -> Quality:
    """Computes every figure from the roadmap's tensors."""
    resolved, reachable = roadmap.resolved, roadmap.reachable
    between_resolved = int(resolved[roadmap.edges].all(1).sum())
    between_reachable = None if reachable is None else int(reachable[roadmap.edges].all(1).sum())
    reached = None if reachable is None else int(reachable.sum())
    connected = int(roadmap.connected.sum())
    slopes = edge_slopes(roadmap)
    # torch's quantile takes no more than 2²⁴ values
    levels = np.quantile(slopes.numpy(), [0.5, 0.99, 1.0]).tolist() if len(slopes) else [None] * 3
    position_error, rotation_error = _residuals(roadmap)
    q = roadmap.configurations[resolved]
    return Quality(
        vertices=len(resolved),
        edges=len(roadmap.edges),
        resolved_vertices=int(resolved.sum()),
        reachable_vertices=reached,
        coverage=_ratio(int(resolved.sum()), reached),
        connected_edges=connected,
        reachable_edges=between_reachable,
        connectivity=_ratio(connected, between_reachable),
        resolved_edges=between_resolved,
        connectivity_resolved=_ratio(connected, between_resolved),
        smoothness=float(slopes.mean()) if len(slopes) else None,
        smoothness_median=levels[0],
        smoothness_p99=levels[1],
        smoothness_max=levels[2],
        steep_edges=len(steep_edges(roadmap)),
        **_count_cells(roadmap, progress),
        max_position_error=_largest(position_error),
        max_rotation_error=_largest(rotation_error),
        min_self_collision_distance=_clearance(roadmap, q),
        self_collisions=int(roadmap.robot.in_self_collision(q).sum()) if roadmap.robot.spheres else None,
        joint_limit_violations=int((~roadmap.robot.within_limits(q.to(roadmap.robot.lower))).sum()),
    )


def _count_cells(roadmap: Roadmap, progress: Progress) -> dict[str, Any]:
    counts: dict[str, Any] = {}
    for name, cells in zip(("triangles", "squares"), roadmap.cells(progress), strict=True):
        counts[name] = len(cells.corners)
        counts[f"{name}_wound"] = int(cells.wound.sum())
        counts[f"{name}_spread"] = int(cells.spread_out.sum())
        counts[f"{name}_certified"] = _ratio(int(cells.certified.sum()), len(cells.corners))
    return counts


def _residuals(roadmap: Roadmap) -> tuple[Tensor, Tensor]:
    q = roadmap.configurations[roadmap.resolved]
    position, rotation = (part.movedim(0, -1).cpu() for part in roadmap.robot.forward_kinematics(q))
    error = roadmap.task.error(roadmap.points[roadmap.resolved].T.to(position), position, rotation)
    return roadmap.task.residuals(error)


def _clearance(roadmap: Roadmap, q: Tensor) -> float | None:
    if len(q) == 0:
        return None
    smallest = float(roadmap.robot.self_collision_distance(q).min())
    return smallest if math.isfinite(smallest) else None


def _largest(values: Tensor) -> float | None:
    return float(values.max()) if len(values) else None


def _ratio(part: int, whole: int | None) -> float | None:
    return part / whole if whole else None


def quality_differences(stored: dict[str, Any], computed: dict[str, Any]) -> list[str]:
    """Names of the figures that differ by more than rounding."""

    def same(first: Any, second: Any) -> bool:
        if isinstance(first, float) and isinstance(second, float):
            return math.isclose(first, second, rel_tol=1e-6, abs_tol=1e-9)
        return first == second

    return [name for name in computed if not same(stored.get(name), computed[name])]
