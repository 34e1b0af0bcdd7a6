"""Which candidates a repair takes, by what their edges would cost, and how it goes on."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

import grr_torch
from grr_torch.projection.project import Tolerances
from grr_torch.resolution import auto_seeds, checkpoint
from grr_torch.resolution.repair import _choose, _Trial
from grr_torch.resolution.repair_candidates import Candidates, Draft, Setting, _gentlest
from grr_torch.resolution.slopes import edge_slopes


@pytest.fixture(scope="module")
def whole(planar_5) -> grr_torch.Roadmap:
    roadmap = grr_torch.build(planar_5, grr_torch.Position(2), points=60, bounds=[(-0.3, 0.3)] * 2, seeds="auto")
    assert bool(roadmap.connected.all())
    return roadmap


def with_broken_edge(roadmap: grr_torch.Roadmap, vertex: int, bound: float | None) -> grr_torch.Roadmap:
    """One edge of a vertex is not connected, though it could be."""
    edges = (roadmap.edges == vertex).any(1).nonzero()[:, 0]
    connected = roadmap.connected.index_fill(0, edges[:1], False)
    return replace(roadmap, connected=connected, parameters={**roadmap.parameters, "max_slope": bound})


def trial_of(roadmap: grr_torch.Roadmap, vertices: torch.Tensor, steepness: list[float]) -> _Trial:
    """All edges of candidates join, and each is so many times as steep as the vertex's own."""
    rank, ends = roadmap.graph.around(vertices)
    edges = roadmap.graph.edge_between(vertices[rank], ends)
    slopes = edge_slopes(roadmap, edges) * torch.tensor(steepness, dtype=torch.float64)[rank]
    return _Trial(rank, edges, slopes, torch.ones_like(rank, dtype=torch.bool))


def chosen(
    roadmap: grr_torch.Roadmap, vertices: list[int], steepness: list[float], lost: int | None = None
) -> list[int]:
    candidates = Candidates(torch.tensor(vertices), roadmap.configurations[vertices])
    trial = trial_of(roadmap, candidates.vertices, steepness)
    if lost is not None:
        keeps = roadmap.connected[trial.edges] & (trial.rank == lost)
        trial.joined[keeps.nonzero()[0]] = False
    draft = Draft(roadmap.configurations, roadmap.connected, roadmap.wave)
    return _choose(draft, candidates, trial, Setting.of(roadmap, Tolerances(), 0, at_last=False)).tolist()


def test_an_edge_is_worth_as_much_as_the_bound_that_it_is_left_out_by(whole):
    vertex = 30
    slopes = edge_slopes(whole, (whole.edges == vertex).any(1))
    bound = 2.0 * float(slopes.max())
    # to connect it costs this much more by the others, in all
    for extra, taken in ((0.5, True), (1.5, False)):
        steepness = 1.0 + (extra * bound - float(slopes[0])) / float(slopes.sum())
        assert chosen(with_broken_edge(whole, vertex, bound), [vertex], [steepness]) == ([0] if taken else [])
        # without a bound any price is paid
        assert chosen(with_broken_edge(whole, vertex, None), [vertex], [steepness]) == [0]


@pytest.mark.parametrize("bound", [None, 1000.0])
def test_the_cheapest_is_taken_of_equal_ones_the_first_and_none_that_loses_or_gains_no_edge(whole, bound):
    broken = with_broken_edge(whole, 30, bound)
    assert chosen(broken, [30, 30, 30], [1.2, 1.1, 1.3]) == [1]
    assert chosen(broken, [30, 30, 30], [1.2, 1.1, 1.1]) == [1]
    assert chosen(broken, [30, 30], [1.2, 0.1], lost=1) == [0]
    assert chosen(replace(broken, connected=whole.connected), [30], [0.1]) == []


def test_of_each_vertex_the_candidates_with_the_least_steep_edges_are_checked(whole, generator):
    vertices = torch.tensor([20] * 5 + [30] * 2 + [40] * 6)
    away = torch.rand(len(vertices), 1, dtype=torch.float64, generator=generator)
    candidates = Candidates(vertices, whole.configurations[vertices] + away)
    setting = Setting.of(whole, Tolerances(), 0, at_last=False)
    kept = _gentlest(Draft(whole.configurations, whole.connected, whole.wave), candidates, setting)
    assert kept.vertices.tolist() == [20] * 3 + [30] * 2 + [40] * 3
    for vertex in (20, 30, 40):
        nearest = away[vertices == vertex].sort(dim=0).values[:3]
        found = kept.configurations[kept.vertices == vertex] - whole.configurations[vertex]
        torch.testing.assert_close(found[:, :1].sort(dim=0).values, nearest)


@pytest.mark.parametrize("max_slope", [14.8, None])
def test_found_seeds_are_relaxed_within_the_bound_that_a_build_has(kinova, monkeypatch, max_slope):
    relaxed, bounds = auto_seeds._relaxed, []

    def noted(*given):
        bounds.append(given[6] if len(given) > 6 else None)
        return relaxed(*given)

    monkeypatch.setattr(auto_seeds, "_relaxed", noted)
    monkeypatch.setattr(auto_seeds, "at_once", lambda function, parts, _: map(function, parts))
    options = {"points": 300, "seeds": "auto", "candidates": 40, "refine": False, "tolerances": Tolerances()}
    grr_torch.build(kinova, "position", max_slope=max_slope, **options)
    # on the coarse graph, of each finalist, and of the best of them
    finalists = math.ceil(40 * auto_seeds._FINALISTS)
    assert bounds == [None, *[max_slope] * finalists, max_slope]


@pytest.mark.parametrize("turn", [1, 2, 3])
def test_interrupted_between_rounds_it_ends_with_the_same_tensors(planar_5, tmp_path, monkeypatch, turn):
    monkeypatch.setattr(checkpoint, "_INTERVAL", 0.0)
    monkeypatch.setattr(checkpoint, "_PATIENCE", 0.0)
    options = {"task": "pose", "points": 90, "rotations": 3, "seed": 1}
    undisturbed = grr_torch.build(planar_5, **options)
    rounds = []

    def stop(stage, done, total):
        rounds.extend([done] * (stage == "repairing" and 0 < done < total))
        if len(rounds) == turn:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        grr_torch.build(planar_5, **options, checkpoint=tmp_path, progress=stop)
    resumed = grr_torch.build(planar_5, **options, checkpoint=tmp_path, resume=True)
    for name in ("configurations", "connected", "wave"):
        assert torch.equal(getattr(resumed, name).nan_to_num(9.9), getattr(undisturbed, name).nan_to_num(9.9))
