"""Seeds without hands: closed paths round the base, the best of several cheap expansions.

All candidates, those of `closed_paths`, are expanded over a coarse graph and the best of them relaxed there: so few
vertices soon come to rest, and many candidates come to nearly the same. The best of these maps, as seeds, are expanded
and relaxed on the task graph itself; the one with the smallest slopes, where what is missing or broken counts as steep,
is relaxed further and seeds the roadmap with all its vertices. Of a large task graph, the best coarse map does.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from grr_torch.errors import check_seed, check_whole
from grr_torch.processes import at_once
from grr_torch.progress import Progress, silent
from grr_torch.projection.project import Tolerances, project_columns, tool_points
from grr_torch.resolution.closed_paths import closed_paths
from grr_torch.resolution.edges import continuous_pairs
from grr_torch.resolution.expand import default_neighbours, grow
from grr_torch.resolution.relax import Network, relax
from grr_torch.resolution.seeds import in_the_middle
from grr_torch.resolution.slopes import slopes_between
from grr_torch.robots.robot import Robot
from grr_torch.spaces.graph import Copies, TaskGraph, staggered_grid
from grr_torch.spaces.product import ProductGraph, product_graph
from grr_torch.spaces.task import TaskSpace

# candidates that are looked for, unless told otherwise
CANDIDATES = 60
_MOST_CANDIDATES = 10_000
# vertices of the coarse graph that the arm should reach, in the plane and in space
_COARSE = {2: 120, 3: 300}
# so many times as many, and so many rotations at least, where rotation varies
_TURNED, _FEWEST = 4, 8
# of a task graph with more vertices, on which a trial would take long, the best coarse map is taken as it is
_MOST_TRIED = 10_000
# of a projection in an expansion over the coarse graph: what takes longer is out of reach, or a bad posture
_ITERATIONS = 8
# vertices averaged over on it
_NEIGHBOURS = 24
# share of the candidates that are relaxed on it, and of those that are tried on the task graph itself
_RELAXED = 0.16
_FINALISTS = 0.06
# in so many rounds each
_ROUNDS = 5
_FINAL_ROUNDS = 3
# and of the best of these
_LAST_ROUNDS = 10
# edges steeper than this many times the median do not pull, and count as that steep, where there is no bound of slopes
_STEEP = 6.0
# an edge that is missing, broken, or steeper, counts as this many times the smallest median of slopes; where there is a
# bound, one that is broken or steeper counts as that
_MISSING = 40.0
# edges less steep than this many times the median are hardly ever broken
_SUSPECT = 3.0


def check_candidates(candidates: int) -> int:
    """How many sets of seeds are to be compared.

    Raises:
        ParameterError: It is out of its range.
    """
    return check_whole("candidates", candidates, 1, _MOST_CANDIDATES)


def find_seeds(
    robot: Robot,
    task: TaskSpace,
    graph: TaskGraph,
    *,
    candidates: int = CANDIDATES,
    seed: int = 0,
    max_slope: float | None = None,
    tolerances: Tolerances,
    progress: Progress = silent,
) -> Tensor:
    """Finds seeds (S, n) for a task graph.

    Args:
        robot: The robot.
        task: The task space.
        graph: The task graph that will be expanded; a coarser one over its bounds is tried out first.
        candidates: How many sets of seeds are compared.
        seed: Of all random draws.
        max_slope: Slope [rad/m] above which edges are to be left out; None: no bound. It counts where maps of the graph
            itself are tried.
        tolerances: Of the projections.
        progress: Told what is being done and how far it is.

    Raises:
        ParameterError: `candidates` is out of its range.
        SeedError: No point of the graph is reached from random starts.
    """
    check_candidates(candidates)
    generator = torch.Generator().manual_seed(check_seed(seed))
    paths, share = closed_paths(robot, task, graph, candidates, generator, tolerances)
    coarse = _coarse(task, graph, math.ceil(_COARSE[task.dimension] / share))
    progress("choosing seeds", 0, 3)
    neighbours = _NEIGHBOURS if task.rotations is None else default_neighbours(task)
    quick = replace(tolerances, iterations=min(tolerances.iterations, _ITERATIONS))
    maps = _expansions(robot, task, coarse, paths, neighbours, quick)
    progress("choosing seeds", 1, 3)
    best = _costs(robot, task, coarse, maps).argsort(stable=True)[: math.ceil(_RELAXED * len(paths))]
    relaxed = _relaxed(robot, task, coarse, maps[best.to(maps.device)], tolerances, _ROUNDS)
    order = _costs(robot, task, coarse, relaxed).argsort(stable=True)[: math.ceil(_FINALISTS * len(paths))].tolist()
    finalists = [in_the_middle(robot, relaxed[rank][~relaxed[rank].isnan().any(1)]) for rank in order]
    progress("choosing seeds", 2, 3)
    if len(graph.points) > _MOST_TRIED:
        return finalists[0]

    def tried(seeds: Tensor) -> tuple[Tensor]:
        # a map and its relaxation are all that a process holds besides
        expanded = _expansions(robot, task, graph, [seeds], default_neighbours(task), tolerances)
        return (_relaxed(robot, task, graph, expanded, tolerances, _FINAL_ROUNDS, max_slope),)

    maps = torch.cat([found for (found,) in at_once(tried, finalists, robot.device)])
    progress("choosing seeds", 3, 3)
    slopes = _slopes(robot, task, graph, maps)
    broken = _broken(robot, task, graph, maps, slopes, tolerances)
    slopes = slopes if max_slope is None else slopes.clamp(max=max_slope)
    slopes[broken] = torch.nan if max_slope is None else max_slope
    best = maps[int(_sums(slopes).argmin())]
    best = _relaxed(robot, task, graph, best[None], tolerances, _LAST_ROUNDS, max_slope)[0]
    found = best[~best.isnan().any(1)]
    # on a graph with few vertices within reach none may have been placed
    return in_the_middle(robot, found) if len(found) else finalists[0]


def _coarse(task: TaskSpace, graph: TaskGraph, points: int) -> TaskGraph:
    """A grid over the same box, which is given some thickness where the graph is flat; a small graph itself.

    Where rotation varies, one of several times as many points, of which fewer rotations take a share.
    """
    if isinstance(graph, ProductGraph):
        points *= _TURNED
        if len(graph.points) <= points:
            return graph
        # as fine in each of the dimensions of rotation as in those of position
        share = (task.constraints - task.dimension) / task.constraints
        rotations = min(len(graph.rotations.values), max(_FEWEST, round(points**share)))
        return product_graph(task, _coarse(task, graph.positions, max(1, points // rotations)), rotations)
    if len(graph.points) <= points:
        return graph
    low, high = graph.points.amin(0), graph.points.amax(0)
    thickness = (0.05 * float((high - low).max()) - 0.5 * (high - low)).clamp(min=0.0)
    return staggered_grid(torch.stack([low - thickness, high + thickness], dim=1).tolist(), points)


def _expansions(
    robot: Robot,
    task: TaskSpace,
    graph: TaskGraph,
    candidates: list[Tensor],
    neighbours: int,
    tolerances: Tolerances,
) -> Tensor:
    """(C, V, n) expansions of all candidates at once; NaN where unresolved."""
    size = len(graph.points)
    seeds = torch.cat(candidates)
    owner = torch.arange(len(candidates)).repeat_interleave(torch.tensor([len(path) for path in candidates]))
    nearest = graph.nearest(tool_points(robot, task, seeds))[:, 0]
    targets = graph.points[nearest].to(seeds)
    solved, valid = project_columns(robot, task, targets.T.contiguous(), seeds.T.contiguous(), tolerances)
    valid = valid.cpu()
    vertices, inverse = (owner * size + nearest)[valid].unique(return_inverse=True)
    # of seeds that share a vertex, one
    kept = torch.empty(len(vertices), dtype=torch.long).scatter_(0, inverse, torch.arange(len(inverse)))
    expansion = grow(
        robot,
        task,
        Copies.of(graph, len(candidates)),
        vertices.to(seeds.device),
        solved.T[valid.to(seeds.device)][kept.to(seeds.device)],
        neighbours=neighbours,
        tolerances=tolerances,
    )
    return expansion.configurations.reshape(len(candidates), size, robot.n)


def _costs(robot: Robot, task: TaskSpace, graph: TaskGraph, maps: Tensor) -> Tensor:
    """(C,) sums of slopes over all edges of a graph, of maps (C, V, n); what is missing counts as steep."""
    return _sums(_slopes(robot, task, graph, maps))


def _sums(slopes: Tensor) -> Tensor:
    """(C,) sums of slopes (C, E); what is NaN counts as steep."""
    limit = _MISSING * slopes.nanmedian(dim=1).values.nan_to_num(torch.inf).amin()
    return torch.where(slopes.isnan(), limit, slopes.clamp(max=limit)).sum(1)


def _slopes(robot: Robot, task: TaskSpace, graph: TaskGraph, maps: Tensor) -> Tensor:
    """(C, E) D_q / D_p of all edges, of maps (C, V, n); NaN where an end is unresolved."""
    first, second = graph.edges.to(maps.device).unbind(1)
    points = graph.points.to(maps.device)
    return slopes_between(robot, task, points[first], points[second], maps[:, first], maps[:, second])


def _broken(
    robot: Robot, task: TaskSpace, graph: TaskGraph, maps: Tensor, slopes: Tensor, tolerances: Tolerances
) -> Tensor:
    """(C, E) edges of maps (C, V, n), with slopes (C, E), that are steep and not continuous."""
    broken = slopes > _SUSPECT * slopes.nanmedian(dim=1, keepdim=True).values
    points = graph.points.to(maps)
    which, edges = broken.nonzero().unbind(1)
    first, second = graph.edges.to(maps.device)[edges].unbind(1)
    ends = points[first], points[second], maps[which, first], maps[which, second]
    broken[which, edges] = ~continuous_pairs(robot, task, *ends, tolerances=tolerances)
    return broken


def _relaxed(
    robot: Robot,
    task: TaskSpace,
    graph: TaskGraph,
    maps: Tensor,
    tolerances: Tolerances,
    rounds: int,
    max_slope: float | None = None,
) -> Tensor:
    """Maps (C, V, n), relaxed together over all edges between resolved vertices; what is steep does not pull."""
    copies = Copies.of(graph, len(maps))
    q = maps.reshape(-1, robot.n)
    first, second = copies.edges.to(q.device).unbind(1)
    points = copies.points.to(q)
    lengths = task.distance(points[first], points[second])
    slopes = _slopes(robot, task, graph, maps).flatten()
    known = slopes.isfinite()
    if not bool(known.any()):
        return maps
    bound = _STEEP * float(slopes[known].median()) if max_slope is None else max_slope
    vertices = (~q.isnan().any(1)).nonzero()[:, 0]
    rank = torch.full((len(q),), -1, device=q.device)
    rank[vertices] = torch.arange(len(vertices), device=q.device)
    edges = torch.stack([rank[first[known]], rank[second[known]]])
    owner = vertices // len(graph.points)
    targets = points[vertices].T.contiguous()
    network = Network(robot, task, targets, edges, lengths[known], bound=bound, parts=owner)
    moved = relax(network, q[vertices].T.contiguous(), tolerances, silent, rounds)
    return q.index_put((vertices,), moved.T).reshape(maps.shape)
