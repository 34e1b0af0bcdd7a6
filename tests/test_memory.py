"""Memory is asked for before it is used."""

from __future__ import annotations

import pytest

import grr_torch
from grr_torch.errors import ParameterError
from grr_torch.experiments.timing import in_fresh_process
from grr_torch.resolution import memory
from grr_torch.resolution.memory import _group_memory, available_memory, estimate_memory
from grr_torch.resolution.problem import pose_problem


def test_what_is_free_is_less_than_the_machine_has():
    free = available_memory()
    assert free is None or 2**26 < free < 2**50


def test_a_build_that_will_not_fit_is_refused_before_it_starts(kinova, monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 300 << 20)
    monkeypatch.setattr("grr_torch.resolution.methods.expand", None)
    with pytest.raises(ParameterError, match=r"points: got .* vertices, which would take about .* GiB") as caught:
        grr_torch.build(kinova, "position", points=300_000)
    assert "0.3 GiB that are free" in caught.value.valid
    fitting = int(caught.value.valid.split()[1].replace(",", ""))
    assert 10_000 < fitting < 300_000
    problem = pose_problem(kinova, "position", fitting)
    assert estimate_memory(kinova, problem, True, 1.0) < 2 * (300 << 20)


def test_what_fits_unrefined_is_said(kinova, monkeypatch):
    problem = pose_problem(kinova, "position", 100_000)
    share = memory._resolvable(kinova, problem)
    between = [estimate_memory(kinova, problem, refine, share) for refine in (False, True)]
    assert between[0] < between[1]
    monkeypatch.setattr(memory, "available_memory", lambda: sum(between) // 2)
    with pytest.raises(ParameterError, match="or no refinement"):
        grr_torch.build(kinova, "position", points=problem.graph)


def test_larger_pieces_count_too(kinova):
    problem = pose_problem(kinova, "position", 300_000)
    pieces = min(memory._EDGE_ON_GPU * len(problem.graph.edges), memory._PIECES_ON_GPU)
    wanted = estimate_memory(kinova, problem, True, 1.0)
    memory._require(kinova, problem, True, wanted)
    memory._require(kinova, problem, True, wanted + pieces, pieces, " on the GPU")
    for free in (1 << 30, 7 << 28):
        with pytest.raises(ParameterError, match="GiB on the GPU; valid: about") as caught:
            memory._require(kinova, problem, True, free, pieces, " on the GPU")
        fitting = int(caught.value.valid.split()[1].replace(",", ""))
        smaller = pose_problem(kinova, "position", fitting)
        taken = estimate_memory(kinova, smaller, True, 1.0) + memory._EDGE_ON_GPU * len(smaller.graph.edges)
        assert 0.5 * free < taken < 1.3 * free


def test_processes_need_memory_as_far_as_they_have_something_to_do(kinova, planar_5, monkeypatch):
    small, large = pose_problem(planar_5, "position", 300), pose_problem(kinova, "position", 100_000)
    taken = {}
    for count in (1, 2, 64):
        monkeypatch.setattr(memory, "cores", lambda count=count: count)
        taken[count] = estimate_memory(planar_5, small, True, 1.0), estimate_memory(kinova, large, True, 1.0)
    assert taken[1][0] == taken[2][0] == taken[64][0]
    assert taken[1][1] < taken[2][1] < taken[64][1] < taken[1][1] + 64 * memory._LEAST


def test_where_nothing_is_known_nothing_is_refused(planar_5, monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: None)
    assert len(grr_torch.build(planar_5, "position", points=50, refine=False).points) >= 50


def test_the_share_that_can_be_resolved_is_about_right(kinova):
    problem = pose_problem(kinova, "fixed-rotation")
    roadmap = grr_torch.build(kinova, "fixed-rotation", refine=False)
    near = memory.within_reach(kinova, problem.task, problem.graph.points)
    share = int(roadmap.resolved.sum()) / int(near.sum())
    assert share <= memory._resolvable(kinova, problem) <= share + 0.2


def peak_of_a_build(points):
    from grr_torch.resolution.memory import peak_memory

    robot = grr_torch.load_robot("kinova")
    grr_torch.build(robot, "position", points=1_000)
    before = peak_memory()
    problem = pose_problem(robot, "position", points)
    roadmap = grr_torch.build(robot, problem.task, points=problem.graph, seeds=problem.seeds)
    share = int(roadmap.resolved.sum()) / int(memory.within_reach(robot, problem.task, problem.graph.points).sum())
    return peak_memory() - before, estimate_memory(robot, problem, True, share) / 2**20


def test_an_estimate_is_above_the_peak_and_not_far_above():
    (peak, estimate), _ = in_fresh_process(peak_of_a_build, 6_000)
    assert peak <= estimate <= 64.0 + 4.0 * peak + 20.0


def group(tmp_path, line, files):
    (tmp_path / "cgroup").write_text(line)
    for name, text in files.items():
        path = tmp_path / "fs" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return _group_memory(tmp_path / "fs", tmp_path / "cgroup")


def test_the_limits_of_all_groups_above_count(tmp_path):
    files = {
        "a/b/memory.max": "max\n",
        "a/b/memory.current": "5",
        "a/memory.max": "1000\n",
        "a/memory.current": "400",
        "a/memory.stat": "anon 300\ninactive_file 50\n",
    }
    assert group(tmp_path, "0::/a/b\n", files) == [650]


def test_groups_of_the_first_version_count(tmp_path):
    files = {"memory/memory.limit_in_bytes": "2000", "memory/memory.usage_in_bytes": "500"}
    assert group(tmp_path, "3:cpu:/\n4:memory:/gone/from/here\n0::/\n", files) == [1500]


def test_without_groups_there_is_no_limit(tmp_path):
    assert _group_memory(tmp_path / "none", tmp_path / "nothing") == []
