"""Hops: a vertex whose edges are steep takes over the posture of one of its neighbours.

Relaxation moves configurations along their self-motion manifolds by small steps, and comes to rest where each step
would make some edge steeper, though another part of the manifold would suit all neighbours better: round a point that
a joint has to turn about, mostly. There, the neighbours' configurations, projected to the vertex, are tried.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from grr_torch.pieces import in_pieces, together
from grr_torch.projection.project import Tolerances, project_columns

if TYPE_CHECKING:
    from grr_torch.resolution.relax import Network

# a vertex is tried when the mean slope of its edges is above so many times that of all
_STEEP = 1.25
# vertices tried together: each has ten to twenty-five neighbours, as many candidates, and each of these as many edges
_TRIED_AT_ONCE = 1024


def hop(network: Network, q: Tensor, active: Tensor, tolerances: Tolerances) -> Tensor:
    """Configurations (n, V) in which some vertices, no two of them neighbours, have a better one.

    Args:
        network: Vertices and edges.
        q: (n, V) configurations.
        active: (V,) vertices that may change.
        tolerances: Of the projections.
    """
    vertices = (_is_steep(network, q) & active).nonzero()[:, 0]
    if len(vertices) == 0:
        return q
    gains = torch.zeros_like(q[0])
    better = q.clone()
    for part in vertices.split(together(_TRIED_AT_ONCE, q.device)):
        candidates, gain = _best_candidates(network, q, part, tolerances)
        better[:, part], gains[part] = candidates, gain
    rank, places = network.incidence.around(vertices)
    around = torch.zeros_like(gains[vertices])
    around.scatter_reduce_(0, rank, gains[network.incidence.ends[places]], "amax")
    hopping = vertices[gains[vertices] > around]
    return q.index_copy(1, hopping, better[:, hopping])


def _is_steep(network: Network, q: Tensor) -> Tensor:
    """(V,) whether the mean slope of a vertex's edges is well above that of all edges of its part."""
    slopes = network.slopes(q)
    mean = network.by_part(slopes) / network.by_part(torch.ones_like(slopes))
    counts = network.incidence.counts
    return network.incidence.sums(slopes) > _STEEP * counts * mean[network.part_of_vertex]


def _best_candidates(network: Network, q: Tensor, vertices: Tensor, tolerances: Tolerances) -> tuple[Tensor, Tensor]:
    """The neighbours' configurations (n, K), projected, that lower the slopes most, and by how much (K,)."""
    rank, places = network.incidence.around(vertices)
    own = vertices[rank]
    guesses = q[:, network.incidence.ends[places]]
    candidates, valid = project_columns(network.robot, network.task, network.targets[:, own], guesses, tolerances)
    gain = _slopes_at(network, q, vertices, q[:, vertices])[rank] - _slopes_at(network, q, own, candidates)
    gain = torch.where(valid, gain, 0.0)
    most = torch.zeros_like(q[0, vertices]).scatter_reduce_(0, rank, gain, "amax")
    # of those that gain as much, the last; where none gains, whatever it is it will not be taken
    numbers = torch.arange(len(rank), device=q.device)
    chosen = torch.zeros_like(vertices).scatter_reduce_(0, rank, torch.where(gain >= most[rank], numbers, 0), "amax")
    return candidates[:, chosen], most


def _slopes_at(network: Network, q: Tensor, vertices: Tensor, configurations: Tensor) -> Tensor:
    """(K,) sums of the slopes that the edges of vertices (K,) would have with configurations (n, K)."""
    rank, places = network.incidence.around(vertices)
    ends, edges = network.incidence.ends[places], network.incidence.edges[places]

    def measure(rank: Tensor, ends: Tensor, lengths: Tensor) -> tuple[Tensor]:
        return (network.slopes_between(configurations[:, rank], q[:, ends], lengths),)

    (slopes,) = in_pieces(measure, rank, ends, network.lengths[edges])
    # edges lie vertex by vertex: they are summed in one order, whatever the device
    return torch.segment_reduce(slopes, "sum", lengths=network.incidence.counts[vertices])
