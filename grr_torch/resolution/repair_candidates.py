"""What a repair gives vertices to choose from, and what it works with; all on the robot's device."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from grr_torch.projection.project import Tolerances, project_columns
from grr_torch.resolution.reachability import within_reach
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.resolution.slopes import STEEP, edge_slopes
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import distance
from grr_torch.spaces.graph import TaskGraph
from grr_torch.spaces.task import TaskSpace

# starts beside the configuration of a resolved vertex, so far away [rad or m]
_BESIDE, _SIDESTEP = 8, 0.2
# candidates of a vertex whose edges are checked
_CHECKED = 3


@dataclass(frozen=True)
class Draft:
    """What a repair changes of a roadmap.

    Attributes:
        configurations: (V, n).
        connected: (E,).
        wave: (V,), −1 where unresolved.
    """

    configurations: Tensor
    connected: Tensor
    wave: Tensor

    @property
    def resolved(self) -> Tensor:
        """(V,) vertices that have a configuration."""
        return self.wave >= 0


@dataclass(frozen=True)
class Setting:
    """What a repair works with; its tensors are on the robot's device.

    Attributes:
        robot: The robot.
        task: The task space.
        graph: The task graph.
        points: (V, width) its points.
        edges: (E, 2) its edges.
        within: (V,) vertices within the arm's reach.
        tolerances: Of the projections.
        max_slope: Edges that would be steeper are not tried [rad/m].
        bound: Slope from which on edges are left out; None: no bound.
        beside: How many starts beside its own configuration a resolved vertex gets.
        generator: Of the random starts.
    """

    robot: Robot
    task: TaskSpace
    graph: TaskGraph
    points: Tensor
    edges: Tensor
    within: Tensor
    tolerances: Tolerances
    max_slope: float
    bound: float | None
    beside: int
    generator: torch.Generator

    @staticmethod
    def of(roadmap: Roadmap, tolerances: Tolerances, seed: int, at_last: bool) -> Setting:
        """Of a roadmap.

        Args:
            roadmap: The roadmap.
            tolerances: Of the projections.
            seed: Of the random starts.
            at_last: Whether edges of any slope are tried that is not left out, and starts beside configurations too;
                else none that is ten times as steep as the median.
        """
        device, bound = roadmap.robot.device, roadmap.parameters.get("max_slope")
        slopes, max_slope = edge_slopes(roadmap), torch.inf
        if len(slopes) and not at_last:
            max_slope = STEEP * float(slopes.median())
        return Setting(
            roadmap.robot,
            roadmap.task,
            roadmap.graph,
            roadmap.points.to(device),
            roadmap.edges.to(device),
            within_reach(roadmap.robot, roadmap.task, roadmap.points).to(device),
            tolerances,
            # what is steeper would be left out
            min(max_slope, bound or torch.inf),
            bound,
            _BESIDE if at_last else 0,
            torch.Generator().manual_seed(seed),
        )

    def around(self, draft: Draft, vertices: Tensor) -> tuple[Tensor, Tensor]:
        """The resolved neighbours of vertices, as `TaskGraph.around` gives them."""
        rank, other = self.graph.around(vertices)
        known = draft.resolved[other]
        return rank[known], other[known]


@dataclass(frozen=True)
class Candidates:
    """Configurations that some vertices could have, ordered by vertex.

    Attributes:
        vertices: (K,) the vertex of each.
        configurations: (K, n), all valid.
    """

    vertices: Tensor
    configurations: Tensor


def find_candidates(draft: Draft, vertices: Tensor, starts: int, setting: Setting) -> Candidates:
    """Projections of all resolved neighbours' configurations, of some beside their own, and of random ones."""
    robot, device = setting.robot, vertices.device
    rank, other = setting.around(draft, vertices)
    own = draft.resolved[vertices].nonzero()[:, 0].repeat_interleave(setting.beside)
    beside = draft.configurations[vertices[own]]
    # drawn on the CPU, so that a seed gives the same on every device
    beside = beside + _SIDESTEP * torch.randn(beside.shape, generator=setting.generator, dtype=beside.dtype).to(device)
    rank = torch.cat([rank, own, torch.arange(len(vertices), device=device).repeat_interleave(starts)])
    random = robot.sample(len(vertices) * starts, setting.generator)
    guesses = torch.cat([torch.cat([draft.configurations[other], beside]).to(robot.dtype), random])
    order = rank.sort(stable=True).indices
    rank, guesses = rank[order], guesses[order]
    targets = setting.points[vertices[rank]].to(guesses).T.contiguous()
    solved, valid = project_columns(robot, setting.task, targets, guesses.T.contiguous(), setting.tolerances)
    return _gentlest(draft, Candidates(vertices[rank[valid]], solved.T[valid]), setting)


def _gentlest(draft: Draft, candidates: Candidates, setting: Setting) -> Candidates:
    """Of each vertex, the few candidates whose edges would be least steep: to check an edge costs far more."""
    count = len(candidates.vertices)
    # not every device reduces no segments at all
    if count == 0:
        return candidates
    rank, ends = setting.around(draft, candidates.vertices)
    wraps = setting.robot.continuous
    moved = distance(candidates.configurations[rank], draft.configurations[ends], wraps)
    order = sums(count, rank, moved).argsort()
    order = order[candidates.vertices[order].argsort(stable=True)]
    ordered = candidates.vertices[order]
    first = torch.searchsorted(ordered, ordered)
    kept = order[torch.arange(count, device=order.device) - first < _CHECKED].sort().values
    return Candidates(candidates.vertices[kept], candidates.configurations[kept])


def sums(count: int, rank: Tensor, values: Tensor) -> Tensor:
    """(count,) sums of values by rank, which ascends, in the same order every time."""
    counts = rank.bincount(minlength=count)
    return torch.segment_reduce(values.double(), "sum", lengths=counts, initial=0.0, unsafe=True)
