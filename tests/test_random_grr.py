"""The random baseline."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import grr_torch
from grr_torch.errors import ParameterError
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.constraints import Constraints
from grr_torch.resolution.edges import check_edges
from grr_torch.resolution.random_grr import random_grr
from grr_torch.spaces.graph import staggered_grid


def test_random_grr_resolves_the_disc_with_continuous_edges(planar_5):
    roadmap = grr_torch.build(
        planar_5, "position", points=150, method="random", samples=40, refine=False, reachability=4
    )
    quality = roadmap.quality()
    assert quality.coverage == 1.0
    assert quality.connectivity > 0.97
    assert torch.equal(check_edges(roadmap, Tolerances())[roadmap.connected], roadmap.connected[roadmap.connected])
    # what is picked at random is steeper than what is expanded
    assert quality.smoothness > grr_torch.build(planar_5, "position", points=150).quality().smoothness


def test_more_pairs_tested_leave_fewer_edges_broken(planar_5):
    few, many = (
        grr_torch.build(planar_5, "position", points=100, method="random", samples=15, nearest=nearest, refine=False)
        for nearest in (1, 12)
    )
    assert (few.parameters["nearest"], many.parameters["nearest"]) == (1, 12)
    assert many.connected.sum() > few.connected.sum()


def test_a_solvable_problem_is_solved_and_values_are_those_a_variable_has():
    """A ring of variables with few compatible pairs, one assignment of which holds throughout."""
    random = np.random.default_rng(0)
    variables, values = 60, 12
    counts = random.integers(6, values + 1, variables)
    planted = random.integers(0, counts)
    edges = np.array([(i, (i + step) % variables) for i in range(variables) for step in (1, 2)])
    compatible = random.random((len(edges), values, values)) < 0.15
    compatible[np.arange(len(edges)), planted[edges[:, 0]], planted[edges[:, 1]]] = True
    problem = Constraints(edges, compatible, counts)
    start = problem.grow(random)
    found = max((problem.descend(start, random) for _ in range(3)), key=lambda values: problem.held(values).sum())
    assert problem.held(found).mean() > 0.95
    assert problem.held(found).sum() >= problem.held(start).sum()
    assert bool((found < counts).all())
    assert bool(problem.held(planted).all())
    nothing = Constraints(edges, np.zeros_like(compatible), counts)
    assert not nothing.held(nothing.descend(start, random)).any()


def test_random_grr_takes_no_seeds(planar_5):
    with pytest.raises(ParameterError, match='seeds: got auto; valid: none with method "random"'):
        grr_torch.build(planar_5, "position", points=50, method="random", seeds="auto")


@pytest.mark.parametrize("options", [{"samples": 0}, {"nearest": 0}, {"samples": 10**6}])
def test_random_grr_refuses_empty_pools(planar_5, options):
    graph = staggered_grid([(-0.4, 0.4)] * 2, 20)
    with pytest.raises(ParameterError):
        random_grr(planar_5, grr_torch.Position(2), graph, **options)
