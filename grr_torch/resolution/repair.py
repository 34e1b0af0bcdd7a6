"""Repair of a roadmap: vertices that were not resolved and edges that are broken are tried again from all sides."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from grr_torch.progress import Progress, silent
from grr_torch.projection.continuity import is_continuous
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.checkpoint import Checkpoint, Stage
from grr_torch.resolution.edges import EdgeCheck, continuous_pairs
from grr_torch.resolution.losses import FlagCheck, is_large, moved, without_losses
from grr_torch.resolution.repair_candidates import Candidates, Draft, Setting, find_candidates, sums
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.resolution.slopes import slopes_between

# random starts of a vertex
_STARTS = 8
_ROUNDS = 5
# share of its cost that a vertex has to gain
_LEAST_GAIN = 1e-6


class _Trial(NamedTuple):
    """The edges that candidates would have to resolved vertices.

    Attributes:
        rank: (T,) whose edge it is, in ascending order.
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
    # of what is resolved alone, whatever the waves of the others
    before = Draft(roadmap.configurations, roadmap.connected, torch.where(roadmap.resolved, roadmap.wave, -1))
    setting = Setting.of(roadmap, tolerances, seed, at_last)
    repaired = _finished(roadmap, _repaired(before, setting, progress, repairing))
    if not bool(moved(roadmap, repaired).any()):
        return roadmap
    # what follows makes a check of all
    if is_large(repaired):
        return repaired

    def send_back(changed: Roadmap, back: Tensor) -> Roadmap:
        configurations, wave = changed.configurations.clone(), changed.wave.clone()
        configurations[back], wave[back] = before.configurations[back], before.wave[back]
        return _finished(roadmap, Draft(configurations, changed.connected, wave))

    return without_losses(roadmap, repaired, send_back, FlagCheck(tolerances, check, kept=checking))


def _finished(roadmap: Roadmap, draft: Draft) -> Roadmap:
    """The roadmap with a draft's tensors, wherever these are."""
    changed = Draft(**{name: tensor.cpu() for name, tensor in vars(draft).items()})
    reachable = None if roadmap.reachable is None else roadmap.reachable | changed.resolved
    return replace(roadmap, **vars(changed), resolved=changed.resolved, reachable=reachable)


def _repaired(draft: Draft, setting: Setting, progress: Progress, kept: Stage) -> Draft:
    """The draft after all rounds, on the robot's device, with edges as they were judged among few others."""
    begin = 0
    if state := kept.state():
        setting.generator.set_state(state["generator"])
        begin, draft = int(state["turn"]), Draft(*(state[name] for name in vars(draft)))
    draft = Draft(**{name: tensor.to(setting.robot.device) for name, tensor in vars(draft).items()})
    for turn in range(begin, _ROUNDS):
        progress("repairing", turn, _ROUNDS)
        before = int(draft.connected.sum())
        draft = _reconsider(draft, _unresolved_at_the_rim(draft, setting), _STARTS if turn == 0 else 0, setting)
        broken = setting.edges[draft.resolved[setting.edges].all(1) & ~draft.connected]
        for side in (0, 1):
            draft = _reconsider(draft, broken[:, side].unique(), _STARTS, setting)
        last = turn + 1 == _ROUNDS or int(draft.connected.sum()) == before
        turns = torch.tensor(_ROUNDS if last else turn + 1)
        kept.keep({**vars(draft), "generator": setting.generator.get_state(), "turn": turns}, last=last)
        if last:
            break
    progress("repairing", _ROUNDS, _ROUNDS)
    return draft


def _unresolved_at_the_rim(draft: Draft, setting: Setting) -> Tensor:
    """Unresolved vertices within the arm's reach that share an edge with a resolved one."""
    first, second = setting.edges.T
    known = draft.resolved
    rim = torch.cat([first[known[second] & ~known[first]], second[known[first] & ~known[second]]]).unique()
    return rim[setting.within[rim]]


def _reconsider(draft: Draft, vertices: Tensor, starts: int, setting: Setting) -> Draft:
    """Gives some vertices, no two of them neighbours, the candidates that `_choose` chooses."""
    candidates = find_candidates(draft, _independent(setting.edges, vertices, len(setting.points)), starts, setting)
    if len(candidates.vertices) == 0:
        return draft
    trial = _try(draft, candidates, setting)
    return _take(draft, candidates, trial, _choose(draft, candidates, trial, setting))


def _independent(edges: Tensor, vertices: Tensor, size: int) -> Tensor:
    """Of some vertices, those none of whose neighbours comes before it among them."""
    wanted = torch.zeros(size, dtype=torch.bool, device=vertices.device)
    wanted[vertices] = True
    both = wanted[edges].all(1)
    wanted[edges[both].amax(1)] = False
    return wanted.nonzero()[:, 0]


def _try(draft: Draft, candidates: Candidates, setting: Setting) -> _Trial:
    """Checks the edges of candidates to resolved vertices, but for those that would be too steep."""
    robot, task = setting.robot, setting.task
    rank, ends = setting.around(draft, candidates.vertices)
    vertices = candidates.vertices[rank]
    configurations = candidates.configurations[rank], draft.configurations[ends].to(robot.dtype)
    points = setting.points[vertices], setting.points[ends]
    slopes = slopes_between(robot, task, *points, *configurations)
    worth = slopes <= setting.max_slope
    joined = torch.zeros_like(worth)
    pairs = (part[worth] for part in (*points, *configurations))
    joined[worth] = continuous_pairs(robot, task, *pairs, tolerances=setting.tolerances)
    return _Trial(rank, setting.graph.edge_between(vertices, ends), slopes, joined)


def _choose(draft: Draft, candidates: Candidates, trial: _Trial, setting: Setting) -> Tensor:
    """Indices (K,) of candidates that connect more edges than their vertex has, and are worth it; at most one a vertex.

    An edge costs its slope. One that is not connected costs the bound from which on edges are left out; without a
    bound, more than all others together.
    """
    vertices, count = candidates.vertices, len(candidates.vertices)
    connected = draft.connected[trial.edges]
    first, second = setting.edges[trial.edges].T
    q, points = draft.configurations, setting.points
    own = slopes_between(setting.robot, setting.task, points[first], points[second], q[first], q[second])
    own = torch.where(connected, own, 0.0)
    charge = setting.bound or 1.0 + float(trial.slopes.sum() + own.sum())
    costs = sums(count, trial.rank, torch.where(trial.joined, trial.slopes, charge))
    had = sums(count, trial.rank, torch.where(connected, own, charge))
    had = torch.where(draft.resolved[vertices], had, torch.inf)
    lost = sums(count, trial.rank, connected & ~trial.joined)
    gained = sums(count, trial.rank, trial.joined & ~connected)
    costs[(lost > 0.0) | (gained == 0.0)] = torch.inf
    least = costs.new_full((len(setting.points),), torch.inf).scatter_reduce(0, vertices, costs, "amin")
    chosen = ((costs == least[vertices]) & (costs < (1.0 - _LEAST_GAIN) * had)).nonzero()[:, 0]
    # of two that are equal, the first
    return chosen[vertices[chosen].diff(prepend=vertices.new_full((1,), -1)) != 0]


def _take(draft: Draft, candidates: Candidates, trial: _Trial, chosen: Tensor) -> Draft:
    """The map with the chosen candidates."""
    configurations, connected, wave = draft.configurations.clone(), draft.connected.clone(), draft.wave.clone()
    changed = candidates.vertices[chosen]
    # files hold double precision, whatever the robot computes in
    configurations[changed] = candidates.configurations[chosen].to(configurations)
    wave[changed] = torch.where(wave[changed] < 0, wave.max() + 1, wave[changed])
    taken = torch.isin(trial.rank, chosen)
    connected[trial.edges[taken]] = trial.joined[taken]
    return Draft(configurations, connected, wave)
