"""The lower bound of slopes: below every choice, met on trees, and below every map that there is."""

from __future__ import annotations

import itertools
import json
import weakref

import pytest
import torch

import grr_torch
from grr_torch.errors import ParameterError
from grr_torch.experiments import bound
from grr_torch.experiments.bound import bound_without, mean_without, measure_bound
from grr_torch.experiments.labelling import Graph, Search
from grr_torch.resolution.refine import refine

TREE = [(0, 1), (1, 3), (1, 2), (2, 4)]
LOOPS = [(0, 1), (1, 2), (0, 2), (2, 3), (3, 4), (2, 4), (0, 4)]


def graph(edges: list[tuple[int, int]]) -> Graph:
    low, high = torch.tensor(edges).T
    count = int(high.max()) + 1
    levels = [0] * count
    for first, second in sorted(edges):
        levels[second] = max(levels[second], levels[first] + 1)
    most = torch.maximum(low.bincount(minlength=count), high.bincount(minlength=count))
    return Graph(low, high, torch.ones(len(edges)), torch.tensor(levels), 1.0 / most)


@pytest.mark.parametrize("edges", [TREE, LOOPS])
def test_no_choice_is_below_the_bound_and_the_one_found_is_real(edges, generator):
    net = graph(edges)
    gaps = []
    for _ in range(20):
        tables = torch.rand(len(edges), 3, 3, generator=generator)
        search, before = Search(net, tables), 0.0
        for _ in range(20):
            search.go_on()
            assert search.bound >= before
            before = search.bound
        choices = torch.tensor(list(itertools.product(range(3), repeat=5)))
        costs = tables[torch.arange(len(edges)), choices[:, net.low], choices[:, net.high]].sum(1)
        least = float(costs.min())
        assert search.bound <= least + 1e-5
        assert search.best == pytest.approx(
            float(tables[torch.arange(len(edges)), *search.chosen[edges_of(net)]].sum())
        )
        assert search.best >= least - 1e-5
        gaps.append(search.best - search.bound)
    if edges is TREE:
        assert max(gaps) < 1e-5, "on trees both meet"
    else:
        assert sum(gap < 1e-5 for gap in gaps) > 10


@pytest.mark.parametrize("left_out", [1, 2])
def test_no_choice_that_leaves_edges_out_is_below_the_bound(left_out, generator):
    net = graph(LOOPS)
    edges = torch.arange(len(LOOPS))
    choices = torch.tensor(list(itertools.product(range(3), repeat=5)))
    met = 0
    for _ in range(20):
        tables = torch.rand(len(LOOPS), 3, 3, generator=generator)
        truncated = float(tables[:, 0, 0].topk(left_out).values[-1])
        search = Search(net, tables.clamp(max=truncated))
        for _ in range(20):
            search.go_on()
        least = min(mean_without(tables[edges, one[net.low], one[net.high]], left_out) for one in choices)
        bound = bound_without(search.bound, len(LOOPS), left_out, truncated)
        assert bound <= least + 1e-5
        met += bound > least - 0.1
    assert met > 3, "a bound that is always far below tells nothing"


def test_edges_and_levels_are_those_of_the_roadmap(plain):
    vertices = plain.resolved.nonzero()[:, 0]
    net = Graph.of(plain, vertices, torch.device("cpu"))
    joined = plain.edges[plain.resolved[plain.edges].all(1)]
    assert {tuple(pair) for pair in vertices[edges_of(net).T].tolist()} == {tuple(pair) for pair in joined.tolist()}
    assert torch.allclose(net.lengths.double(), (plain.points[joined[:, 0]] - plain.points[joined[:, 1]]).norm(dim=1))
    assert bool((net.levels[net.low] < net.levels[net.high]).all())
    before, behind = (end.bincount(minlength=len(vertices)) for end in (net.high, net.low))
    assert torch.allclose(net.shares, 1.0 / torch.maximum(before, behind).clamp_min(1))


def edges_of(net: Graph) -> torch.Tensor:
    return torch.stack([net.low, net.high])


@pytest.fixture(scope="module")
def plain() -> grr_torch.Roadmap:
    return grr_torch.build(grr_torch.load_robot("planar_5"), "fixed-rotation", points=200, refine=False)


def test_refinement_comes_near_the_bound_and_not_below(plain):
    refined = refine(plain)
    before, after = (measure_bound(roadmap, samples=60, iterations=40)[0] for roadmap in (plain, refined))
    assert after.bound <= after.best * (1.0 + 1e-6)
    assert after.best <= after.smoothness < before.smoothness
    assert after.smoothness == pytest.approx(refined.quality().smoothness, rel=1e-6)
    assert after.smoothness == pytest.approx(refined.quality().smoothness, rel=1e-6)
    assert after.bound > 0.98 * after.smoothness
    assert 0.0 < after.spacing[0] < after.spacing[1]
    assert after.edges == int(refined.resolved[refined.edges].all(1).sum())


def test_the_more_edges_are_left_out_the_lower_is_the_bound(plain):
    results = measure_bound(plain, samples=30, iterations=20, left_out=(0, 3, 10))
    bounds = [result.bound for result in results]
    assert bounds == sorted(bounds, reverse=True)
    assert len(set(bounds)) == 3
    assert all(result.bound <= result.best * (1.0 + 1e-6) for result in results)
    assert all(result.best <= result.smoothness for result in results)


def test_one_search_s_tables_are_gone_before_the_next_are_made(plain, monkeypatch):
    made = []

    def tables(*arguments):
        assert all(table() is None for table in made), "two at once would not fit the memory that one was checked for"
        found = original(*arguments)
        made.append(weakref.ref(found))
        return found

    original = bound._tables
    monkeypatch.setattr(bound, "_tables", tables)
    measure_bound(plain, samples=10, iterations=2, left_out=(0, 3, 10))
    assert len(made) == 3


@pytest.mark.parametrize(
    "options", [{"samples": 1}, {"samples": 10**6}, {"iterations": 0}, {"left_out": [-1]}, {"left_out": [0, 10**6]}]
)
def test_numbers_out_of_their_range_are_errors(plain, options):
    with pytest.raises(ParameterError):
        measure_bound(plain, **options)


def test_manifolds_of_many_dimensions_are_refused(planar_roadmap):
    with pytest.raises(ParameterError, match="leaves 3 degrees of freedom"):
        measure_bound(planar_roadmap)


def test_the_command_prints_a_table_and_writes_json(plain, run_cli, tmp_path):
    plain.save(tmp_path / "map.grr")
    words = [
        "bench",
        "bound",
        "map.grr",
        "--samples",
        "20",
        "--iterations",
        "3",
        "--leave-out",
        "0",
        "--leave-out",
        "2",
    ]
    code, out, _ = run_cli(*words, "--json", "bound.json")
    assert code == 0
    assert out.count("planar_5 fixed-rotation") == 2
    written = json.loads((tmp_path / "bound.json").read_text())
    assert [one["left_out"] for one in written["bounds"]] == [0, 2]
    assert all(one["bound"] <= one["best"] * (1.0 + 1e-6) for one in written["bounds"])


@pytest.mark.parametrize("words", [["none.grr"], ["map.grr", "--samples", "1"], ["map.grr", "--json", "map.grr"]])
def test_bad_input_is_one_line(plain, run_cli, tmp_path, words):
    plain.save(tmp_path / "map.grr")
    code, _, err = run_cli("bench", "bound", *words)
    assert code == 2
    assert "Traceback" not in err
    assert (tmp_path / "map.grr").stat().st_size > 1000
