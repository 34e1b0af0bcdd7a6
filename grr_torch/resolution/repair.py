"""Repair of a roadmap: vertices that were not resolved and edges that are broken are tried again from all sides."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from grr_torch.projection.continuity import is_continuous
from grr_torch.projection.project import Tolerances, project_columns
from grr_torch.resolution.quality import STEEP, edge_slopes
from grr_torch.resolution.reachability import within_reach
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.spaces.configuration import distance

# random starts of an unresolved vertex
_STARTS = 8
_ROUNDS = 5
# candidates of a vertex whose edges are checked
_CHECKED = 3


@dataclass(frozen=True)
class _Candidates:
    """Configurations that some vertices could have.

    Attributes:
        vertices: (K,) the vertex of each.
        configurations: (K, n), all valid.
    """

    vertices: Tensor
    configurations: Tensor


def repair(roadmap: Roadmap, tolerances: Tolerances, seed: int) -> Roadmap:
    """Resolves more vertices and connects more edges; what was connected stays so.

    Args:
        roadmap: The roadmap.
        tolerances: Of the projections.
        seed: Of the random starts.
    """
    generator = torch.Generator().manual_seed(seed)
    limit = _max_slope(roadmap)
    for turn in range(_ROUNDS):
        before = int(roadmap.connected.sum())
        ends = _unresolved_at_the_rim(roadmap)
        roadmap = _reconsider(roadmap, ends, _STARTS if turn == 0 else 0, limit, tolerances, generator)
        broken = roadmap.edges[roadmap.resolved[roadmap.edges].all(1) & ~roadmap.connected]
        for side in (0, 1):
            roadmap = _reconsider(roadmap, broken[:, side].unique(), _STARTS, limit, tolerances, generator)
        if int(roadmap.connected.sum()) == before:
            break
    return roadmap


def _max_slope(roadmap: Roadmap) -> float:
    slopes = edge_slopes(roadmap)
    return STEEP * float(slopes.median()) if len(slopes) else torch.inf


def _unresolved_at_the_rim(roadmap: Roadmap) -> Tensor:
    """Unresolved vertices within the arm's reach that share an edge with a resolved one."""
    known = roadmap.resolved[roadmap.edges]
    rim = torch.cat([roadmap.edges[known[:, 1] & ~known[:, 0], 0], roadmap.edges[known[:, 0] & ~known[:, 1], 1]])
    rim = rim.unique()
    return rim[within_reach(roadmap.robot, roadmap.task, roadmap.points[rim])]


def _reconsider(
    roadmap: Roadmap, vertices: Tensor, starts: int, limit: float, tolerances: Tolerances, generator: torch.Generator
) -> Roadmap:
    """Gives some vertices, no two of them neighbours, the candidate that connects most edges, if it connects more."""
    vertices = _independent(roadmap, vertices)
    if len(vertices) == 0:
        return roadmap
    candidates = _candidates(roadmap, vertices, starts, tolerances, generator)
    if len(candidates.vertices) == 0:
        return roadmap
    wraps = roadmap.robot.continuous.cpu()
    starts_of, ends, edge = _edges_of(roadmap, candidates.vertices)
    q_start, q_end = candidates.configurations[starts_of], roadmap.configurations[ends]
    points = roadmap.points[candidates.vertices[starts_of]], roadmap.points[ends]
    slopes = distance(q_start, q_end, wraps) / roadmap.task.distance(*points)
    worth = slopes <= limit
    joined = torch.zeros_like(worth)
    joined[worth] = is_continuous(
        roadmap.robot,
        roadmap.task,
        points[0][worth],
        points[1][worth],
        q_start[worth],
        q_end[worth],
        tolerances=tolerances,
    ).cpu()
    count = len(candidates.vertices)
    connects = torch.zeros(count, dtype=torch.float64).index_add_(0, starts_of, joined.double())
    had = torch.zeros(len(roadmap.points), dtype=torch.float64)
    had.index_add_(0, roadmap.edges.flatten(), roadmap.connected[:, None].expand(-1, 2).flatten().double())
    steepness = torch.zeros(count, dtype=torch.float64).index_add_(
        0, starts_of, torch.where(joined, slopes, 0.0).double()
    )
    lost = torch.zeros(count, dtype=torch.float64).index_add_(
        0, starts_of, (roadmap.connected[edge] & ~joined).double()
    )
    # most edges first, and of those that connect as many the least steep; none that was connected may be lost
    score = torch.where(lost > 0.0, -torch.inf, connects - steepness / (1.0 + steepness.max()))
    best = torch.full((len(roadmap.points),), -torch.inf, dtype=torch.float64)
    best.scatter_reduce_(0, candidates.vertices, score, "amax")
    more = connects > had[candidates.vertices]
    chosen = ((score == best[candidates.vertices]) & more & (score > -torch.inf)).nonzero()[:, 0]
    # candidates are ordered by vertex: of two that are equal, the first
    chosen = chosen[candidates.vertices[chosen].diff(prepend=torch.tensor([-1])) != 0]
    configurations, connected, wave = roadmap.configurations.clone(), roadmap.connected.clone(), roadmap.wave.clone()
    changed = candidates.vertices[chosen]
    configurations[changed] = candidates.configurations[chosen].cpu()
    wave[changed] = torch.where(wave[changed] < 0, wave.max() + 1, wave[changed])
    taken = torch.isin(starts_of, chosen)
    connected[edge[taken]] = joined[taken]
    resolved = roadmap.resolved.clone()
    resolved[changed] = True
    reachable = None if roadmap.reachable is None else roadmap.reachable | resolved
    return replace(
        roadmap,
        configurations=configurations,
        resolved=resolved,
        connected=connected,
        wave=wave,
        reachable=reachable,
    )


def _independent(roadmap: Roadmap, vertices: Tensor) -> Tensor:
    """Of some vertices, those none of whose neighbours comes before it among them."""
    wanted = torch.zeros(len(roadmap.points), dtype=torch.bool)
    wanted[vertices] = True
    both = wanted[roadmap.edges].all(1)
    wanted[roadmap.edges[both].amax(1)] = False
    return wanted.nonzero()[:, 0]


def _edges_of(roadmap: Roadmap, vertices: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """All edges from vertices (K,) to resolved ones: rank in `vertices`, the other end, and the edge's index."""
    starts, ends = roadmap.graph.adjacency
    counts = starts[vertices + 1] - starts[vertices]
    rank = torch.repeat_interleave(torch.arange(len(vertices)), counts)
    places = starts[vertices][rank] + torch.arange(len(rank)) - (counts.cumsum(0) - counts)[rank]
    other = ends[places]
    pairs = torch.stack([vertices[rank], other], dim=1).sort(dim=1).values @ torch.tensor([len(roadmap.points), 1])
    keys, order = (roadmap.edges.sort(dim=1).values @ torch.tensor([len(roadmap.points), 1])).sort()
    edge = order[torch.searchsorted(keys, pairs)]
    known = roadmap.resolved[other]
    return rank[known], other[known], edge[known]


def _candidates(
    roadmap: Roadmap, vertices: Tensor, starts: int, tolerances: Tolerances, generator: torch.Generator
) -> _Candidates:
    """Projections of all resolved neighbours' configurations and of random ones, ordered by vertex."""
    robot = roadmap.robot
    rank, other, _ = _edges_of(roadmap, vertices)
    rank = torch.cat([rank, torch.arange(len(vertices)).repeat_interleave(starts)])
    random = robot.sample(len(vertices) * starts, generator)
    guesses = torch.cat([roadmap.configurations[other].to(robot.lower), random])
    order = rank.sort(stable=True).indices
    rank, guesses = rank[order], guesses[order]
    targets = roadmap.points[vertices[rank]].to(guesses)
    solved, valid = project_columns(robot, roadmap.task, targets.T.contiguous(), guesses.T.contiguous(), tolerances)
    valid = valid.cpu()
    return _gentlest(roadmap, _Candidates(vertices[rank[valid]], solved.T.cpu()[valid]))


def _gentlest(roadmap: Roadmap, candidates: _Candidates) -> _Candidates:
    """Of each vertex, the few candidates whose edges would be least steep: to check an edge costs far more."""
    starts_of, ends, _ = _edges_of(roadmap, candidates.vertices)
    moved = distance(candidates.configurations[starts_of], roadmap.configurations[ends], roadmap.robot.continuous.cpu())
    count = len(candidates.vertices)
    steepness = torch.zeros(count, dtype=torch.float64).index_add_(0, starts_of, moved.double())
    order = steepness.argsort()
    order = order[candidates.vertices[order].argsort(stable=True)]
    ordered = candidates.vertices[order]
    first = torch.searchsorted(ordered, ordered)
    kept = order[torch.arange(count) - first < _CHECKED].sort().values
    return _Candidates(candidates.vertices[kept], candidates.configurations[kept])
