"""What the averages are that a roadmap's solutions start from."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

import grr_torch
from grr_torch.applications.many_guesses import ManyGuesses
from grr_torch.applications.solve import STATUSES


@pytest.fixture(scope="module", params=["planar", "kinova"])
def roadmap(request, planar_roadmap, kinova_roadmap) -> grr_torch.Roadmap:
    return planar_roadmap if request.param == "planar" else kinova_roadmap


@pytest.mark.parametrize("connected", ["as built", "a third", "none"])
def test_guesses_by_matrices_are_those_by_trees(roadmap, connected):
    """What a GPU computes, here on the CPU: vertices, parts and averages are the same."""
    generator = torch.Generator().manual_seed(4)
    share = {"as built": 1.0, "a third": 0.33, "none": 0.0}[connected]
    kept = torch.rand(len(roadmap.edges), generator=generator) < share
    thinned = dataclasses.replace(roadmap, connected=roadmap.connected & kept)
    low, high = roadmap.points.amin(0) - 0.1, roadmap.points.amax(0) + 0.1
    points = low + (high - low) * torch.rand(3000, len(low), dtype=torch.float64, generator=generator)
    points = torch.cat([points, torch.full_like(points[:1], 1e300)])
    solver = thinned.solver
    expected, codes = solver.guess(points, certified=False)
    by_matrices = ManyGuesses(thinned, solver.vertices, solver.radius)
    found, nearest, known = by_matrices(points)
    inside = codes.numpy() != STATUSES.index("outside")
    assert 0 < known.sum() < len(points)
    assert (known[inside] == (codes.numpy() <= 1)[inside]).all()
    torch.testing.assert_close(found[known], expected[known], atol=1e-12, rtol=0)
    assert (solver.vertices[nearest][known] == solver.nearest(points[known])[1][:, 0]).all()


def test_guesses_by_matrices_do_not_depend_on_where_the_map_is(planar_roadmap):
    """Distances are first compared in single precision."""
    shift = 1_000_000.0
    moved = dataclasses.replace(planar_roadmap, points=planar_roadmap.points + shift)
    generator = torch.Generator().manual_seed(5)
    points = torch.rand(2000, 2, dtype=torch.float64, generator=generator) - 0.5
    vertices = planar_roadmap.solver.vertices
    here, there = (
        ManyGuesses(roadmap, vertices, planar_roadmap.longest_edge)(points + at)
        for roadmap, at in ((planar_roadmap, 0.0), (moved, shift))
    )
    both = here[2] & there[2]
    assert (here[2] == there[2]).mean() > 0.99
    torch.testing.assert_close(here[0][both], there[0][both], atol=1e-5, rtol=0)


def test_a_map_without_edges_has_guesses_too(planar_5):
    graph = grr_torch.TaskGraph(torch.tensor([[0.3, 0.1]], dtype=torch.float64), torch.empty(0, 2, dtype=torch.long))
    roadmap = grr_torch.build(planar_5, "position", points=graph, seeds=[[0.1, 0.2, 0.2, 0.2, 0.2]])
    assert roadmap.longest_edge == math.inf
    points = torch.tensor([[0.3, 0.1], [0.31, 0.12]], dtype=torch.float64)
    assert bool(roadmap.solve(points).valid.any())
    averages, nearest, known = ManyGuesses(roadmap, roadmap.solver.vertices, roadmap.longest_edge)(points)
    torch.testing.assert_close(averages, roadmap.configurations.expand(2, -1))
    assert known.all()
    assert (nearest == 0).all()
