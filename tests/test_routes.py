"""Shortest paths: how much of them is remembered, and for how long."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from grr_torch.applications.routes import Routes


@pytest.mark.parametrize("vertices", [10, 100_000, 3_000_000])
def test_what_is_remembered_of_shortest_paths_is_bounded(vertices):
    edges = torch.tensor([[0, 1], [1, 2]])
    roadmap = SimpleNamespace(
        edges=edges,
        connected=torch.ones(2, dtype=torch.bool),
        configurations=torch.rand(3, 2, dtype=torch.float64),
        robot=SimpleNamespace(continuous=torch.zeros(2, dtype=torch.bool)),
        points=range(vertices),
    )
    routes = Routes(roadmap)
    lengths, following = routes.towards(0)
    assert list(following[:3]) == [-9999, 0, 1]
    kept = routes.towards.cache_info().maxsize
    assert 1 <= kept <= 256
    assert kept * (lengths.nbytes + following.nbytes) <= 1 << 29
    assert kept == 256 or (kept + 1) * (lengths.nbytes + following.nbytes) > 1 << 29


def test_paths_over_one_roadmap_share_what_is_remembered(planar_roadmap):
    roadmap = replace(planar_roadmap)
    start, goal = (torch.tensor(point, dtype=torch.float64) for point in ([0.3, -0.2], [-0.2, 0.3]))
    first = roadmap.plan(start, goal)
    asked = roadmap.routes.towards.cache_info()
    assert asked.misses > 0
    again = roadmap.plan(start, goal)
    assert torch.equal(first.configurations, again.configurations)
    assert roadmap.routes.towards.cache_info().misses == asked.misses
    # no edge that is closed in another roadmap is taken in this one
    assert replace(roadmap).routes is not roadmap.routes


def test_what_is_remembered_is_gone_with_its_roadmap(planar_roadmap):
    roadmap = replace(planar_roadmap)
    routes = weakref.ref(roadmap.routes)
    assert routes() is roadmap.routes
    del roadmap
    gc.collect()
    assert routes() is None
