"""Relaxation of a roadmap: all configurations move at once, each along its self-motion manifold.

The sum of D_q / D_p over the edges is minimised under the constraint that every tool stays where it is. Each round
is one Gauss–Newton step: around the present configurations, the sum of the edges' weighted squares over all motions
that the null spaces of the Jacobians allow is minimised by conjugate gradients. The weights 1 / (D_p · D_q) make
its squares stand for the norms themselves (iteratively reweighted least squares). Now and then vertices hop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from grr_torch.pieces import in_pieces, one_thread
from grr_torch.progress import Progress
from grr_torch.projection.columns import null_space_projector, transposed_product
from grr_torch.projection.project import Tolerances, project_columns
from grr_torch.resolution.checkpoint import UNKEPT, Stage
from grr_torch.resolution.hops import hop
from grr_torch.resolution.objectives import Objective
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import difference, normalise
from grr_torch.spaces.task import TaskSpace

_ROUNDS = 40
# times that vertices hop: after the first round, and when all has come to rest before the last; where objectives count
# they do not, for such a map has been relaxed without them
_HOPS = 3
# rounds end when one lowers the cost by less than this share
_LEAST_GAIN = 2e-5
_GRADIENT_STEPS = 60
# conjugate gradients end when so much of the squared residual is left: the weights change from round to round
_LEFT = 1e-3
# that a map begins with, as a share of the stiffness
_DAMPING = 1e-2
# longest step of a joint [rad or m]
_LONGEST_STEP = 0.3
# D_q below which a slope counts as none [rad]
_SHORTEST = 1e-2


class _Incidence(NamedTuple):
    """Edges by vertex, so that what they do to it is summed in one order, whatever the device.

    Attributes:
        starts: (V,) where a vertex's edges start in the others.
        edges: (2E,) index of an edge.
        ends: (2E,) its other vertex.
        signs: (2E,) 1 at its first vertex, −1 at its second.
        counts: (V,) how many edges a vertex has.
    """

    starts: Tensor
    edges: Tensor
    ends: Tensor
    signs: Tensor
    counts: Tensor

    @staticmethod
    def of(edges: Tensor, like: Tensor) -> _Incidence:
        """For edges (2, E) between the columns of `like`."""
        vertices, count = edges.flatten(), edges.shape[1]
        order = vertices.argsort(stable=True)
        counts = vertices.bincount(minlength=like.shape[1])
        signs = torch.where(order < count, 1.0, -1.0).to(like)
        return _Incidence(counts.cumsum(0) - counts, order % count, edges.flip(0).flatten()[order], signs, counts)

    def gather(self, forces: Tensor) -> Tensor:
        """(n, V) sums of what edges (n, E) do to their first vertex, and the opposite to their second."""
        return _sum_bags(self.edges, forces, self.starts, self.signs)

    def neighbours(self, x: Tensor, weights: Tensor) -> Tensor:
        """(n, V) sums of x (n, V) over the edges' other ends, weighted (E,)."""
        return _sum_bags(self.ends, x, self.starts, weights[self.edges])

    def sums(self, values: Tensor) -> Tensor:
        """(V,) sums of values of edges (E,)."""
        return embedding_bag(self.edges, values[:, None], self.starts, mode="sum")[:, 0]

    def around(self, vertices: Tensor) -> tuple[Tensor, Tensor]:
        """For all edges of vertices (K,): which of those it belongs to, and its place in `edges` and `ends`."""
        counts = self.counts[vertices]
        rank = torch.arange(len(vertices), device=vertices.device).repeat_interleave(counts)
        first = self.starts[vertices] - (counts.cumsum(0) - counts)
        return rank, first[rank] + torch.arange(len(rank), device=vertices.device)


def _sum_bags(indices: Tensor, columns: Tensor, starts: Tensor, weights: Tensor) -> Tensor:
    rows = columns.T.contiguous()
    return embedding_bag(indices, rows, starts, per_sample_weights=weights, mode="sum").T


@dataclass(frozen=True)
class Network:
    """Vertices on their self-motion manifolds, and the edges that pull at them.

    Attributes:
        robot: The robot.
        task: The task space.
        targets: (width, V) points.
        edges: (2, E) vertices of each edge.
        lengths: (E,) D_p of each edge.
        objectives: What else counts.
        bound: Slope [rad/m] that steeper edges count as, and from which on they do not pull.
        parts: (V,) number of the map that a vertex belongs to, if there are several without edges between them: each
            then has steps, a damping and an end of its own, but all hop together.
    """

    robot: Robot
    task: TaskSpace
    targets: Tensor
    edges: Tensor
    lengths: Tensor
    objectives: tuple[Objective, ...] = ()
    bound: float = math.inf
    parts: Tensor | None = None

    @cached_property
    def incidence(self) -> _Incidence:
        """Its edges by vertex."""
        return _Incidence.of(self.edges, self.targets)

    def motions(self, q: Tensor) -> Tensor:
        """(n, E) wrapped differences along the edges."""
        wraps = self.robot.continuous[:, None]
        return in_pieces(lambda ends: (difference(q[:, ends[0]], q[:, ends[1]], wraps),), self.edges)[0]

    def costs(self, q: Tensor) -> Tensor:
        """(P,) sums of D_q / D_p, rounded off at zero, by part, and of the objectives' costs, for (n, V)."""
        return self.by_part(self.slopes(q)) + sum(objective.cost(q) for objective in self.objectives)

    def slopes(self, q: Tensor) -> Tensor:
        """(E,) D_q / D_p, rounded off at zero."""

        def measure(ends: Tensor, lengths: Tensor) -> tuple[Tensor]:
            return (self.slopes_between(q[:, ends[0]], q[:, ends[1]], lengths),)

        return in_pieces(measure, self.edges, self.lengths)[0]

    def slopes_between(self, first: Tensor, second: Tensor, lengths: Tensor) -> Tensor:
        """(…) D_q / D_p between configurations (n, …) at points so far apart, rounded off at zero and at the bound."""
        moved = difference(first, second, self.robot.continuous.view(-1, *(1,) * (first.ndim - 1)))
        return (moved.square().sum(0).add_(_SHORTEST**2).sqrt_() / lengths).clamp_max_(self.bound)

    def by_part(self, values: Tensor) -> Tensor:
        """(P,) sums of values of edges (E,), by part."""
        if self.parts is None:
            return values.sum()[None]
        return self.parts[self.edges[0]].bincount(values, minlength=int(self.parts.max()) + 1)

    @cached_property
    def part_of_vertex(self) -> Tensor:
        """(V,) number of the part that a vertex belongs to."""
        return torch.zeros_like(self.targets[0], dtype=torch.long) if self.parts is None else self.parts


class Pulls(NamedTuple):
    """Pairs of vertices that are to come nearer along a given direction.

    Attributes:
        pairs: (2, K) vertices.
        motions: (n, K) from the first to the second, wrapped.
        weights: (K,) how much a square counts.
    """

    pairs: Tensor
    motions: Tensor
    weights: Tensor


def relax(
    network: Network,
    q: Tensor,
    tolerances: Tolerances,
    progress: Progress,
    rounds: int = _ROUNDS,
    kept: Stage = UNKEPT,
) -> Tensor:
    """Configurations (n, V) of lower cost: converged, within limits and free of self-collision like those given."""
    parts = network.part_of_vertex
    costs = network.costs(q)
    damping = torch.full_like(costs, _DAMPING)
    going_on = torch.ones_like(costs, dtype=torch.bool)
    begin, hops = 0, 0 if network.objectives else _HOPS
    if state := kept.state():
        q, costs, damping, going_on = (state[name].to(q.device) for name in ("q", "costs", "damping", "going_on"))
        begin, hops = (int(state["done"]) if bool(going_on.any()) else rounds), int(state["hops"])
    with one_thread(), torch.no_grad():
        for done in range(begin, rounds):
            progress("refining", done, rounds)
            moved = move(network, q, gauss_newton_step(network, q, damping[parts]), tolerances)
            new_costs = network.costs(moved)
            better = going_on & (new_costs < costs)
            going_on = torch.where(better, new_costs < (1.0 - _LEAST_GAIN) * costs, going_on & (damping <= 1e2))
            q, costs = torch.where(better[parts], moved, q), torch.where(better, new_costs, costs)
            damping = torch.where(better, (0.3 * damping).clamp_min(1e-4), 10.0 * damping)
            if hops and (done == 0 or not bool(going_on.any())):
                q, hops = hop(network, q, tolerances), hops - 1
                before, costs = costs, network.costs(q)
                gained = costs < (1.0 - _LEAST_GAIN) * before
                going_on, damping = going_on | gained, torch.where(gained, _DAMPING, damping)
            last = done + 1 == rounds or not bool(going_on.any())
            numbers = {"done": torch.tensor(done + 1), "hops": torch.tensor(hops)}
            kept.keep({"q": q, "costs": costs, "damping": damping, "going_on": going_on, **numbers}, last=last)
            if last:
                break
    progress("refining", rounds, rounds)
    return q


def gauss_newton_step(network: Network, q: Tensor, damping: float | Tensor, pulls: Pulls | None = None) -> Tensor:
    """A step (n, V) that lowers slopes, pulls and the objectives' costs, by preconditioned conjugate gradients.

    The damping may be one for each vertex (V,).
    """
    robot = network.robot
    motions = network.motions(q)
    (moved,) = in_pieces(lambda part: (part.square().sum(0),), motions)
    moved.add_(_SHORTEST**2).sqrt_()
    weights = torch.where(moved < network.bound * network.lengths, 1.0 / (moved * network.lengths), 0.0)

    def null_space(part: Tensor, targets: Tensor) -> tuple[Tensor]:
        jacobian = network.task.jacobian(robot.tree.jacobian(robot.tree.frames(part)), targets)
        # small, but large enough for the pivots of a straight arm
        return (null_space_projector(jacobian, torch.finfo(q.dtype).eps ** 0.6),)

    (projector,) = in_pieces(null_space, q, network.targets)
    incidence = network.incidence
    if pulls is not None:
        incidence = _Incidence.of(torch.cat([network.edges, pulls.pairs], dim=1), q)
        motions, weights = torch.cat([motions, pulls.motions], dim=1), torch.cat([weights, pulls.weights])
    held = incidence.neighbours(torch.ones_like(q[:1]), weights)[0]
    forces = incidence.gather(motions.mul_(weights))
    del motions
    models = [objective.model(q) for objective in network.objectives]
    directions = [direction for _, curved in models for direction in curved]
    stiffness = held + sum(direction.square().sum(0) for direction in directions)
    # a vertex without edges stays
    stiffness = torch.where(stiffness > 0.0, stiffness, 1.0)

    def allowed(x: Tensor) -> Tensor:
        return transposed_product(projector, x)

    def apply(x: Tensor) -> Tensor:
        bent = held * x - incidence.neighbours(x, weights)
        for direction in directions:
            bent.addcmul_(direction, (direction * x).sum(0))
        return allowed(bent).addcmul_(damping * stiffness, x)

    step = torch.zeros_like(q)
    residual = allowed(forces + sum(pull for pull, _ in models))
    direction = scaled = residual / stiffness
    size = start = (residual * scaled).sum()
    for _ in range(_GRADIENT_STEPS):
        if float(size) <= _LEFT * float(start):
            break
        applied = apply(direction)
        length = size / (direction * applied).sum()
        step.addcmul_(direction, length)
        residual = residual - applied * length
        scaled = allowed(residual / stiffness)
        before, size = size, (residual * scaled).sum()
        direction = scaled + direction * (size / before)
    return step * (_LONGEST_STEP / step.abs().amax(0).clamp_min(_LONGEST_STEP))


def move(network: Network, q: Tensor, step: Tensor, tolerances: Tolerances) -> Tensor:
    """Configurations after a step; those that cannot be projected near where it leads stay."""
    robot = network.robot
    wraps = robot.continuous[:, None]
    aim = normalise(q + step, wraps)
    moved, valid = project_columns(robot, network.task, network.targets, aim, tolerances)
    missed = difference(aim, moved, wraps).square().sum(0).sqrt()
    near = missed <= 0.5 * step.square().sum(0).sqrt() + 1e-3
    return torch.where(valid & near, moved, q)
