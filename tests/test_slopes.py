"""Slopes of edges: which are steep, and what is left out of a map that has a bound."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

import grr_torch
from grr_torch.errors import FileFormatError, GrrWarning, ParameterError
from grr_torch.progress import silent
from grr_torch.projection.project import Tolerances
from grr_torch.resolution import quality, report
from grr_torch.resolution.checkpoint import Checkpoint
from grr_torch.resolution.options import bounded
from grr_torch.resolution.problem import pose_problem
from grr_torch.resolution.refine import refine
from grr_torch.resolution.repair import repair
from grr_torch.resolution.slopes import (
    edge_slopes,
    left_out_edges,
    slope_bound,
    steep_edges,
    with_raised_bound,
    without_steep_edges,
)
from grr_torch.resolution.verify import verify_file
from grr_torch.spaces.configuration import distance
from grr_torch.spaces.graph import staggered_grid

BOUNDS = {"planar_5": 12.0, "kinova": 5.0}


@pytest.fixture(scope="module", params=["planar_5", "kinova"])
def pair(request) -> tuple[grr_torch.Roadmap, grr_torch.Roadmap]:
    """The same problem without a bound and with one."""
    robot = grr_torch.load_robot(request.param)
    options = {"points": 400, "refine": False}
    return tuple(
        grr_torch.build(robot, "position", **options, max_slope=bound) for bound in (None, BOUNDS[request.param])
    )


def test_only_edges_above_the_bound_are_left_out(pair):
    free, limited = pair
    bound = BOUNDS[free.robot.name]
    assert torch.equal(free.configurations[free.resolved], limited.configurations[free.resolved])
    slopes = edge_slopes(free)
    above = torch.zeros_like(free.connected)
    above[free.connected.nonzero()[:, 0][slopes > bound]] = True
    assert bool(above.any())
    assert torch.equal(limited.connected, free.connected & ~above)
    assert limited.quality().smoothness_max <= bound < free.quality().smoothness_max
    left_out = left_out_edges(limited)
    assert set(above.nonzero()[:, 0].tolist()) <= set(left_out.tolist())
    assert bool((edge_slopes(limited, left_out).diff() <= 0.0).all())
    assert len(left_out_edges(free)) == 0


def test_slopes_are_those_of_their_edges(pair):
    free, _ = pair
    between = free.resolved[free.edges].all(1)
    a, b = free.edges[between].T
    moved = distance(free.configurations[a], free.configurations[b], free.robot.continuous)
    assert torch.allclose(edge_slopes(free, between), moved / (free.points[a] - free.points[b]).norm(dim=1))
    steep = steep_edges(free, 3.0)
    assert bool((edge_slopes(free, steep) > 3.0).all())


def test_a_file_with_a_bound_is_verified_by_it(pair, tmp_path):
    _, limited = pair
    limited.save(tmp_path / "m.grr")
    assert all(check.passed for check in verify_file(tmp_path / "m.grr"))
    connected = limited.connected.clone()
    connected[left_out_edges(limited)[0]] = True
    replace(limited, connected=connected).save(tmp_path / "spoilt.grr")
    failed = {check.name for check in verify_file(tmp_path / "spoilt.grr") if not check.passed}
    assert failed == {"edges"}


@pytest.mark.parametrize("objectives", [None, {"manipulability": 1.0}])
def test_refining_keeps_the_bound_and_loses_no_edge_to_it(pair, objectives):
    free, limited = pair
    bound = BOUNDS[free.robot.name]
    refined = refine(limited, objectives=objectives)
    assert refined.quality().smoothness_max <= refined.parameters["max_slope"] == bound
    assert bool(refined.connected[limited.connected].all())
    assert bool((edge_slopes(refined, left_out_edges(refined)) > bound).all())


def test_a_build_refines_what_the_bound_leaves(pair):
    _, limited = pair
    robot, bound = limited.robot, BOUNDS[limited.robot.name]
    built, refined = grr_torch.build(robot, "position", points=400, max_slope=bound), refine(limited)
    assert torch.equal(built.configurations[built.resolved], refined.configurations[refined.resolved])
    assert torch.equal(built.connected, refined.connected)


@pytest.mark.parametrize("bound", [0.0, -1.0, math.nan, -math.inf])
def test_a_bound_is_a_positive_number(planar_5, bound):
    with pytest.raises(ParameterError, match="max_slope"):
        grr_torch.build(planar_5, "position", points=50, max_slope=bound)


def test_the_preset_bounds_its_own_grid_alone(kinova):
    bounds = {
        "of the preset": grr_torch.build(kinova, "position", refine=False),
        "other points": grr_torch.build(kinova, "position", points=400, refine=False),
        "other task": grr_torch.build(kinova, "yaw", points=200, refine=False),
        "given": grr_torch.build(kinova, "position", refine=False, max_slope=10.0),
        "none": grr_torch.build(kinova, "position", refine=False, max_slope=math.inf),
    }
    found = {name: roadmap.parameters["max_slope"] for name, roadmap in bounds.items()}
    preset = kinova.preset.problems["position"]
    own = {"of the preset": preset.max_slope}
    assert found == {**own, "other points": None, "other task": None, "given": 10.0, "none": None}
    shares = [roadmap.parameters["connectivity"] for roadmap in bounds.values()]
    assert shares == [preset.connectivity, None, None, None, None]
    whole, left = bounds["none"], bounds["of the preset"]
    assert torch.equal(left.connected, whole.connected.index_fill(0, steep_edges(whole, preset.max_slope), False))


@pytest.mark.parametrize("task", ["position", "fixed-rotation"])
def test_of_the_preset_s_grids_nearly_all_edges_are_left_and_lie_within_the_bound(kinova, task):
    roadmap, problem = grr_torch.build(kinova, task), kinova.preset.problems[task]
    connected = int(roadmap.connected.sum()) / int(roadmap.resolved[roadmap.edges].all(1).sum())
    assert connected >= (problem.connectivity or 0.995)
    assert roadmap.quality().smoothness_max <= slope_bound(roadmap)
    assert slope_bound(roadmap) >= roadmap.parameters["max_slope"] == problem.max_slope


@pytest.mark.parametrize("connectivity", [0.5, 0.9, 0.97, 1.0])
def test_the_bound_is_raised_as_far_as_so_many_edges_take_it_and_no_further(pair, tmp_path, connectivity):
    free, limited = pair
    asked = replace(limited, parameters={**limited.parameters, "connectivity": connectivity})
    raised = with_raised_bound(asked)
    between = int(limited.resolved[limited.edges].all(1).sum())
    wanted = min(int(free.connected.sum()), math.ceil(connectivity * between))
    bound, slopes = slope_bound(raised), edge_slopes(raised)
    assert len(slopes) >= wanted
    assert (raised is asked) == (wanted <= int(limited.connected.sum()))
    assert raised is asked or int((slopes < bound - 1e-3).sum()) < wanted
    assert bool(raised.connected[limited.connected].all())
    assert torch.equal(raised.connected, without_steep_edges(replace(free, parameters=raised.parameters)).connected)
    assert bool((edge_slopes(raised, left_out_edges(raised)) > bound).all())
    raised.save(tmp_path / "m.grr")
    assert all(check.passed for check in verify_file(tmp_path / "m.grr"))


def test_a_map_without_a_bound_or_a_share_has_none_to_raise(pair):
    free, limited = pair
    asked = replace(free, parameters={**free.parameters, "connectivity": 1.0})
    assert with_raised_bound(asked) is asked
    assert with_raised_bound(limited) is limited


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_refining_raises_the_bound_and_so_does_a_build(tmp_path, dtype):
    robot = grr_torch.load_robot("kinova", dtype=dtype)
    plain, built = (grr_torch.build(robot, "position", refine=refined) for refined in (False, True))
    assert slope_bound(plain) == plain.parameters["max_slope"] < slope_bound(built)
    refined = refine(plain)
    assert refined.parameters == {**built.parameters, "refinement": refined.parameters["refinement"]}
    assert torch.equal(refined.connected, built.connected)
    again = refine(built)
    assert bool(again.connected[built.connected].all())
    assert slope_bound(again) >= slope_bound(built)
    built.save(tmp_path / "m.grr")
    assert all(check.passed for check in verify_file(tmp_path / "m.grr"))


def test_a_bound_that_is_given_is_another_build_than_the_preset_s(kinova, tmp_path):
    grr_torch.build(kinova, "position", refine=False, checkpoint=tmp_path / "kept")
    bound = kinova.preset.problems["position"].max_slope
    with pytest.raises(FileFormatError):
        grr_torch.build(kinova, "position", refine=False, checkpoint=tmp_path / "kept", resume=True, max_slope=bound)


def test_the_bound_of_the_preset_is_for_expansions_that_are_not_told_otherwise(kinova):
    problem = pose_problem(kinova, "position")
    assert None not in (problem.max_slope, problem.connectivity)
    assert bounded(problem, None, "expansion") == problem
    for given, method in ((None, "random"), (math.inf, "expansion")):
        assert bounded(problem, given, method)[3:] == (None, None)
    # what is asked for holds as it is
    assert bounded(problem, 9.0, "expansion")[3:] == (9.0, None)


def test_the_preset_bounds_its_grid_however_it_is_given(kinova):
    problem = pose_problem(kinova, "position")
    bound = kinova.preset.problems["position"].max_slope
    assert bound is not None
    assert pose_problem(kinova, "position", problem.graph).max_slope == bound
    assert pose_problem(kinova, "position", kinova.preset.problems["position"].points).max_slope == bound
    assert pose_problem(kinova, "position", staggered_grid([(0.2, 0.6)] * 3, 50)).max_slope is None


@pytest.mark.parametrize(("given", "has_one"), [([], True), (["--max-slope", "inf"], False)])
def test_the_command_takes_the_bound_of_the_preset(kinova, run_cli, given, has_one):
    words = ["build", "--robot", "kinova", "--task", "position", "--no-refine", "--out", "m.grr", "--no-record"]
    code, _, _ = run_cli(*words, *given)
    assert code == 0
    expected = kinova.preset.problems["position"].max_slope if has_one else None
    assert grr_torch.Roadmap.load("m.grr").parameters["max_slope"] == expected


def test_a_last_repair_moves_nothing_for_edges_that_are_left_out(pair):
    _, limited = pair
    repaired = without_steep_edges(repair(limited, Tolerances(), 0, at_last=True))
    assert bool(repaired.connected[limited.connected].all())
    moved = (repaired.configurations != limited.configurations)[limited.resolved].any()
    assert int(repaired.connected.sum()) > int(limited.connected.sum()) or not bool(moved)


def test_the_commands_take_a_bound_and_list_what_is_left_out(run_cli):
    command = run_cli
    code, _, _ = command(
        *("build", "--robot", "planar_5", "--task", "position", "--points", 400, "--no-refine"),
        *("--max-slope", BOUNDS["planar_5"], "--out", "m.grr", "--no-record"),
    )
    assert code == 0
    code, out, _ = command("info", "m.grr", "--verify")
    assert code == 0
    count = len(left_out_edges(grr_torch.Roadmap.load("m.grr")))
    assert f"{count} edges left out, steeper than 12 rad/m" in out
    code, _, error = command("build", "--robot", "planar_5", "--max-slope", 0)
    assert code == 2
    assert "max_slope: got 0" in error


def test_a_bound_that_leaves_most_edges_out_is_warned_of(planar_5):
    with pytest.warns(GrrWarning, match=r"of .* edges are steeper than max_slope \(0.01 rad/m\) and left out"):
        roadmap = grr_torch.build(planar_5, "position", points=100, refine=False, max_slope=0.01)
    assert not roadmap.connected.any()
    assert roadmap.resolved.any()


def test_more_edges_than_torch_sorts_have_figures(planar_roadmap, monkeypatch):
    slopes = torch.linspace(0.0, 100.0, (1 << 24) + 1, dtype=torch.float64)
    for module in (quality, report):
        monkeypatch.setattr(module, "edge_slopes", lambda roadmap: slopes)
    figures = quality.measure_quality(planar_roadmap)
    assert (figures.smoothness_p99, figures.smoothness_max) == (pytest.approx(99.0), 100.0)
    told = report.before_refinement(planar_roadmap, silent, Checkpoint())
    assert told["smoothness_p99"] == pytest.approx(99.0)
