"""Repair of a roadmap: vertices that were not resolved and edges that are broken are tried again from all sides."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from grr_torch.progress import Progress, silent
from grr_torch.projection.continuity import is_continuous
from grr_torch.projection.project import Tolerances, project_columns
from grr_torch.resolution.checkpoint import Checkpoint, Stage
from grr_torch.resolution.edges import EdgeCheck, continuous_pairs
from grr_torch.resolution.losses import FlagCheck, is_large, moved, without_losses
from grr_torch.resolution.reachability import within_reach
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.resolution.slopes import STEEP, edge_slopes
from grr_torch.spaces.configuration import distance
from grr_torch.spaces.graph import TaskGraph

# random starts of a vertex, and, where it is resolved, starts beside its configuration, so far away [rad or m]
_STARTS = 8
_BESIDE, _SIDESTEP = 8, 0.2
_ROUNDS = 5
# candidates of a vertex whose edges are checked
_CHECKED = 3
# share of its cost that a vertex has to gain
_LEAST_GAIN = 1e-6
# what a repair changes
_CHANGING = ("configurations", "connected", "wave")


@dataclass(frozen=True)
class _Means:
    """What a repair works with.

    Attributes:
        graph: The task graph.
        tolerances: Of the projections.
        max_slope: Edges that would be steeper are not tried [rad/m].
        beside: How many starts beside its own configuration a resolved vertex gets.
        generator: Of the random starts.
    """

    graph: TaskGraph
    tolerances: Tolerances
    max_slope: float
    beside: int
    generator: torch.Generator


@dataclass(frozen=True)
class _Candidates:
    """Configurations that some vertices could have, ordered by vertex.

    Attributes:
        vertices: (K,) the vertex of each.
        configurations: (K, n), all valid.
    """

    vertices: Tensor
    configurations: Tensor


class _Trial(NamedTuple):
    """The edges that candidates would have to resolved vertices.

    Attributes:
        rank: (T,) whose edge it is.
        edges: (T,) which edge of the roadmap it is.
        slopes: (T,) its D_q / D_p.
        joined: (T,) whether it is continuous.
    """

    rank: Tensor
    edges: Tensor
    slopes: Tensor
    joined: Tensor


def repair(
    roadmap: Roadmap,
    tolerances: Tolerances,
    seed: int,
    check: EdgeCheck = is_continuous,
    progress: Progress = silent,
    checkpoint: Checkpoint | None = None,
    at_last: bool = False,
) -> Roadmap:
    """Resolves more vertices and connects more edges; what was connected stays so.

    In large maps, repaired edges are only checked among few others, and one that barely passes may be judged otherwise
    beside all.

    Args:
        roadmap: The roadmap.
        tolerances: Of the projections.
        seed: Of the random starts.
        check: What checks all edges of what was changed.
        progress: Told what round it is.
        checkpoint: Where it is kept how far that is; nowhere by default.
        at_last: Whether the map is smooth by now: then configurations beside that of a vertex are tried too, and edges
            may be of any slope that the roadmap does not leave out, not only ten times as steep as the median.
    """
    checkpoint = checkpoint or Checkpoint()
    repairing, checking = map(checkpoint.stage, ("repair", "edges-repaired"))
    slopes, max_slope = edge_slopes(roadmap), torch.inf
    if len(slopes):
        max_slope = torch.inf if at_last else STEEP * float(slopes.median())
    # what is steeper would be left out
    max_slope = min(max_slope, roadmap.parameters.get("max_slope") or torch.inf)
    generator = torch.Generator().manual_seed(seed)
    means = _Means(roadmap.graph, tolerances, max_slope, _BESIDE if at_last else 0, generator)
    repaired = _repaired(roadmap, means, progress, repairing)
    if not bool(moved(roadmap, repaired).any()):
        return roadmap
    # what follows makes a check of all
    if is_large(repaired):
        return repaired

    def send_back(changed: Roadmap, back: Tensor) -> Roadmap:
        configurations, wave = changed.configurations.clone(), changed.wave.clone()
        configurations[back], wave[back] = roadmap.configurations[back], roadmap.wave[back]
        return _changed(roadmap, configurations, changed.connected, wave)

    return without_losses(roadmap, repaired, send_back, FlagCheck(tolerances, check, kept=checking))


def _repaired(roadmap: Roadmap, means: _Means, progress: Progress, kept: Stage) -> Roadmap:
    """The roadmap after all rounds, with edges as they were judged among few others."""
    begin = 0
    if state := kept.state():
        means.generator.set_state(state["generator"])
        begin = int(state["turn"])
        roadmap = _changed(roadmap, *(state[name] for name in _CHANGING))
    for turn in range(begin, _ROUNDS):
        progress("repairing", turn, _ROUNDS)
        before = int(roadmap.connected.sum())
        ends = _unresolved_at_the_rim(roadmap)
        roadmap = _reconsider(roadmap, ends, _STARTS if turn == 0 else 0, means)
        broken = roadmap.edges[roadmap.resolved[roadmap.edges].all(1) & ~roadmap.connected]
        for side in (0, 1):
            roadmap = _reconsider(roadmap, broken[:, side].unique(), _STARTS, means)
        last = turn + 1 == _ROUNDS or int(roadmap.connected.sum()) == before
        named = {name: getattr(roadmap, name) for name in _CHANGING}
        turns = torch.tensor(_ROUNDS if last else turn + 1)
        kept.keep({**named, "generator": means.generator.get_state(), "turn": turns}, last=last)
        if last:
            break
    progress("repairing", _ROUNDS, _ROUNDS)
    return roadmap


def _unresolved_at_the_rim(roadmap: Roadmap) -> Tensor:
    """Unresolved vertices within the arm's reach that share an edge with a resolved one."""
    known = roadmap.resolved[roadmap.edges]
    rim = torch.cat([roadmap.edges[known[:, 1] & ~known[:, 0], 0], roadmap.edges[known[:, 0] & ~known[:, 1], 1]])
    rim = rim.unique()
    return rim[within_reach(roadmap.robot, roadmap.task, roadmap.points[rim])]


def _reconsider(roadmap: Roadmap, vertices: Tensor, starts: int, means: _Means) -> Roadmap:
    """Gives some vertices, no two of them neighbours, the candidates that `_choose` chooses."""
    candidates = _candidates(roadmap, _independent(roadmap, vertices), starts, means)
    if len(candidates.vertices) == 0:
        return roadmap
    trial = _try(roadmap, candidates, means)
    return _take(roadmap, candidates, trial, _choose(roadmap, candidates, trial))


def _independent(roadmap: Roadmap, vertices: Tensor) -> Tensor:
    """Of some vertices, those none of whose neighbours comes before it among them."""
    wanted = torch.zeros(len(roadmap.points), dtype=torch.bool)
    wanted[vertices] = True
    both = wanted[roadmap.edges].all(1)
    wanted[roadmap.edges[both].amax(1)] = False
    return wanted.nonzero()[:, 0]


def _candidates(roadmap: Roadmap, vertices: Tensor, starts: int, means: _Means) -> _Candidates:
    """Projections of all resolved neighbours' configurations, of some beside their own, and of random ones."""
    robot = roadmap.robot
    rank, other = _resolved_around(roadmap, vertices, means.graph)
    own = roadmap.resolved[vertices].nonzero()[:, 0].repeat_interleave(means.beside)
    beside = roadmap.configurations[vertices[own]]
    beside = beside + _SIDESTEP * torch.randn(beside.shape, generator=means.generator, dtype=beside.dtype)
    rank = torch.cat([rank, own, torch.arange(len(vertices)).repeat_interleave(starts)])
    random = robot.sample(len(vertices) * starts, means.generator)
    guesses = torch.cat([torch.cat([roadmap.configurations[other], beside]).to(robot.lower), random])
    order = rank.sort(stable=True).indices
    rank, guesses = rank[order], guesses[order]
    targets = roadmap.points[vertices[rank]].to(guesses).T.contiguous()
    solved, valid = project_columns(robot, roadmap.task, targets, guesses.T.contiguous(), means.tolerances)
    valid = valid.cpu()
    return _gentlest(roadmap, _Candidates(vertices[rank[valid]], solved.T.cpu()[valid]), means.graph)


def _gentlest(roadmap: Roadmap, candidates: _Candidates, graph: TaskGraph) -> _Candidates:
    """Of each vertex, the few candidates whose edges would be least steep: to check an edge costs far more."""
    rank, ends = _resolved_around(roadmap, candidates.vertices, graph)
    moved = distance(candidates.configurations[rank], roadmap.configurations[ends], roadmap.robot.continuous.cpu())
    count = len(candidates.vertices)
    order = _sums(count, rank, moved).argsort()
    order = order[candidates.vertices[order].argsort(stable=True)]
    ordered = candidates.vertices[order]
    first = torch.searchsorted(ordered, ordered)
    kept = order[torch.arange(count) - first < _CHECKED].sort().values
    return _Candidates(candidates.vertices[kept], candidates.configurations[kept])


def _try(roadmap: Roadmap, candidates: _Candidates, means: _Means) -> _Trial:
    """Checks the edges of candidates to resolved vertices, but for those that would be too steep."""
    task = roadmap.task
    rank, ends = _resolved_around(roadmap, candidates.vertices, means.graph)
    vertices = candidates.vertices[rank]
    configurations = candidates.configurations[rank], roadmap.configurations[ends]
    points = roadmap.points[vertices], roadmap.points[ends]
    slopes = distance(*configurations, roadmap.robot.continuous.cpu()) / task.distance(*points)
    worth = slopes <= means.max_slope
    joined = torch.zeros_like(worth)
    pairs = (part[worth] for part in (*points, *configurations))
    joined[worth] = continuous_pairs(roadmap.robot, task, *pairs, tolerances=means.tolerances).cpu()
    return _Trial(rank, means.graph.edge_between(vertices, ends), slopes, joined)


def _choose(roadmap: Roadmap, candidates: _Candidates, trial: _Trial) -> Tensor:
    """Indices (K,) of candidates that connect more edges than their vertex has, and are worth it; at most one a vertex.

    An edge costs its slope. One that is not connected costs the bound from which on edges are left out; without a
    bound, more than all others together.
    """
    vertices, count = candidates.vertices, len(candidates.vertices)
    slopes = edge_slopes(roadmap)
    charge = roadmap.parameters.get("max_slope") or 1.0 + float(trial.slopes.sum() + slopes.sum())
    costs = _sums(count, trial.rank, torch.where(trial.joined, trial.slopes, charge))
    lost = _sums(count, trial.rank, roadmap.connected[trial.edges] & ~trial.joined)
    gained = _sums(count, trial.rank, trial.joined & ~roadmap.connected[trial.edges])
    own = torch.full((len(roadmap.edges),), charge, dtype=torch.float64)
    own[roadmap.connected] = slopes.double()
    known = roadmap.resolved[roadmap.edges].all(1)
    had = _sums(len(roadmap.points), roadmap.edges[known].flatten(), own[known].repeat_interleave(2))
    had[~roadmap.resolved] = torch.inf
    costs[(lost > 0.0) | (gained == 0.0)] = torch.inf
    least = torch.full_like(had, torch.inf).scatter_reduce(0, vertices, costs, "amin")
    chosen = ((costs == least[vertices]) & (costs < (1.0 - _LEAST_GAIN) * had[vertices])).nonzero()[:, 0]
    # of two that are equal, the first
    return chosen[vertices[chosen].diff(prepend=torch.tensor([-1])) != 0]


def _take(roadmap: Roadmap, candidates: _Candidates, trial: _Trial, chosen: Tensor) -> Roadmap:
    """The roadmap with the chosen candidates."""
    configurations, connected, wave = roadmap.configurations.clone(), roadmap.connected.clone(), roadmap.wave.clone()
    changed = candidates.vertices[chosen]
    configurations[changed] = candidates.configurations[chosen]
    wave[changed] = torch.where(wave[changed] < 0, wave.max() + 1, wave[changed])
    taken = torch.isin(trial.rank, chosen)
    connected[trial.edges[taken]] = trial.joined[taken]
    return _changed(roadmap, configurations, connected, wave)


def _changed(roadmap: Roadmap, configurations: Tensor, connected: Tensor, wave: Tensor) -> Roadmap:
    resolved = wave >= 0
    reachable = None if roadmap.reachable is None else roadmap.reachable | resolved
    return replace(
        roadmap,
        configurations=configurations,
        resolved=resolved,
        connected=connected,
        wave=wave,
        reachable=reachable,
    )


def _resolved_around(roadmap: Roadmap, vertices: Tensor, graph: TaskGraph) -> tuple[Tensor, Tensor]:
    """The resolved neighbours of vertices, as `TaskGraph.around` gives them."""
    rank, other = graph.around(vertices)
    known = roadmap.resolved[other]
    return rank[known], other[known]


def _sums(count: int, rank: Tensor, values: Tensor | None = None) -> Tensor:
    """(count,) sums of values by rank; how many there are, if none are given."""
    return rank.bincount(None if values is None else values.double(), minlength=count).double()
