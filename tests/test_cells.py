"""Cells: triangles and faces of the grid, their winding and spread, and what cannot be removed."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import grr_torch
from grr_torch.resolution.slopes import edge_slopes, steep_edges
from grr_torch.spaces.cliques import draw, triangles
from grr_torch.spaces.graph import TaskGraph, find_lattice, staggered_grid


@given(st.integers(1, 14), st.integers(0, 10_000), st.floats(0.1, 0.9))
def test_triangles_are_all_there_are(vertices, seed, density):
    generator = torch.Generator().manual_seed(seed)
    pairs = torch.combinations(torch.arange(vertices)).reshape(-1, 2)
    edges = pairs[torch.rand(len(pairs), generator=generator) < density]
    edges = edges[torch.randperm(len(edges), generator=generator)]
    there = set(map(tuple, edges.tolist()))
    expected = {
        corners
        for corners in itertools.combinations(range(vertices), 3)
        if all(pair in there for pair in itertools.combinations(corners, 2))
    }
    found = [tuple(corners) for corners in triangles(edges, vertices).tolist()]
    assert len(found) == len(set(found))
    assert set(found) == expected


def test_a_grid_has_twelve_triangles_and_shares_six_faces_a_cell():
    graph = staggered_grid([(0.0, 1.0)] * 3, 300)
    cells = math.prod(graph.lattice.cells)
    assert len(triangles(graph.edges, len(graph.points))) == 12 * cells
    faces = graph.lattice.faces()
    c = graph.lattice.cells[0]
    assert graph.lattice.cells == (c, c, c)
    assert len(faces) == 3 * c * c * (c + 1)
    sides = graph.points[faces] - graph.points[faces.roll(-1, dims=1)]
    torch.testing.assert_close(sides.norm(dim=-1), torch.full((len(faces), 4), 1.0 / c, dtype=torch.float64))
    assert len(staggered_grid([(0.0, 1.0)] * 2, 300).lattice.faces()) == 0


def test_a_lattice_is_found_again_and_only_in_a_grid():
    graph = staggered_grid([(-1.0, 1.0), (0.0, 0.7), (0.2, 0.9)], 200)
    assert find_lattice(graph.points).cells == graph.lattice.cells
    assert find_lattice(graph.points.flip(0)) is None
    assert find_lattice(torch.rand(200, 3, dtype=torch.float64)) is None
    assert find_lattice(graph.points[:1]) is None


def disc(robot, turn):
    """A ring of triangles round the origin whose configurations turn joint 1 with the point, or do not."""
    angles = torch.arange(6, dtype=torch.float64) * math.pi / 3.0
    bend = torch.tensor([0.0, 0.5, 0.5, 0.5, 0.5], dtype=torch.float64)
    q = bend.repeat(6, 1)
    q[:, 0] += angles if turn else 0.0
    q = torch.cat([q, bend[None]])
    points = robot.forward_kinematics(q)[0][:, :2]
    rim = torch.stack([torch.arange(6), (torch.arange(6) + 1) % 6], dim=1).sort(dim=1).values
    spokes = torch.stack([torch.arange(6), torch.full((6,), 6)], dim=1)
    return q, points, torch.cat([rim, spokes])


def test_windings_add_up_to_that_of_the_boundary(planar_5):
    q, _, edges = disc(planar_5, turn=True)
    angles = torch.arange(6, dtype=torch.float64) * math.pi / 3.0
    points = torch.cat([torch.stack([angles.cos(), angles.sin()], dim=1), torch.zeros(1, 2, dtype=torch.float64)])
    built = grr_torch.build(planar_5, "position", points=60, refine=False)
    roadmap = replace(
        built,
        points=0.3 * points,
        configurations=q,
        resolved=torch.ones(7, dtype=torch.bool),
        edges=edges,
        connected=torch.ones(len(edges), dtype=torch.bool),
        wave=torch.zeros(7, dtype=torch.int32),
    )
    cells = roadmap.cells()[0]
    assert len(cells.corners) == 6
    # taken the same way round, the triangles' windings add up to one turn of joint 1 and none of the others
    a, b, c = roadmap.points[cells.corners].unbind(1)
    side = torch.linalg.det(torch.stack([b - a, c - a], dim=1)).sign().long()
    assert (side[:, None] * cells.winding).sum(0).abs().tolist() == [1, 0, 0, 0, 0]
    assert int(cells.wound.sum()) == 1
    assert not bool((cells.certified & cells.wound).any())


def test_the_planar_map_has_the_one_winding_that_it_must_have():
    quality = grr_torch.build(grr_torch.load_robot("planar_5"), "position").quality()
    assert quality.triangles_wound == 1


def test_a_cell_with_an_unrelated_corner_is_spread(planar_5, generator):
    roadmap = grr_torch.build(planar_5, "position", points=400, refine=False)
    cells = roadmap.cells()[0]
    inside = (cells.certified & (roadmap.points[cells.corners].norm(dim=-1).amax(1) < 0.3)).nonzero()[0, 0]
    vertex = cells.corners[inside, 0]
    start = planar_5.sample(200, generator)
    point = roadmap.points[vertex].expand(200, 2)
    found, valid = grr_torch.project(planar_5, roadmap.task, point, start)
    far = (found - roadmap.configurations[vertex]).abs().amax(1).nan_to_num()
    other = found[int(torch.where(valid, far, 0.0).argmax())]
    configurations = roadmap.configurations.clone()
    configurations[vertex] = other
    changed = replace(roadmap, configurations=configurations)
    after = changed.cells()[0]
    around = (after.corners == vertex).any(1)
    assert not bool(after.certified[around].all())
    assert torch.equal(after.spread[~around], cells.spread[~around])
    # and its edges are steeper than they were
    assert float(edge_slopes(changed).max()) > 2.0 * float(edge_slopes(roadmap).median())


def test_steep_edges_are_those_above_the_limit_steepest_first(planar_roadmap):
    slopes = edge_slopes(planar_roadmap)
    limit = float(slopes.quantile(0.9))
    steep = steep_edges(planar_roadmap, limit)
    by_edge = torch.zeros(len(planar_roadmap.edges), dtype=torch.float64)
    by_edge[planar_roadmap.connected] = slopes
    assert len(steep) == int((slopes > limit).sum())
    assert bool((by_edge[steep].diff() <= 0.0).all())
    assert len(steep_edges(planar_roadmap)) == int((slopes > 10.0 * slopes.median()).sum())


def test_cells_of_nothing(planar_5):
    graph = TaskGraph(torch.tensor([[0.2, 0.1]], dtype=torch.float64), torch.empty(0, 2, dtype=torch.long))
    quality = grr_torch.build(planar_5, "position", points=graph).quality()
    assert (quality.triangles, quality.triangles_certified, quality.steep_edges) == (0, None, 0)


@pytest.fixture(scope="module")
def planar_roadmap():
    return grr_torch.build(grr_torch.load_robot("planar_5"), "position", points=300)


@pytest.mark.parametrize(("count", "most"), [(10, 20), (30, 20), (300, 20)])
def test_as_many_cells_are_drawn_as_were_asked_for_none_twice(count, most):
    drawn = draw(count, most)
    assert len(drawn) == len(drawn.unique()) == min(count, most)
    assert bool((drawn.diff() > 0).all())
    assert 0 <= int(drawn[0]) <= int(drawn[-1]) < count
