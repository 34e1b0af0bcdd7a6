"""A way over a self-motion manifold: the arm moves, its tool stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from grr_torch.applications.self_motion import SelfMotionManifold
from grr_torch.projection.project import project
from grr_torch.spaces.configuration import difference, distance, interpolate, normalise

_STOPS = 6
# longest step of a frame [rad]
_FRAME = 0.06


def walk(manifold: SelfMotionManifold, component: int, start: Tensor | None = None) -> Tensor:
    """Unwrapped configurations (T, n) along one component; a closed curve begins next to `start` (n,)."""
    turns = manifold.robot.continuous.cpu()
    if manifold.ends is None:
        return _tour(manifold, component)
    curve = manifold.curve(component)
    if start is None or not bool(manifold.closed[component]):
        return curve
    first = int(distance(curve[:-1], start, turns).argmin())
    once_round = curve[-1] - curve[0]
    way = torch.cat([curve[first:], curve[1 : first + 1] + once_round])
    return way + (normalise(way[0], turns) - way[0])


def _tour(manifold: SelfMotionManifold, component: int) -> Tensor:
    """From sample to sample, far from each other, along edges."""
    robot = manifold.robot
    turns = robot.continuous.cpu()
    a, b = manifold.edges.T
    lengths = distance(manifold.configurations[a], manifold.configurations[b], turns).clamp_min(1e-9)
    count = len(manifold.configurations)
    graph = coo_matrix((lengths.numpy(), (a.numpy(), b.numpy())), shape=(count, count)).tocsr()
    members = np.flatnonzero((manifold.component == component).numpy())
    stops = [int(members[0])]
    path = [stops[0]]
    gaps = np.full(len(members), np.inf)
    while len(stops) < _STOPS:
        away, came_from = dijkstra(graph, directed=False, indices=stops[-1], return_predecessors=True)
        gaps = np.minimum(gaps, away[members])
        vertex = int(members[gaps.argmax()])
        stops.append(vertex)
        leg = [vertex]
        while leg[-1] != path[-1]:
            leg.append(int(came_from[leg[-1]]))
        path += leg[-2::-1]
    return _filled(manifold, manifold.configurations[path])


def _filled(manifold: SelfMotionManifold, stops: Tensor) -> Tensor:
    """Unwrapped configurations with small steps between stops (K, n)."""
    turns = manifold.robot.continuous.cpu()
    motions = difference(stops[:-1], stops[1:], turns)
    pieces = (motions.norm(dim=1) / _FRAME).ceil().long().clamp_min(1)
    leg = torch.arange(len(motions)).repeat_interleave(pieces)
    number = torch.arange(len(leg)) - (pieces.cumsum(0) - pieces)[leg]
    guesses = interpolate(stops[leg], stops[leg + 1], (number / pieces[leg])[:, None], turns)
    bare = replace(manifold.robot, spheres=None)
    solved, valid = (part.cpu() for part in project(bare, manifold.task, manifold.point.expand(len(leg), -1), guesses))
    solved = solved[valid] if bool(valid.any()) else stops[:1]
    return torch.cat([solved[:1], solved[:1] + difference(solved[:-1], solved[1:], turns).cumsum(0)])
