"""Certification: cells whose corners lead to configurations a little too far apart are drawn together.

A cell far beyond the limit stays as it is: where the map has to be discontinuous somewhere, to draw together would only
move the place. Where several neighbours share a twist that none can lose, the worst of them is given up for the others.
"""

from __future__ import annotations

import torch
from torch import Tensor

from grr_torch.pieces import one_thread
from grr_torch.progress import Progress, silent
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.cells import LARGEST_SPREAD, lead_to_centres
from grr_torch.resolution.relax import Network, Pulls, gauss_newton_step, move
from grr_torch.spaces.configuration import difference

_ROUNDS = 18
# cells with less spread are not looked at [rad]
_SUSPECT = 0.6
# spread that is aimed at [rad], and beyond which a cell is given up [rad]
_AIM = 0.93
_HOPELESS = 1.4
# how much a pull counts against an edge of typical weight
_WEIGHT = 3.0
_DAMPING = 0.3
# rounds in which, of what is left, the worst are given up
_SACRIFICES = (6, 10, 14)


def certify(network: Network, corners: Tensor, q: Tensor, tolerances: Tolerances, progress: Progress) -> Tensor:
    """Configurations (n, V) with fewer cells whose spread is above 1 rad, and the rest as smooth as may be.

    Args:
        network: Vertices and edges.
        corners: (C, 3) cells.
        q: (n, V) configurations.
        tolerances: Of the projections.
        progress: Told what round it is.
    """
    with one_thread(), torch.no_grad():
        everything, start = corners, q
        spread = _spread(network, corners, q, tolerances, progress)[0]
        uncertified_before = int((spread > LARGEST_SPREAD).sum())
        corners = corners[spread > _SUSPECT]
        if uncertified_before == 0:
            return q
        weight = _WEIGHT * float((1.0 / network.lengths).mean())
        best, fewest = q, torch.inf
        given_up = torch.zeros(len(corners), dtype=torch.bool, device=q.device)
        for done in range(_ROUNDS):
            progress("certifying", done, _ROUNDS)
            spread, pairs, apart = _spread(network, corners, q, tolerances)
            uncertified = int((spread > LARGEST_SPREAD).sum())
            if uncertified < fewest:
                best, fewest = q, uncertified
            excess = (apart.square().sum(0).sqrt() - _AIM).clamp_min(0.0)
            if done in _SACRIFICES:
                given_up |= _worst_of_neighbours(network, corners, spread)
            pulled = ((excess > 0.0) & ((spread <= _HOPELESS) & ~given_up).repeat(3)).nonzero()[:, 0]
            if len(pulled) == 0:
                break
            # only what is beyond the aim is drawn in
            share = excess[pulled] / (excess[pulled] + _AIM)
            pulls = Pulls(pairs[:, pulled], apart[:, pulled] * share, torch.full_like(share, weight * (1 + done)))
            q = move(network, q, gauss_newton_step(network, q, _DAMPING, pulls), tolerances)
        spread = _spread(network, corners, q, tolerances)[0]
        if int((spread > LARGEST_SPREAD).sum()) < fewest:
            best = q
        # cells that were not looked at may have suffered
        after = int((_spread(network, everything, best, tolerances, progress)[0] > LARGEST_SPREAD).sum())
    progress("certifying", _ROUNDS, _ROUNDS)
    return best if after < uncertified_before else start


def _worst_of_neighbours(network: Network, corners: Tensor, spread: Tensor) -> Tensor:
    """(C,) cells above the limit that share a corner with none that is worse, of those that are not hopeless."""
    worst = spread.new_zeros(network.targets.shape[1])
    open_cells = (spread > LARGEST_SPREAD) & (spread <= _HOPELESS)
    counted = torch.where(open_cells, spread, 0.0)
    worst = worst.scatter_reduce(0, corners.flatten(), counted.repeat_interleave(3), "amax")
    return open_cells & (spread >= worst[corners].amax(1))


def _spread(
    network: Network, corners: Tensor, q: Tensor, tolerances: Tolerances, progress: Progress = silent
) -> tuple[Tensor, Tensor, Tensor]:
    """Spread of cells (C,), and of their three pairs of corners: (2, 3C) and what is between their ends (n, 3C)."""
    robot = network.robot
    points = network.targets.T[corners]
    ends, followed = lead_to_centres(robot, network.task, points, q.T[corners], tolerances, progress)
    turned = ends.roll(-1, dims=1)
    apart = difference(ends, turned, robot.continuous).transpose(0, 1).reshape(-1, robot.n).T
    pairs = torch.stack([corners.T.flatten(), corners.roll(-1, dims=1).T.flatten()])
    spread = apart.square().sum(0).sqrt().reshape(3, -1).amax(0)
    return torch.where(followed, spread, torch.inf), pairs, apart
