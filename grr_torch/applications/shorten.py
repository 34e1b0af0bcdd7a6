"""Shortening paths by straight task-space lines on the map."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from grr_torch.applications.ways import Stops, Way, WayFinder

# knots that a path is cut at, beside its corners; how far apart knots are joined; and how often
_KNOTS = 16
_SPAN = 24
_ROUNDS = 3
# a round that shortens by less than this share is the last
_GAIN = 1e-3
# nothing shorter than this [rad] is worth it
_LEAST = 1e-6


def shorten(finder: WayFinder, ways: list[Way]) -> list[Way]:
    """A path of straight lines that is never longer in joint space, nor, for its straight part, in task space.

    The path is cut at its corners and at knots between them, and all pairs of knots are joined by straight task-space
    lines, as far as there are ways on the map along them. The shortest path among all these replaces it; again, until
    it gets no shorter. Ways through joint space, to and from the map, are kept.
    """
    first = next((k for k, way in enumerate(ways) if way.straight), len(ways))
    last = next((k for k in range(len(ways), first, -1) if ways[k - 1].straight), first)
    middle = ways[first:last]
    before = _length(finder, middle)
    for _ in range(_ROUNDS):
        if before <= _LEAST:
            break
        middle = _round(finder, _cut(finder, middle))
        length = _length(finder, middle)
        if length > (1.0 - _GAIN) * before:
            break
        before = length
    return ways[:first] + middle + ways[last:]


def _length(finder: WayFinder, ways: list[Way]) -> float:
    return sum(way.length(finder.solver.robot.continuous) for way in ways)


def _cut(finder: WayFinder, ways: list[Way]) -> list[Way]:
    """The same path in pieces, of which none is much longer than its share."""
    share = _length(finder, ways) / _KNOTS
    pieces: list[Way] = []
    for way in ways:
        parts = max(1, min(round(way.length(finder.solver.robot.continuous) / share), len(way.points) - 1))
        knots = np.linspace(0, len(way.points) - 1, parts + 1).round().astype(int).tolist()
        for a, b in pairwise(knots):
            pieces.append(Way(way.points[a : b + 1], way.configurations[a : b + 1], way.straight))
    return pieces


def _round(finder: WayFinder, pieces: list[Way]) -> list[Way]:
    """The shortest path over pieces and lines between their ends."""
    turns = finder.solver.robot.continuous
    points = torch.stack([pieces[0].points[0], *(piece.points[-1] for piece in pieces)])
    q = torch.stack([pieces[0].configurations[0], *(piece.configurations[-1] for piece in pieces)])
    knots = Stops(points, q, torch.full((len(points),), -1))
    first, second = np.triu_indices(len(knots), 2)
    near = second - first <= _SPAN
    first, second = first[near], second[near]
    lines = finder.on_map(knots.take(torch.from_numpy(first)), knots.take(torch.from_numpy(second)))
    every: dict[tuple[int, int], Way] = {(k, k + 1): piece for k, piece in enumerate(pieces)}
    for a, b, line in zip(first.tolist(), second.tolist(), lines, strict=True):
        if line is not None:
            every[a, b] = line
    lengths = [max(way.length(turns), 1e-9) for way in every.values()]
    rows, columns = zip(*every, strict=True)
    graph = csr_matrix((lengths, (rows, columns)), shape=(len(knots), len(knots)))
    before = dijkstra(graph, indices=0, return_predecessors=True)[1]
    path = [len(knots) - 1]
    while path[0]:
        path.insert(0, int(before[path[0]]))
    return [every[pair] for pair in pairwise(path)]
