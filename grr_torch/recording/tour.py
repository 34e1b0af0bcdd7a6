"""A tour of a roadmap: the arm visits points far apart, along connected edges."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from torch import Tensor

from grr_torch.projection.project import project
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.spaces.configuration import difference, distance, interpolate

_STOPS = 14
_STEPS_PER_EDGE = 6


def tour(roadmap: Roadmap) -> tuple[Tensor, Tensor]:
    """Configurations along a closed tour over the largest connected part of a roadmap.

    Returns:
        Points (T, width) and configurations (T, n). Continuous joints are unwrapped: no jumps of 2π.
    """
    vertices = _visited(roadmap)
    a, b = torch.tensor(vertices[:-1]), torch.tensor(vertices[1:])
    fractions = torch.arange(_STEPS_PER_EDGE, dtype=torch.float64)[:, None, None] / _STEPS_PER_EDGE
    points = roadmap.task.interpolate(roadmap.points[a], roadmap.points[b], fractions)
    continuous = roadmap.robot.continuous.cpu()
    ends = roadmap.configurations[a], roadmap.configurations[b]
    guesses = interpolate(*ends, fractions, continuous)
    solved, valid = (part.cpu() for part in project(roadmap.robot, roadmap.task, points, guesses))
    # edge by edge, then along each edge
    points, solved, valid = (part.transpose(0, 1).flatten(0, 1) for part in (points, solved, valid))
    points, solved = points[valid], solved[valid]
    steps = difference(solved[:-1], solved[1:], continuous)
    return points, torch.cat([solved[:1], solved[:1] + steps.cumsum(0)])


def _visited(roadmap: Roadmap) -> list[int]:
    """Vertices of the tour, each joined to the next by a connected edge; at least one vertex twice."""
    count = len(roadmap.points)
    first, second = roadmap.edges[roadmap.connected].T
    lengths = distance(
        roadmap.configurations[first], roadmap.configurations[second], roadmap.robot.continuous.cpu()
    ).clamp_min(1e-9)
    graph = coo_matrix((lengths.numpy(), (first.numpy(), second.numpy())), shape=(count, count)).tocsr()
    labels = connected_components(graph, directed=False)[1]
    resolved = roadmap.resolved.numpy()
    largest = np.bincount(labels[resolved]).argmax()
    members = np.flatnonzero(resolved & (labels == largest))
    stops = _spread(roadmap.positions.numpy(), members)
    paths, came_from = dijkstra(graph, directed=False, indices=stops, return_predecessors=True)
    order = [0]
    while len(order) < len(stops):
        left = [k for k in range(len(stops)) if k not in order]
        order.append(min(left, key=lambda k: float(paths[order[-1], stops[k]])))
    visited = [int(stops[0])]
    for start, end in zip(order, [*order[1:], order[0]], strict=True):
        leg: list[int] = []
        vertex = int(stops[end])
        while vertex != stops[start]:
            leg.append(vertex)
            vertex = int(came_from[start, vertex])
        visited += leg[::-1]
    return visited if len(visited) > 1 else visited * 2


def _spread(points: np.ndarray, members: np.ndarray) -> np.ndarray:
    """Members as far from each other as can be, found one after another."""
    chosen = [int(members[0])]
    gap = np.full(len(members), np.inf)
    while len(chosen) < min(_STOPS, len(members)):
        gap = np.minimum(gap, np.linalg.norm(points[members] - points[chosen[-1]], axis=1))
        chosen.append(int(members[gap.argmax()]))
    return np.array(chosen)
