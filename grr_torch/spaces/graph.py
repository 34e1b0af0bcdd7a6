"""The task graph G_p: points of a task space and the edges between them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree
from torch import Tensor

from grr_torch.devices import OnDevices
from grr_torch.errors import ParameterError, check_whole
from grr_torch.spaces.cliques import closed, triangles
from grr_torch.spaces.lattice import Lattice

Bounds = Sequence[tuple[float, float]]

# metres beyond which a bound is a mistake
_FARTHEST = 1e6
# neighbour tables of a larger graph would not fit a laptop
MOST_POINTS = 2_000_000


@dataclass(frozen=True, eq=False)
class TaskGraph:
    """Points and edges; immutable.

    Attributes:
        points: (V, width) points of the task space [m], float64, on the CPU.
        edges: (E, 2) vertex indices, smaller one first.
        lattice: Where the points are a staggered grid's: its arithmetic, which finds neighbours without a search.
    """

    points: Tensor
    edges: Tensor
    lattice: Lattice | None = None

    def __post_init__(self) -> None:
        points, edges = self.points, self.edges
        if points.ndim != 2 or points.dtype != torch.float64 or len(points) == 0 or not bool(points.isfinite().all()):
            shape = f"{points.dtype} of shape {tuple(points.shape)}"
            raise ParameterError("points of a graph", shape, "finite torch.float64 of shape (V, d), V ≥ 1")
        inside = edges.dtype == torch.int64 and edges.ndim == 2 and edges.shape[1] == 2
        if not inside or bool(((edges < 0) | (edges >= len(points))).any()):
            shape = f"{edges.dtype} of shape {tuple(edges.shape)}"
            raise ParameterError("edges of a graph", shape, f"torch.int64 of shape (E, 2), from 0 to {len(points) - 1}")
        if not bool((edges[:, 0] < edges[:, 1]).all()):
            raise ParameterError("edges of a graph", "one whose first vertex is not the smaller one", "pairs a < b")
        if _some_repeat(edges.numpy(), len(points)):
            raise ParameterError("edges of a graph", "one that is there twice", "pairs that differ")
        if self.lattice is None and _some_coincide(points.numpy()):
            raise ParameterError("points of a graph", "two that coincide", "points that differ")

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points.numpy())

    def neighbours(self, vertices: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """The k nearest other vertices of some vertices.

        In a staggered grid, those as near as the k-th are among them, and what would lie beyond its border is not.
        Where rotation varies, k counts edges: by D_p alone, many rotations at one place are nearer than any other.

        Args:
            vertices: (F,) vertices.
            k: How many; fewer are given where the graph has fewer vertices.

        Returns:
            Indices (F, K) and distances (F, K) [m]; inf where there is no such vertex.
        """
        if self.lattice is not None:
            return self.lattice.neighbours(vertices, k)
        ranks = range(1, min(k + 1, len(self.points)) + 1)
        distances, indices = self._tree.query(self.points[vertices.cpu()].numpy(), k=ranks, workers=-1)
        # the vertex itself comes first: no two vertices coincide
        found, apart = (torch.from_numpy(table[:, 1:]).to(vertices.device) for table in (indices, distances))
        return found, apart

    def nearest(self, points: Tensor, k: int = 1) -> Tensor:
        """Indices (*batch, k) of the vertices nearest to each point (*batch, d), nearest first."""
        ranks = range(1, min(k, len(self.points)) + 1)
        return torch.from_numpy(np.asarray(self._tree.query(points.cpu().numpy(), k=ranks, workers=-1)[1]))

    @cached_property
    def adjacency(self) -> tuple[Tensor, Tensor]:
        """Compressed rows: the neighbours along edges of vertex v are ends[starts[v] : starts[v + 1]]."""
        first, second = self.edges.numpy().T
        both = (np.concatenate([first, second]), np.concatenate([second, first]))
        rows = csr_matrix((np.ones(len(both[0]), dtype=np.int8), both), shape=(len(self.points),) * 2)
        return torch.from_numpy(rows.indptr.astype(np.int64)), torch.from_numpy(rows.indices.astype(np.int64))

    @cached_property
    def _rows(self) -> OnDevices:
        return OnDevices(*self.adjacency)

    def around(self, vertices: Tensor) -> tuple[Tensor, Tensor]:
        """The neighbours along edges of some vertices (F,), one after the other.

        Returns:
            Ranks (K,) in `vertices`, which say whose neighbour it is, and the neighbours (K,).
        """
        device = vertices.device
        starts, ends = self._rows.at(device)
        counts = starts[vertices + 1] - starts[vertices]
        rank = torch.repeat_interleave(torch.arange(len(vertices), device=device), counts)
        places = torch.arange(len(rank), device=device) + (starts[vertices] - counts.cumsum(0) + counts)[rank]
        return rank, ends[places]

    def triangles(self, kept: Tensor) -> Tensor:
        """(C, 3) triangles of those edges that are kept (E,), smallest vertex first."""
        return triangles(self.edges[kept], len(self.points))

    def faces(self, kept: Tensor) -> Tensor:
        """(C, 4) faces of a spatial grid's cells all of whose edges are kept (E,); none in other graphs."""
        corners = torch.empty(0, 4, dtype=torch.long) if self.lattice is None else self.lattice.faces()
        return closed(corners, self.edges[kept], len(self.points))

    def edge_between(self, first: Tensor, second: Tensor) -> Tensor:
        """Indices (K,) of the edges that join vertices (K,) to others (K,).

        Raises:
            ParameterError: Two of them are not joined.
        """
        keys, order = self._sorted_keys.at(first.device)
        pairs = torch.stack([first, second], dim=1).sort(dim=1).values
        wanted = pairs[:, 0] * len(self.points) + pairs[:, 1]
        places = torch.searchsorted(keys, wanted)
        found = torch.searchsorted(keys, wanted, right=True) > places
        if not bool(found.all()):
            wrong = tuple(pairs[~found][0].tolist())
            raise ParameterError("vertices", wrong, "two that an edge joins")
        return order[places]

    @cached_property
    def _sorted_keys(self) -> OnDevices:
        return OnDevices(*(self.edges[:, 0] * len(self.points) + self.edges[:, 1]).sort())


@dataclass(frozen=True, eq=False)
class Copies(TaskGraph):
    """Several copies of a graph, one after the other, with nothing between them: many expansions at once.

    Attributes:
        base: The graph that is copied.
    """

    base: TaskGraph | None = None

    def __post_init__(self) -> None:
        """Nothing: the graph that is copied was checked, and copies coincide."""

    @staticmethod
    def of(base: TaskGraph, count: int) -> Copies:
        """`count` copies of a graph."""
        shifts = torch.arange(count)[:, None, None] * len(base.points)
        edges = (base.edges[None] + shifts).reshape(-1, 2)
        return Copies(base.points.repeat(count, 1), edges, base.lattice, base)

    def neighbours(self, vertices: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """As of the graph that is copied."""
        assert self.base is not None
        size = len(self.base.points)
        indices, distances = self.base.neighbours(vertices % size, k)
        return indices + (vertices - vertices % size)[:, None], distances


def _some_coincide(points: np.ndarray) -> bool:
    ordered = points[np.lexsort(points.T)]
    return bool((ordered[1:] == ordered[:-1]).all(1).any())


def _some_repeat(edges: np.ndarray, count: int) -> bool:
    keys = edges[:, 0] * count + edges[:, 1]
    # a grid's edges come in a few sorted runs, which this kind of sort merges
    keys.sort(kind="stable")
    return bool((keys[1:] == keys[:-1]).any())


def check_bounds(bounds: Bounds) -> tuple[tuple[float, float], ...]:
    """Bounds as pairs of floats.

    Raises:
        ParameterError: They are not two or three finite intervals of positive length.
    """
    valid = "two or three intervals, low < high, finite, in metres"
    try:
        pairs = tuple((float(low), float(high)) for low, high in bounds)
    except (TypeError, ValueError, OverflowError) as error:
        raise ParameterError("bounds", bounds, valid) from error
    if len(pairs) not in (2, 3) or not all(-_FARTHEST <= a < b <= _FARTHEST for a, b in pairs):
        raise ParameterError("bounds", pairs, valid)
    return pairs


def check_count(points: int) -> int:
    """The number of vertices asked for.

    Raises:
        ParameterError: It is no whole number, below 1 or beyond what could be held.
    """
    return check_whole("points", points, 1, MOST_POINTS)


def staggered_grid(bounds: Bounds, n: int) -> TaskGraph:
    """Corners of a grid of nearly cubic cells and the cells' centres, at least n vertices in all.

    Corners are joined to their neighbours along every axis, centres to the corners of their cell. Of the grids whose
    counts of cells lie next to those of exactly cubic cells, the smallest that has n vertices is taken.

    Args:
        bounds: (low, high) of each axis [m].
        n: How many vertices are asked for.

    Raises:
        ParameterError: The bounds are empty or n is not valid.
    """
    pairs, n = check_bounds(bounds), check_count(n)
    cells = _cells([high - low for low, high in pairs], n)
    lattice, points = _lattice(pairs, cells)
    corner = np.arange(math.prod(count + 1 for count in cells)).reshape([count + 1 for count in cells])
    centre = corner.size + np.arange(math.prod(cells)).reshape(cells)
    edges: list[np.ndarray] = []
    for axis in range(len(cells)):
        first, second = np.delete(corner, -1, axis), np.delete(corner, 0, axis)
        edges.append(np.stack([first.ravel(), second.ravel()], axis=1))
    for shift in itertools.product((0, 1), repeat=len(cells)):
        window = tuple(slice(s, s + count) for s, count in zip(shift, cells, strict=True))
        edges.append(np.stack([corner[window].ravel(), centre.ravel()], axis=1))
    return TaskGraph(points, torch.from_numpy(np.concatenate(edges)), lattice)


def find_lattice(points: Tensor) -> Lattice | None:
    """The arithmetic of points (V, d), if they are a staggered grid's in its order."""
    axes = [np.unique(axis) for axis in points.numpy().T]
    cells = tuple((len(axis) - 1) // 2 for axis in axes)
    if min(cells) < 1 or math.prod(count + 1 for count in cells) + math.prod(cells) != len(points):
        return None
    lattice, expected = _lattice([(float(axis[0]), float(axis[-1])) for axis in axes], cells)
    return lattice if torch.equal(points, expected) else None


def _lattice(pairs: Bounds, cells: tuple[int, ...]) -> tuple[Lattice, Tensor]:
    """A staggered grid's arithmetic and its points: corners, then centres."""
    lines = [np.linspace(low, high, count + 1) for (low, high), count in zip(pairs, cells, strict=True)]
    middles = [0.5 * (line[1:] + line[:-1]) for line in lines]
    spacing = tuple((high - low) / count for (low, high), count in zip(pairs, cells, strict=True))
    return Lattice(cells, spacing), torch.from_numpy(np.concatenate([_mesh(lines), _mesh(middles)]))


def random_graph(bounds: Bounds, n: int, *, k: int, generator: torch.Generator | None = None) -> TaskGraph:
    """N points drawn uniformly within bounds, each joined to its k nearest.

    Args:
        bounds: (low, high) of each axis [m].
        n: How many points.
        k: How many neighbours each is joined to.
        generator: Source of randomness; torch's global one by default.

    Raises:
        ParameterError: The bounds are empty, or n or k is not valid.
    """
    pairs, n = check_bounds(bounds), check_count(n)
    if n == 1:
        raise ParameterError("points", n, "2 or more, each of which is joined to others")
    k = check_whole("k", k, 1, n - 1)
    low, high = torch.tensor(pairs, dtype=torch.float64).T
    points = low + (high - low) * torch.rand(n, len(pairs), dtype=torch.float64, generator=generator)
    indices = TaskGraph(points, torch.empty(0, 2, dtype=torch.long)).neighbours(torch.arange(n), k)[0]
    pairs_of = torch.stack([torch.arange(n)[:, None].expand_as(indices), indices], dim=-1).reshape(-1, 2)
    return TaskGraph(points, torch.unique(pairs_of.sort(dim=1).values, dim=0))


def _cells(lengths: Sequence[float], n: int) -> tuple[int, ...]:
    """Counts of cells along each axis: floor or ceiling of the real counts that give n vertices of cubic cells."""

    def vertices(counts: Sequence[float]) -> float:
        return math.prod(count + 1 for count in counts) + math.prod(counts)

    low, high = 0.0, max(lengths)
    while vertices([length / high for length in lengths]) > n:
        high *= 2.0
    for _ in range(100):
        edge = 0.5 * (low + high)
        if vertices([length / edge for length in lengths]) > n:
            low = edge
        else:
            high = edge
    choices = itertools.product(*({max(1, math.floor(x / high)), math.ceil(x / high)} for x in lengths))
    enough = [counts for counts in choices if vertices(counts) >= n]
    return min(enough, key=lambda counts: (vertices(counts), counts))


def _mesh(lines: Sequence[np.ndarray]) -> np.ndarray:
    return np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, len(lines))
