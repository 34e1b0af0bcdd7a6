"""How much smoother a roadmap could be: a lower bound of the mean slope, among samples of the self-motion manifolds.

To choose one configuration a vertex, out of samples, so that the sum of D_q / D_p over the edges is least is a
labelling problem. Message passing gives a bound that no choice is below, and a choice. Where both meet, nothing
smoother is among the samples. A map's own configurations are among them, so what is between the bound and the map is
what refinement left; a map between the samples may be a little smoother still, so their spacing is told.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from grr_torch.errors import ParameterError, check_seed
from grr_torch.experiments.labelling import ENTRIES, Graph, Search
from grr_torch.pieces import one_thread
from grr_torch.progress import Progress, silent
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.memory import free_memory
from grr_torch.resolution.reachability import from_random_starts
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.spaces.configuration import difference, distance

# random starts of a vertex, for each sample that is kept
_STARTS = 5
# vertices whose starts are projected, and thinned, together
_SAMPLED_TOGETHER = 64
# bytes of an entry of a table, and how much of the free memory tables may take
_BYTES, _SHARE = 4, 0.8
# self-motion manifolds of more dimensions would be sampled too coarsely to tell anything
_MOST_SPARE = 2
# bound and choice have met when they differ by less than this share
_MET = 1e-5


@dataclass(frozen=True)
class Bound:
    """What can be reached at most.

    Attributes:
        robot: The robot's name.
        task: The kind of task.
        vertices: Resolved vertices.
        edges: Edges between them, broken ones included.
        left_out: How many of these edges a map may leave out.
        samples: Of each self-motion manifold.
        spacing: How far the random start that is farthest from a vertex's samples is from the nearest of them, median
            and maximum over the vertices [rad; sliding joints in m].
        iterations: Of the message passing.
        smoothness: Of the given map, over the edges but its steepest `left_out` [rad/m].
        best: Of the smoothest choice found, likewise; it need not be continuous along every edge.
        bound: What no choice of samples is below.
        seconds: What it took.
    """

    robot: str
    task: str
    vertices: int
    edges: int
    left_out: int
    samples: int
    spacing: tuple[float, float]
    iterations: int
    smoothness: float
    best: float
    bound: float
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """All of it, for JSON."""
        return asdict(self)


def measure_bound(
    roadmap: Roadmap,
    *,
    samples: int = 300,
    iterations: int = 60,
    left_out: Sequence[int] = (0,),
    seed: int = 0,
    progress: Progress = silent,
) -> list[Bound]:
    """Bounds the mean slope over the edges between a roadmap's resolved vertices from below, among samples.

    A map whose configurations lie between the samples may be smoother, the less the finer they are.

    Args:
        roadmap: The roadmap, on the device that is to be used.
        samples: Of each self-motion manifold, the map's own configuration among them.
        iterations: Of the message passing, at most.
        left_out: How many edges may be left out; a bound for each such number.
        seed: Of the random starts.
        progress: Told what is being done and how far it is.

    Raises:
        ParameterError: A number is out of its range, the task does not leave one or two degrees of freedom, no edge
            is between resolved vertices, or the tables do not fit the memory.
    """
    begin = time.perf_counter()
    vertices = roadmap.resolved.nonzero()[:, 0]
    graph = Graph.of(roadmap, vertices, roadmap.robot.device)
    _check(roadmap, len(graph.low), samples, iterations, left_out)
    labels, spacing = _sampled(roadmap, vertices, samples, check_seed(seed), progress)
    own = torch.zeros(len(vertices), dtype=torch.long, device=labels.device)
    slopes = _slopes(roadmap, graph, labels, own)
    bounds: list[Bound] = []
    for number in left_out:
        found = _search(roadmap, graph, labels, slopes, number, iterations, progress)
        smoothness = mean_without(slopes, number)
        bounds.append(
            Bound(
                robot=roadmap.robot.name,
                task=roadmap.task.kind,
                vertices=len(vertices),
                edges=len(slopes),
                left_out=number,
                samples=samples,
                spacing=(float(spacing.median()), float(spacing.max())),
                iterations=found.iterations,
                smoothness=smoothness,
                best=min(smoothness, found.best),
                bound=found.bound,
                seconds=time.perf_counter() - begin,
            )
        )
        begin = time.perf_counter()
    return bounds


class _Found(NamedTuple):
    """What message passing comes to, of all edges but some: mean slope of its choice, a bound of all, iterations."""

    best: float
    bound: float
    iterations: int


def _search(
    roadmap: Roadmap, graph: Graph, labels: Tensor, slopes: Tensor, left_out: int, iterations: int, progress: Progress
) -> _Found:
    """Passes messages. The tables are gone when it returns: those of the next search are as large as they."""
    truncated = float(slopes.topk(left_out).values[-1]) if left_out else torch.inf
    search = Search(graph, _tables(roadmap, graph, labels, truncated, progress))
    done = 0
    while done < iterations and search.best - search.bound > _MET * search.best:
        progress("passing messages", done, iterations)
        search.go_on()
        done += 1
    progress("passing messages", iterations, iterations)
    best = mean_without(_slopes(roadmap, graph, labels, search.chosen), left_out)
    return _Found(best, bound_without(search.bound, len(slopes), left_out, truncated), done)


def bound_without(total: float, edges: int, left_out: int, truncated: float) -> float:
    """A bound of the mean slope of all edges but any `left_out`, of one of the sum of all slopes, each truncated.

    Of E slopes whose sum, counted up to τ each, is at least B, any E − k sum up to at least B − k τ.
    """
    return (total - (left_out * truncated if left_out else 0.0)) / (edges - left_out)


def mean_without(slopes: Tensor, left_out: int) -> float:
    """The mean of slopes (E,) but for the steepest."""
    return float(slopes.sort().values[: len(slopes) - left_out].mean())


def _check(roadmap: Roadmap, edges: int, samples: int, iterations: int, left_out: Sequence[int]) -> None:
    spare = roadmap.robot.n - roadmap.task.constraints
    if not 1 <= spare <= _MOST_SPARE:
        raise ParameterError("roadmap", f"a task that leaves {spare} degrees of freedom", f"1 to {_MOST_SPARE}")
    if edges == 0:
        raise ParameterError("roadmap", "no edge between resolved vertices", "a roadmap with some")
    if iterations < 1:
        raise ParameterError("iterations", iterations, "1 or more")
    for number in left_out:
        if not 0 <= number < edges:
            raise ParameterError("left_out", number, f"0 to {edges - 1:,}, of {edges:,} edges")
    free = free_memory(roadmap.robot.device)
    fitting = None if free is None else int((_SHARE * free / (_BYTES * edges)) ** 0.5)
    if samples < 2 or (fitting is not None and samples > fitting):
        most = "" if fitting is None else f", and up to {fitting:,} fit the memory that is free"
        raise ParameterError("samples", samples, f"2 or more{most}")


def _sampled(roadmap: Roadmap, vertices: Tensor, samples: int, seed: int, progress: Progress) -> tuple[Tensor, Tensor]:
    """(V, L, n) configurations that lie far apart, the map's own first, and the spacing (V,) of each vertex's."""
    robot, device = roadmap.robot, roadmap.robot.device
    generator = torch.Generator().manual_seed(seed)
    tolerances = Tolerances(**roadmap.parameters["tolerances"])
    labels: list[Tensor] = []
    spacing: list[Tensor] = []
    for part in vertices.split(_SAMPLED_TOGETHER):
        progress("sampling self-motion manifolds", len(labels) * _SAMPLED_TOGETHER, len(vertices))
        starts = _STARTS * samples
        found, valid = from_random_starts(robot, roadmap.task, roadmap.points[part], starts, generator, tolerances)
        found = torch.where(valid[..., None], found, roadmap.configurations[part, None]).float().to(device)
        kept, apart = _far_apart(found, roadmap.configurations[part].float().to(device), robot.continuous, samples)
        labels.append(kept)
        spacing.append(apart)
    return torch.cat(labels), torch.cat(spacing).cpu()


def _far_apart(found: Tensor, first: Tensor, continuous: Tensor, samples: int) -> tuple[Tensor, Tensor]:
    """Of configurations (K, N, n), some (K, L, n) that lie far apart, `first` (K, n) first; how far (K,) others are."""
    row = torch.arange(len(found), device=found.device)
    kept, apart = [first], torch.full_like(found[..., 0], torch.inf)
    # short calls, for which threads would wait for each other
    with one_thread():
        for _ in range(samples):
            apart = torch.minimum(apart, distance(found, kept[-1][:, None], continuous))
            kept.append(found[row, apart.argmax(1)])
    return torch.stack(kept[:-1], dim=1), apart.amax(1)


def _slopes(roadmap: Roadmap, graph: Graph, labels: Tensor, chosen: Tensor) -> Tensor:
    """(E,) D_q / D_p of a choice (V,) of labels (V, L, n)."""
    q = labels[torch.arange(len(chosen), device=chosen.device), chosen]
    return (distance(q[graph.low], q[graph.high], roadmap.robot.continuous) / graph.lengths).double()


def _tables(roadmap: Roadmap, graph: Graph, labels: Tensor, truncated: float, progress: Progress) -> Tensor:
    """(E, L, L) slopes of all edges, by the labels of their ends."""
    edges, size = len(graph.low), labels.shape[1]
    tables = labels.new_zeros(edges, size, size)
    for part in torch.arange(edges, device=labels.device).split(max(1, ENTRIES // size**2)):
        progress("tables of slopes", int(part[0]), edges)
        low, high = labels[graph.low[part]], labels[graph.high[part]]
        table = tables[part[0] : part[-1] + 1]
        for joint, wraps in enumerate(roadmap.robot.continuous):
            table += difference(low[:, :, None, joint], high[:, None, :, joint], wraps).square()
        table.sqrt_().div_(graph.lengths[part, None, None]).clamp_(max=truncated)
    return tables
