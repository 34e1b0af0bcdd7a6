"""The task graph where rotation varies: the product of a graph of positions and a graph of rotations.

Edges join neighbouring positions in the same rotation, and neighbouring rotations at the same position. Nothing of the
size of the product is stored but points and edges: what lies round a vertex is worked out from both graphs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.sparse import csr_matrix, eye_array
from torch import Tensor

from grr_torch.devices import OnDevices
from grr_torch.errors import ParameterError
from grr_torch.spaces.base import ROTATION_WEIGHT, TRANSLATION_WEIGHT, TaskSpace
from grr_torch.spaces.cliques import closed, draw, triangles
from grr_torch.spaces.graph import MOST_POINTS, TaskGraph, find_lattice
from grr_torch.spaces.rotations import RotationGrid, Rotations

# most edges that may lie between a vertex and what it is averaged over
MOST_HOPS = 3
# positions within so many edges of a staggered grid, by its dimension: its first shells
_SHELLS = {2: (8, 24, 48), 3: (14, 64, 144)}
# cells of a product that are looked at; of more, so many are drawn
_MOST_CELLS = 1 << 20
# rows of distances to all rotations that are held at once, in entries
_AT_ONCE = 1 << 23


@dataclass(frozen=True, eq=False)
class ProductGraph(TaskGraph):
    """A product; vertex r · P + p is position p in rotation r.

    Attributes:
        positions: The graph of positions, P vertices.
        rotations: The rotations, R of them, and which are neighbours.
        space: Their arithmetic.
    """

    positions: TaskGraph = None  # type: ignore[assignment]
    rotations: RotationGrid = None  # type: ignore[assignment]
    space: Rotations = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Nothing: both graphs were checked."""

    def neighbours(self, vertices: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """The vertices about k edges away at most, k up to 3, and their D_p; inf where there is none.

        h edges in position count as the first h shells of a grid, so that corners and centres have equally many.
        """
        size = len(self.positions.points)
        place, turn = vertices % size, vertices // size
        indices: list[Tensor] = []
        distances: list[Tensor] = []
        for hops in range(k + 1):
            rings, lengths = (part[turn] for part in self._rings[hops].at(vertices.device))
            near, apart = self._places(place, k - hops, itself=hops > 0)
            there = rings >= 0
            index = torch.where(there, rings, 0)[:, :, None] * size + near[:, None]
            total = torch.where(there, lengths, torch.inf)[:, :, None] + apart[:, None]
            indices.append(torch.where(total.isfinite(), index, 0).flatten(1))
            distances.append(total.flatten(1))
        return torch.cat(indices, dim=1), torch.cat(distances, dim=1)

    def around(self, vertices: Tensor) -> tuple[Tensor, Tensor]:
        """As of any graph, worked out from both: compressed rows of a large product would not fit."""
        size = len(self.positions.points)
        place, turn = vertices % size, vertices // size
        rank, near = self.positions.around(place)
        rings = self._rings[1].at(vertices.device)[0][turn]
        rows, columns = (rings >= 0).nonzero().unbind(1)
        ranks = torch.cat([rank, rows])
        others = torch.cat([turn[rank] * size + near, rings[rows, columns] * size + place[rows]])
        order = ranks.argsort(stable=True)
        return ranks[order], others[order]

    def _places(self, places: Tensor, hops: int, *, itself: bool) -> tuple[Tensor, Tensor]:
        """Positions (F, K) round others and how far they are [m], the position itself first if it is wanted."""
        found = [(places[:, None], torch.zeros_like(places[:, None], dtype=torch.float64))] if itself else []
        if hops:
            near, apart = self.positions.neighbours(places, _SHELLS[self.positions.points.shape[1]][hops - 1])
            found.append((near, TRANSLATION_WEIGHT * apart))
        if not found:
            return places.new_empty(len(places), 0), places.new_empty(len(places), 0, dtype=torch.float64)
        return torch.cat([near for near, _ in found], dim=1), torch.cat([apart for _, apart in found], dim=1)

    @cached_property
    def _rings(self) -> list[OnDevices]:
        """By edges: rotations (R, M) exactly so many away, −1 where there are fewer, and how far they are in D_p."""
        values, edges = self.rotations.values, self.rotations.edges.numpy()
        count = len(values)
        joined = csr_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
        joined = joined + joined.T
        seen = eye_array(count, format="csr")
        rings = [OnDevices(torch.arange(count)[:, None], torch.zeros(count, 1, dtype=torch.float64))]
        within = seen
        for _ in range(MOST_HOPS):
            within = ((within @ joined + within) > 0).astype(np.float64)
            ring = csr_matrix(within - seen)
            ring.eliminate_zeros()
            seen = within
            table = _padded(ring.indptr, ring.indices, count)
            apart = self.space.distance(values[:, None], values[table.clamp_min(0)])
            rings.append(OnDevices(table, ROTATION_WEIGHT * apart))
        return rings

    def nearest(self, points: Tensor, k: int = 1) -> Tensor:
        """Indices (*batch, k) of the vertices nearest to each point (*batch, width) by D_p, nearest first."""
        d = self.positions.points.shape[1]
        flat = points.reshape(-1, points.shape[-1]).cpu().to(torch.float64)
        # what is among the k nearest of a sum is among the k nearest in both of its parts
        places = self.positions.nearest(flat[:, :d], k)
        turns, apart = self.nearest_rotations(flat[:, d:], k)
        gaps = (flat[:, None, :d] - self.positions.points[places]).norm(dim=2)
        total = (ROTATION_WEIGHT * apart)[:, :, None] + TRANSLATION_WEIGHT * gaps[:, None]
        count = min(k, total[0].numel()) if len(total) else k
        order = total.flatten(1).topk(count, largest=False).indices
        indices = (turns[:, :, None] * len(self.positions.points) + places[:, None]).flatten(1)
        return indices.gather(1, order).reshape(*points.shape[:-1], -1)

    def nearest_rotations(self, rotations: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """The k nearest rotations (N, k) of others (N, w), nearest first, and 1 − |o_i · o_j| to them."""
        count = len(self.rotations.values)
        found = [
            self.space.distances(part, self.rotations.values).topk(min(k, count), largest=False)
            for part in rotations.split(max(1, _AT_ONCE // count))
        ]
        if not found:
            return torch.empty(0, min(k, count), dtype=torch.long), torch.empty(0, min(k, count), dtype=torch.float64)
        return torch.cat([part.indices for part in found]), torch.cat([part.values for part in found])

    def triangles(self, kept: Tensor) -> Tensor:
        """Triangles of positions in one rotation and of rotations at one position; of very many, a random part."""
        size, count = len(self.positions.points), len(self.rotations.values)
        flat = triangles(self.positions.edges, size)
        turning = triangles(self.rotations.edges, count)
        drawn = draw(len(flat) * count + len(turning) * size, _MOST_CELLS)
        first = drawn[drawn < len(flat) * count]
        rest = drawn[len(first) :] - len(flat) * count
        corners = [
            flat[first % max(1, len(flat))] + (first // max(1, len(flat)) * size)[:, None],
            turning[rest % max(1, len(turning))] * size + (rest // max(1, len(turning)))[:, None],
        ]
        return closed(torch.cat(corners), self.edges[kept], len(self.points))

    def faces(self, kept: Tensor) -> Tensor:
        """Faces of the grid's cells, and an edge of positions by one of rotations; of very many, a random part."""
        size, count = len(self.positions.points), len(self.rotations.values)
        flat = self.positions.lattice.faces() if self.positions.lattice else torch.empty(0, 4, dtype=torch.long)
        edges, turns = self.positions.edges, self.rotations.edges
        drawn = draw(len(flat) * count + len(edges) * len(turns), _MOST_CELLS)
        first = drawn[drawn < len(flat) * count]
        rest = drawn[len(first) :] - len(flat) * count
        edge, turn = edges[rest % max(1, len(edges))], turns[rest // max(1, len(edges))] * size
        around = [edge[:, 0] + turn[:, 0], edge[:, 1] + turn[:, 0], edge[:, 1] + turn[:, 1], edge[:, 0] + turn[:, 1]]
        corners = [flat[first % max(1, len(flat))] + (first // max(1, len(flat)) * size)[:, None]]
        return closed(torch.cat([*corners, torch.stack(around, dim=1)]), self.edges[kept], len(self.points))


def rotating(task: TaskSpace, rotations: int) -> Rotations:
    """The space in which a task's rotations vary, of which so many are asked for.

    Raises:
        ParameterError: They do not vary.
    """
    if task.rotations is None:
        valid = f"none for the task '{task.kind}', in which rotation does not vary"
        raise ParameterError("rotations", rotations, valid)
    return task.rotations


def product_graph(task: TaskSpace, positions: TaskGraph, rotations: int) -> ProductGraph:
    """The product of a graph of positions and a grid of rotations.

    Args:
        task: A task space in which rotation varies.
        positions: (P, d) points and their edges.
        rotations: How many rotations the grid has: a ring of yaws, a Fibonacci lattice of directions on the sphere,
            or a super-Fibonacci spiral of orientations.

    Raises:
        ParameterError: Rotation does not vary in the task, or there would be too few or too many vertices.
    """
    space = rotating(task, rotations)
    grid = space.grid(rotations)
    count, size = len(grid.values), len(positions.points)
    if count * size > MOST_POINTS:
        raise ParameterError("rotations", rotations, f"up to {MOST_POINTS // size:,} for {size:,} positions")
    points = torch.cat([positions.points.repeat(count, 1), grid.values.repeat_interleave(size, dim=0)], dim=1)
    along = (positions.edges[None] + size * torch.arange(count)[:, None, None]).reshape(-1, 2)
    across = (size * grid.edges[:, None] + torch.arange(size)[None, :, None]).reshape(-1, 2)
    return ProductGraph(points, torch.cat([along, across]), None, positions, grid, space)


def find_product(task: TaskSpace, points: Tensor, edges: Tensor) -> ProductGraph:
    """The product that points (V, width) and edges are, in the order of `product_graph`.

    Raises:
        ParameterError: They are none.
    """
    space, d = task.rotations, task.dimension
    assert space is not None
    same = (points[:, d:] == points[:1, d:]).all(1)
    size = len(points) if bool(same.all()) else int(same.int().argmin())
    count = len(points) // size
    wrong = ParameterError("points", f"{len(points)} of {task.name}", "positions times rotations, as product_graph has")
    if count * size != len(points):
        raise wrong
    table = points.reshape(count, size, -1)
    if not (torch.equal(table[..., :d], table[:1, :, :d].expand(count, -1, -1))):
        raise wrong
    if not torch.equal(table[..., d:], table[:, :1, d:].expand(-1, size, -1)):
        raise wrong
    along = edges[(edges < size).all(1)]
    across = edges[(edges % size == 0).all(1)] // size
    across = across[across[:, 0] != across[:, 1]]
    if len(along) * count + len(across) * size != len(edges):
        raise wrong
    places = points[:size, :d].contiguous()
    grid = RotationGrid(table[:, 0, d:].contiguous(), across)
    return ProductGraph(points, edges, None, TaskGraph(places, along, find_lattice(places)), grid, space)


def _padded(starts: np.ndarray, ends: np.ndarray, count: int) -> Tensor:
    """Compressed rows as a table (R, M), −1 where a row is shorter."""
    counts = np.diff(starts)
    table = np.full((count, int(counts.max(initial=0))), -1, dtype=np.int64)
    rows = np.repeat(np.arange(count), counts)
    table[rows, np.arange(len(ends)) - np.repeat(starts[:-1], counts)] = ends
    return torch.from_numpy(table)
