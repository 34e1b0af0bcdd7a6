"""Hops: vertices whose edges are steep, and those beside them, take over postures from near by, all at once.

Relaxation moves configurations along their self-motion manifolds by small steps, and comes to rest where each step
would make some edge steeper, though other parts of the manifolds would suit better: round a point that a joint has to
turn about, mostly. To move that point by one vertex, several have to change together. So each of them has a few
candidates, configurations from up to two edges away, projected to it; which of them they take is chosen for all of them
at once, by min-sum belief propagation: along each edge goes what the candidates of one end cost the other.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from grr_torch.pieces import piece
from grr_torch.processes import at_once
from grr_torch.projection.project import Tolerances, project_columns
from grr_torch.spaces.configuration import embed

if TYPE_CHECKING:
    from grr_torch.resolution.relax import Network

# a vertex is steep when the mean slope of its edges is above so many times that of all
_STEEP = 1.5
# vertices that choose together: each has ten to twenty-five neighbours
_TOGETHER = 1024
# candidates of a vertex, its own configuration among them
_CANDIDATES = 16
# how far apart they were where they come from, at least, nearly [rad]
_APART = 0.1
_ITERATIONS = 12
# share of a message that is kept of the one before
_KEPT = 0.3


def hop(network: Network, q: Tensor, tolerances: Tolerances) -> Tensor:
    """Configurations (n, V) in which some vertices have others, so that each part of the map has no larger slopes.

    Args:
        network: Vertices and edges.
        q: (n, V) configurations.
        tolerances: Of the projections.
    """
    region = _steep_region(network, q).nonzero()[:, 0]
    if len(region) == 0:
        return q
    groups = region.split(_TOGETHER)

    def look(vertices: Tensor) -> tuple[Tensor]:
        return (_candidates(network, q, vertices, tolerances),)

    hopped = q.clone()
    for vertices, (candidates,) in zip(groups, at_once(look, groups, q.device), strict=True):
        chosen = _choose(network, hopped, vertices, candidates)
        own = torch.arange(len(vertices), device=q.device)
        hopped[:, vertices] = candidates[:, own, chosen]
    return hopped


def _steep_region(network: Network, q: Tensor) -> Tensor:
    """(V,) vertices, the mean slope of whose edges is well above that of their part, and their neighbours."""
    slopes = network.slopes(q)
    mean = network.by_part(slopes) / network.by_part(torch.ones_like(slopes))
    counts = network.incidence.counts
    steep = network.incidence.sums(slopes) > _STEEP * counts * mean[network.part_of_vertex]
    reached = network.edges[:, steep[network.edges].any(0)].flatten()
    return steep.index_fill_(0, reached, True)


def _candidates(network: Network, q: Tensor, vertices: Tensor, tolerances: Tolerances) -> Tensor:
    """(n, K, L) configurations of vertices (K,): their own first, which stands for those that are not valid too."""
    sources = _far_apart(network, q, vertices)
    own, number = (sources >= 0).nonzero().unbind(1)
    guesses, targets = q[:, sources[own, number]], network.targets[:, vertices[own]]
    projected, valid = project_columns(network.robot, network.task, targets, guesses, tolerances)
    candidates = q[:, vertices, None].repeat(1, 1, _CANDIDATES)
    candidates[:, own[valid], 1 + number[valid]] = projected[:, valid]
    return candidates


def _far_apart(network: Network, q: Tensor, vertices: Tensor) -> Tensor:
    """(K, L - 1) vertices up to two edges away, the one with the most different configuration first; -1 if none."""
    near = _within_two_edges(network, vertices)
    # as far apart as by their joints, nearly, as long as they are near; and that is a product of matrices
    rows = embed(q.T, network.robot.continuous)
    there, last = rows[near.clamp_min(0)], rows[vertices]
    sizes = there.square().sum(2)
    own = torch.arange(len(vertices), device=q.device)
    distances = torch.where(near >= 0, torch.inf, -torch.inf).to(q)
    chosen = []
    for _ in range(_CANDIDATES - 1):
        squared = torch.baddbmm(sizes[..., None], there, last[..., None], alpha=-2.0)[..., 0]
        distances = torch.minimum(distances, squared + last.square().sum(1, keepdim=True))
        farthest = distances.argmax(1)
        chosen.append(torch.where(distances[own, farthest] > _APART**2, near[own, farthest], -1))
        last = there[own, farthest]
    return torch.stack(chosen, dim=1)


def _within_two_edges(network: Network, vertices: Tensor) -> Tensor:
    """(K, R) vertices one or two edges away from each of vertices (K,), in ascending order; -1 after the last."""
    incidence, size = network.incidence, network.targets.shape[1]
    rank, places = incidence.around(vertices)
    once = incidence.ends[places]
    again, places = incidence.around(once)
    pairs = torch.cat([rank * size + once, rank[again] * size + incidence.ends[places]]).unique()
    rank, near = pairs // size, pairs % size
    others = near != vertices[rank]
    rank, near = rank[others], near[others]
    counts = rank.bincount(minlength=len(vertices))
    number = torch.arange(len(rank), device=rank.device) - (counts.cumsum(0) - counts)[rank]
    return near.new_full((len(vertices), int(counts.max())), -1).index_put_((rank, number), near)


class _Places(NamedTuple):
    """The edges of vertices (K,) with L candidates each, vertex by vertex; those between two of them come twice.

    Attributes:
        counts: (K,) edges of a vertex.
        rank: (M,) which of the vertices an edge is looked at from.
        inner: (I,) the edges between two of them.
        other: (I,) which of them is at the other end of such an edge.
        reverse: (I,) the same edge, looked at from there.
        outer: (M, L) slopes of the other edges, by candidate; zero for those between two of them.
        slopes: (I, L, L) slopes of these, by candidate and by candidate of the other end.
    """

    counts: Tensor
    rank: Tensor
    inner: Tensor
    other: Tensor
    reverse: Tensor
    outer: Tensor
    slopes: Tensor

    @staticmethod
    def of(network: Network, q: Tensor, vertices: Tensor, candidates: Tensor) -> _Places:
        """For vertices (K,) with candidates (n, K, L), where all others have configurations (n, V)."""
        incidence = network.incidence
        rank, places = incidence.around(vertices)
        ends, edges = incidence.ends[places], incidence.edges[places]
        number = torch.full_like(network.part_of_vertex, -1)
        number[vertices] = torch.arange(len(vertices), device=q.device)
        other = number[ends]
        inner, outward = (other >= 0).nonzero()[:, 0], (other < 0).nonzero()[:, 0]
        # the two places of an edge follow each other
        twice = edges[inner].argsort(stable=True)
        reverse = torch.empty_like(twice).index_put_((twice,), twice.view(-1, 2).flip(1).flatten())
        here = candidates[:, rank]
        outer = torch.zeros_like(here[0])
        outer[outward] = network.slopes_between(
            here[:, outward], q[:, ends[outward], None], network.lengths[edges[outward], None]
        )
        once = twice[::2]
        tables = _tables(
            network, here[:, inner[once]], candidates[:, other[inner[once]]], network.lengths[edges[inner[once]]]
        )
        slopes = here.new_empty(len(inner), *tables.shape[1:])
        slopes[once], slopes[reverse[once]] = tables, tables.transpose(1, 2)
        return _Places(incidence.counts[vertices], rank, inner, other[inner], reverse, outer, slopes)

    def sums(self, values: Tensor) -> Tensor:
        """(K, L) sums of values (M, L) by vertex, in one order whatever the device."""
        return torch.segment_reduce(values, "sum", lengths=self.counts, axis=0)

    def parts(self) -> Tensor:
        """(K,) the first of the vertices that each hangs together with by edges between them."""
        first = torch.arange(len(self.counts), device=self.rank.device)
        while True:
            lower = first.scatter_reduce(0, self.rank[self.inner], first[self.other], "amin")
            # whom the first of its neighbours follows, it may follow too
            lower = lower[lower]
            if torch.equal(lower, first):
                return first
            first = lower

    def costs(self, labels: Tensor) -> Tensor:
        """(K,) what the edges of each vertex cost, half for those between two of them, with candidates (K,)."""
        costs = self.outer.gather(1, labels[self.rank, None])
        numbers = torch.arange(len(self.inner), device=labels.device)
        costs[self.inner, 0] = 0.5 * self.slopes[numbers, labels[self.rank[self.inner]], labels[self.other]]
        return self.sums(costs)[:, 0]


def _tables(network: Network, first: Tensor, second: Tensor, lengths: Tensor) -> Tensor:
    """(E, L, L) slopes of edges (E,) between candidates (n, E, L) of their ends."""
    size = max(1, piece(first.device) // first.shape[2] ** 2)
    parts = zip(first.split(size, 1), second.split(size, 1), lengths.split(size), strict=True)
    return torch.cat([network.slopes_between(a[..., None], b[..., None, :], c[:, None, None]) for a, b, c in parts])


def _choose(network: Network, q: Tensor, vertices: Tensor, candidates: Tensor) -> Tensor:
    """(K,) which of candidates (n, K, L) vertices (K,) take, so that slopes are lowest: the best of all iterations.

    What hangs together by edges between them is judged by itself.
    """
    places = _Places.of(network, q, vertices, candidates)
    parts = places.parts()
    chosen = torch.zeros_like(vertices)
    least = parts.bincount(places.costs(chosen))
    # what the other ends of edges (M, L) tell of the candidates
    messages = places.outer.clone()
    for _ in range(_ITERATIONS):
        beliefs = places.sums(messages)
        labels = beliefs.argmin(1)
        costs = parts.bincount(places.costs(labels))
        chosen = torch.where((costs < least)[parts], labels, chosen)
        least = torch.minimum(costs, least)
        # nobody is told what he has told himself
        told = (beliefs[places.rank] - messages)[places.inner][places.reverse]
        told = (places.slopes + told[:, None]).amin(2)
        told -= told.amin(1, keepdim=True)
        messages[places.inner] = _KEPT * messages[places.inner] + (1.0 - _KEPT) * told
    return chosen
