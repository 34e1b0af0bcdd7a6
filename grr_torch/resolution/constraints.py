"""A solver of constraint satisfaction problems: one value for every variable, so that many constraints hold.

Min-conflicts with restarts and random descents, all variables of a colour at once: values are grown from one variable
over the graph, then drawn again and again with probability ∝ exp(constraints held / T), while T falls.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order

# sweeps of a descent, and temperatures at its start and end, in constraints
_SWEEPS = 300
_HOT, _COLD = 0.5, 0.15


class _Colour:
    """Variables without constraints between them, and the constraints that they have."""

    def __init__(self, variables: np.ndarray, edges: np.ndarray, count: int):
        rank = np.full(count, -1)
        rank[variables] = np.arange(len(variables))
        ranks = rank[edges]
        self.variables = variables
        self.as_first, self.as_second = (np.flatnonzero(side >= 0) for side in ranks.T)
        rows = np.concatenate([ranks[self.as_first, 0], ranks[self.as_second, 1]])
        ones = np.ones(len(rows), dtype=np.float32)
        self.owners = csr_matrix((ones, (rows, np.arange(len(rows)))), shape=(len(variables), len(rows)))


@dataclass(frozen=True, eq=False)
class Constraints:
    """Pairs of variables, and which pairs of their values are compatible.

    Attributes:
        edges: (E, 2) variables.
        compatible: (E, K, K) bool, by values of the first and of the second.
        counts: (V,) how many of the K values a variable has.
    """

    edges: np.ndarray
    compatible: np.ndarray
    counts: np.ndarray

    def held(self, values: np.ndarray) -> np.ndarray:
        """(E,) constraints that values (V,) satisfy."""
        first, second = self.edges.T
        return self.compatible[np.arange(len(self.edges)), values[first], values[second]]

    def descend(self, values: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """The best values (V,) of a random descent from given ones."""
        best, most = values, int(self.held(values).sum())
        values = values.copy()
        for temperature in np.geomspace(_HOT, _COLD, _SWEEPS):
            for colour in self._colours:
                scores = self._scores(colour, values) / np.float32(temperature)
                scores += random.gumbel(size=scores.shape).astype(np.float32)
                values[colour.variables] = scores.argmax(1)
            held = int(self.held(values).sum())
            if held > most:
                best, most = values.copy(), held
            if most == len(self.edges):
                break
        return best

    def _scores(self, colour: _Colour, values: np.ndarray) -> np.ndarray:
        """(C, K) constraints that each value of a colour's variables would satisfy; −inf where it has no such value."""
        first, second = self.edges.T
        by_value = [
            self.compatible[colour.as_first, :, values[second[colour.as_first]]],
            self.compatible[colour.as_second, values[first[colour.as_second]], :],
        ]
        scores: np.ndarray = colour.owners @ np.concatenate(by_value).astype(np.float32)
        scores[np.arange(scores.shape[1]) >= self.counts[colour.variables, None]] = -np.inf
        return scores

    def grow(self, random: np.random.Generator) -> np.ndarray:
        """Values (V,), each of which satisfies as many constraints with those before it as it can."""
        scores = random.random((len(self.counts), self.compatible.shape[1]))
        scores[np.arange(scores.shape[1]) >= self.counts[:, None]] = -np.inf
        values = np.zeros(len(self.counts), dtype=np.int64)
        for variable in self._order(random):
            value = values[variable] = scores[variable].argmax()
            for edge, other, is_first in self._around[variable]:
                scores[other] += self.compatible[edge, value] if is_first else self.compatible[edge, :, value]
        return values

    def _order(self, random: np.random.Generator) -> list[int]:
        """Variables that have a value, breadth first from a random one, and again from one that is left."""
        left = self.counts > 0
        first, second = self.edges.T
        links = csr_matrix((np.ones(len(first), dtype=bool), (first, second)), shape=(len(left), len(left)))
        order: list[int] = []
        while left.any():
            reached = breadth_first_order(
                links, random.choice(np.flatnonzero(left)), directed=False, return_predecessors=False
            )
            order.extend(reached.tolist())
            left[reached] = False
        return order

    @cached_property
    def _around(self) -> list[list[tuple[int, int, bool]]]:
        """By variable: its edges, their other ends, and whether it comes first."""
        around: list[list[tuple[int, int, bool]]] = [[] for _ in self.counts]
        for edge, (a, b) in enumerate(self.edges.tolist()):
            around[a].append((edge, b, True))
            around[b].append((edge, a, False))
        return around

    @cached_property
    def _colours(self) -> list[_Colour]:
        """Colours, given greedily."""
        colour = np.full(len(self.counts), -1)
        for variable in np.flatnonzero(self.counts > 0).tolist():
            taken = {int(colour[other]) for _, other, _ in self._around[variable]}
            colour[variable] = next(k for k in range(len(taken) + 1) if k not in taken)
        return [
            _Colour(np.flatnonzero(colour == k), self.edges, len(self.counts)) for k in range(int(colour.max()) + 1)
        ]
