"""Certification: cells whose corners lead to configurations a little too far apart are drawn together.

A cell far beyond the limit stays as it is: where the map has to be discontinuous somewhere, to draw together would only
move the place. Where several neighbours share a twist that none can lose, the worst of them is given up for the others.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from grr_torch.pieces import one_thread, together
from grr_torch.processes import at_once
from grr_torch.progress import Progress, silent
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.cells import CELLS_AT_ONCE, LARGEST_SPREAD, lead_to_centres, spreads
from grr_torch.resolution.checkpoint import Checkpoint, Stage
from grr_torch.resolution.relax import Network, Pulls, gauss_newton_step, move
from grr_torch.spaces.configuration import difference

_ROUNDS = 18
# cells with less spread are not looked at [rad]
_SUSPECT = 0.6
# the spread that is aimed at, and beyond which a cell is given up [rad]: in a first attempt; in a second one that goes
# on from there, for maps with cells left that it does not give up; and in one from the beginning, instead of that, for
# maps with only a handful left, some of them just beyond what the first gives up
_FIRST, _TIGHT, _WIDE = (0.93, 1.4), (0.93, 1.1), (0.93, 1.7)
_HANDFUL = 16
# cells of maps that are attempted twice: it takes long
_MOST_TWICE = 65536
# how much a pull counts against an edge of typical weight
_WEIGHT = 3.0
_DAMPING = 0.3
# after so many rounds in which the number of uncertified cells has not fallen to this share of itself, the worst of
# what is left are given up; so many times, and then all of it
_PATIENCE = 2
_FALLEN = 0.99
_SACRIFICES = 3
# a cell's spread grows by no more than so many times the way of its corners, but for very few cells
_GROWTH = 4.0


def certify(
    network: Network,
    corners: Tensor,
    q: Tensor,
    tolerances: Tolerances,
    progress: Progress,
    checkpoint: Checkpoint | None = None,
) -> Tensor:
    """Configurations (n, V) with fewer cells whose spread is above 1 rad, and the rest as smooth as may be.

    Args:
        network: Vertices and edges.
        corners: (C, 3) cells.
        q: (n, V) configurations.
        tolerances: Of the projections.
        progress: Told what round it is.
        checkpoint: Where it is kept how far that is.
    """
    checkpoint = checkpoint or Checkpoint()
    names = ("spread", "certification", "spread-again", "certification-again", "spread-at-last")
    looking, *stages = map(checkpoint.stage, names)
    robot, task, points = network.robot, network.task, network.targets.T

    def attempt(q: Tensor, spread: Tensor, aim: float, hopeless: float) -> tuple[Tensor, Tensor]:
        """Configurations, and the spread of all cells (C,) then; of those below the limit, no less than it is."""
        again = (aim, hopeless) != _FIRST
        kept, looking_again = stages[2:] if again else stages[:2]
        # the time left is told as if there were no second attempt
        told = silent if again else progress
        suspects = spread > _SUSPECT
        given = corners[suspects], spread[suspects], q, aim, hopeless
        moved = _drawn_together(network, *given, tolerances, told, kept)
        told("certifying", _ROUNDS, _ROUNDS)
        # cells that were not looked at may have suffered, where their corners have moved far enough
        spread = spread + _GROWTH * _way(network, corners, q, moved)
        doubtful = ~(spread <= LARGEST_SPREAD)
        spread[doubtful] = spreads(robot, task, points, moved.T, corners[doubtful], tolerances, told, looking_again)
        return moved, spread

    def left(spread: Tensor) -> Tensor:
        return spread[spread > LARGEST_SPREAD]

    with one_thread(), torch.no_grad():
        spread = spreads(robot, task, points, q.T, corners, tolerances, progress, looking)
        if len(left(spread)) == 0:
            return q
        best, given = (q, spread), (q, spread)
        found = attempt(*given, *_FIRST)
        if len(left(found[1])) < len(left(spread)):
            best = found
        second = _second(left(best[1]))
        if second is not None and len(corners) <= _MOST_TWICE:
            found = attempt(*(best if second == _TIGHT else given), *second)
            if len(left(found[1])) < len(left(best[1])):
                best = found
    return best[0]


def _second(left: Tensor) -> tuple[float, float] | None:
    """Aim and limit of a second attempt, by the spread of the cells that the first has left; None if there is none."""
    just_beyond = (left > _FIRST[1]) & (left <= _WIDE[1])
    if len(left) <= _HANDFUL and bool(just_beyond.any()):
        return _WIDE
    return _TIGHT if bool((left <= _TIGHT[1]).any()) else None


def _drawn_together(
    network: Network,
    corners: Tensor,
    spread: Tensor,
    q: Tensor,
    aim: float,
    hopeless: float,
    tolerances: Tolerances,
    progress: Progress,
    kept: Stage,
) -> Tensor:
    """Configurations (n, V) of the round after which the fewest of some cells, of known spread, were uncertified."""
    best, begin = q, 0
    given_up = torch.zeros_like(spread, dtype=torch.bool)
    # how far corners have moved since their cells were measured [rad]
    travelled = torch.zeros_like(spread)
    # uncertified cells: the fewest so far, and how many there were when patience began; rounds since, and sacrifices
    fewest, before, waited, sacrifices = math.inf, math.inf, 0, 0
    if state := kept.state():
        q, best = (state[name].to(q.device) for name in ("q", "best"))
        given_up, spread, travelled = (state[name].to(q.device) for name in ("given_up", "spread", "travelled"))
        fewest, before = (float(state[name]) for name in ("fewest", "before"))
        begin, waited, sacrifices = (int(state[name]) for name in ("done", "waited", "sacrifices"))
        if bool(state["ended"]):
            return best
    weight = _WEIGHT * float((1.0 / network.lengths).mean())
    for done in range(begin, _ROUNDS + 1):
        progress("certifying", done, _ROUNDS)
        # the others will hardly have come to where they are pulled, or no longer are
        again = (2.0 * travelled >= _leeway(spread, aim, hopeless)).nonzero()[:, 0]
        spread[again], pairs, apart = _spread(network, corners[again], q, tolerances)
        travelled[again] = 0.0
        uncertified = int((spread > LARGEST_SPREAD).sum())
        if uncertified < fewest:
            best, fewest = q, uncertified
        before, waited = (uncertified, 0) if uncertified < _FALLEN * before else (before, waited + 1)
        if waited == _PATIENCE and sacrifices < _SACRIFICES:
            given_up |= _worst_of_neighbours(network, corners, spread, hopeless)
            sacrifices, waited = sacrifices + 1, 0
        excess = (apart.square().sum(0).sqrt() - aim).clamp_min(0.0)
        pulled = ((excess > 0.0) & ((spread <= hopeless) & ~given_up)[again].repeat(3)).nonzero()[:, 0]
        numbers = {"fewest": fewest, "before": before, "waited": waited, "sacrifices": sacrifices}
        watched = {"given_up": given_up, "spread": spread, "travelled": travelled}
        if done == _ROUNDS or uncertified == 0 or waited == _PATIENCE or len(pulled) == 0:
            kept.keep(_state(q, best, watched, {**numbers, "done": done, "ended": True}), last=True)
            break
        # only what is beyond the aim is drawn in
        share = excess[pulled] / (excess[pulled] + aim)
        pulls = Pulls(pairs[:, pulled], apart[:, pulled] * share, torch.full_like(share, weight * (1 + done)))
        moved = move(network, q, gauss_newton_step(network, q, _DAMPING, pulls), tolerances)
        travelled += _way(network, corners, q, moved)
        q = moved
        kept.keep(_state(q, best, watched, {**numbers, "done": done + 1, "ended": False}))
    return best


def _way(network: Network, corners: Tensor, q: Tensor, moved: Tensor) -> Tensor:
    """How far the corner of each cell (C,) that moves farthest does, from q (n, V) to `moved` (n, V) [rad]."""
    way = difference(q, moved, network.robot.continuous[:, None]).square().sum(0).sqrt()
    return way[corners].amax(1)


def _leeway(spread: Tensor, aim: float, hopeless: float) -> Tensor:
    """How much the spread of cells (C,) would have to change to be drawn together, or not any more [rad]."""
    leeway = torch.maximum(aim - spread, spread - hopeless).clamp_min(0.0)
    # of a cell that could not be followed to its centre nothing is known
    return torch.where(spread.isinf(), 0.0, leeway)


def _state(q: Tensor, best: Tensor, watched: dict[str, Tensor], numbers: dict[str, float]) -> dict[str, Tensor]:
    tensors = {name: torch.tensor(value, dtype=torch.float64) for name, value in numbers.items()}
    return {"q": q, "best": best, **watched, **tensors}


def _worst_of_neighbours(network: Network, corners: Tensor, spread: Tensor, hopeless: float) -> Tensor:
    """(C,) cells above the limit that share a corner with none that is worse, of those that are not hopeless."""
    worst = spread.new_zeros(network.targets.shape[1])
    open_cells = (spread > LARGEST_SPREAD) & (spread <= hopeless)
    counted = torch.where(open_cells, spread, 0.0)
    worst = worst.scatter_reduce(0, corners.flatten(), counted.repeat_interleave(3), "amax")
    return open_cells & (spread >= worst[corners].amax(1))


def _spread(network: Network, corners: Tensor, q: Tensor, tolerances: Tolerances) -> tuple[Tensor, Tensor, Tensor]:
    """Spread of cells (C,), and of their three pairs of corners: (2, 3C) and what is between their ends (n, 3C)."""
    robot = network.robot
    count = -(-len(corners) // together(CELLS_AT_ONCE, q.device)) or 1
    parts = [part.to(q.device) for part in corners.chunk(count)]

    def lead(part: Tensor) -> tuple[Tensor, Tensor]:
        return lead_to_centres(robot, network.task, network.targets.T[part], q.T[part], tolerances)

    ends, followed = zip(*at_once(lead, parts, q.device), strict=True)
    at_centre = torch.cat(ends)
    apart = difference(at_centre, at_centre.roll(-1, dims=1), robot.continuous).transpose(0, 1).reshape(-1, robot.n).T
    pairs = torch.stack([corners.T.flatten(), corners.roll(-1, dims=1).T.flatten()])
    spread = apart.square().sum(0).sqrt().reshape(3, -1).amax(0)
    return torch.where(torch.cat(followed), spread, torch.inf), pairs, apart
