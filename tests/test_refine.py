"""Refinement keeps what there was and makes it smoother; seeds that are found; the random baseline."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from public_arms import IIWA_14, PANDA, PLANAR_10, arm_urdf

import grr_torch
from grr_torch.errors import ParameterError, SeedError
from grr_torch.projection.columns import null_space_projector
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.auto_seeds import _costs, _relaxed, find_seeds
from grr_torch.resolution.constraints import Constraints
from grr_torch.resolution.edges import check_edges
from grr_torch.resolution.expand import expand
from grr_torch.resolution.random_grr import random_grr
from grr_torch.resolution.refine import refine
from grr_torch.resolution.report import summary
from grr_torch.resolution.seeds import in_the_middle
from grr_torch.spaces.graph import Copies, staggered_grid

PROBLEMS = [("planar_5", "position", 400), ("planar_5", "fixed-rotation", 400), ("kinova", "fixed-rotation", 1500)]


@pytest.mark.parametrize(("name", "task", "points"), PROBLEMS)
def test_nothing_is_lost_and_the_map_is_smoother(name, task, points):
    plain = grr_torch.build(grr_torch.load_robot(name), task, points=points, refine=False)
    refined = refine(plain)
    assert bool((refined.resolved | ~plain.resolved).all())
    assert bool((refined.connected | ~plain.connected).all())
    before, after = plain.quality(), refined.quality()
    assert after.smoothness < before.smoothness
    assert after.joint_limit_violations == 0
    assert after.self_collisions in (None, 0)
    assert after.max_position_error <= 1e-4 * (1.0 + 1e-6)
    assert torch.equal(check_edges(refined, Tolerances()), refined.connected)
    assert f"{before.smoothness:.3f} → {after.smoothness:.3f}" in summary(refined, after)
    assert summary(plain, before) == ""


@pytest.mark.parametrize(("name", "task", "points"), PROBLEMS)
def test_nothing_is_lost_of_a_large_map_either(monkeypatch, name, task, points):
    plain = grr_torch.build(grr_torch.load_robot(name), task, points=points, refine=False)
    monkeypatch.setattr("grr_torch.resolution.losses._MOST_CHECKED", 100)
    # what cannot be told is as it was, as long as its ends are where they were
    broken = plain.connected.clone()
    broken[plain.connected.nonzero()[::50, 0]] = False
    refined = refine(replace(plain, connected=broken))
    assert bool((refined.connected | ~broken).all())
    assert refined.quality().smoothness < replace(plain, connected=broken).quality().smoothness
    checked = check_edges(refined, Tolerances())
    assert int((checked != refined.connected).sum()) <= 0.005 * int(checked.sum())


def test_refining_again_changes_little(planar_5):
    once = grr_torch.build(planar_5, "position", points=400)
    twice = refine(once)
    assert twice.quality().smoothness == pytest.approx(once.quality().smoothness, rel=0.01)


def test_the_same_map_is_refined_to_the_same_bytes(kinova):
    plain = grr_torch.build(kinova, "position", points=500, refine=False)
    first, second = refine(plain, seed=3), refine(plain, seed=3)
    for name in ("configurations", "resolved", "connected"):
        assert getattr(first, name).numpy().tobytes() == getattr(second, name).numpy().tobytes()


def test_what_was_taken_away_is_repaired(planar_5):
    whole = grr_torch.build(planar_5, "position", points=400, refine=False)
    inner = (whole.points.norm(dim=1) < 0.35).nonzero()[:, 0]
    taken = inner[::25]
    configurations, resolved = whole.configurations.clone(), whole.resolved.clone()
    configurations[taken], resolved[taken] = math.nan, False
    connected = whole.connected & ~torch.isin(whole.edges, taken).any(1)
    damaged = replace(whole, configurations=configurations, resolved=resolved, connected=connected)
    mended = refine(damaged)
    assert bool(mended.resolved[taken].all())
    assert int(mended.connected.sum()) >= int(whole.connected.sum())


def test_the_null_space_projector_keeps_what_leaves_the_task_alone(generator):
    jacobian = torch.randn(3, 7, 20, dtype=torch.float64, generator=generator)
    projector = null_space_projector(jacobian, 1e-12)
    for k in range(20):
        p, j = projector[:, :, k], jacobian[:, :, k]
        torch.testing.assert_close(p @ p, p, atol=1e-9, rtol=0)
        torch.testing.assert_close(p, p.T, atol=1e-9, rtol=0)
        assert float((j @ p).abs().max()) < 1e-9
        assert float(p.trace()) == pytest.approx(4.0, abs=1e-8)


@pytest.mark.parametrize(("name", "task"), [("planar_5", "position"), ("kinova", "fixed-rotation")])
def test_seeds_are_found_that_do_nearly_as_well_as_the_paper_s(name, task):
    robot = grr_torch.load_robot(name)
    by_hand = grr_torch.build(robot, task).quality()
    found = grr_torch.build(robot, task, seeds="auto").quality()
    assert found.resolved_vertices >= 0.99 * by_hand.resolved_vertices
    assert found.connected_edges >= 0.97 * by_hand.connected_edges
    assert found.smoothness <= 1.1 * by_hand.smoothness


def test_copies_are_relaxed_as_if_each_were_alone(planar_5):
    task = grr_torch.Position(2)
    graph = staggered_grid([(-0.3, 0.3)] * 2, 40)
    seeds = torch.tensor([[0.3, 0.5, 0.5, 0.5, 0.5], [2.0, -1.0, 0.4, -0.9, 0.3]], dtype=torch.float64)
    maps = torch.stack([expand(planar_5, task, graph, seed[None]).configurations for seed in seeds])
    assert bool(maps.isfinite().all())
    together = _relaxed(planar_5, task, graph, maps, Tolerances(), 8, 40.0)  # by default the bound depends on all
    for plain, moved in zip(maps, together, strict=True):
        alone = _relaxed(planar_5, task, graph, plain[None], Tolerances(), 8, 40.0)[0]
        costs = [float(_costs(planar_5, task, graph, q[None])) for q in (plain, moved, alone)]
        assert costs[1] < costs[0]
        assert costs[1] == pytest.approx(costs[2], rel=0.02)


@pytest.mark.parametrize("candidates", [0, -3, 1.5, True, 10**9])
def test_candidates_are_a_whole_number(planar_5, candidates):
    with pytest.raises(ParameterError, match="candidates"):
        grr_torch.build(planar_5, "position", seeds="auto", candidates=candidates)


def test_few_candidates_are_enough_for_some_map(planar_5):
    roadmap = grr_torch.build(planar_5, "position", points=150, seeds="auto", candidates=1)
    assert int(roadmap.resolved.sum()) > 100


def test_an_arm_without_preset_needs_no_seeds(box_arm):
    roadmap = grr_torch.build(
        grr_torch.load_robot(box_arm), "position", points=200, bounds=[(-0.6, 0.6)] * 2 + [(0.2, 1.0)]
    )
    assert int(roadmap.resolved.sum()) > 10
    assert roadmap.parameters["seeds"] == "auto"


@pytest.mark.parametrize(
    ("figures", "bounds"),
    [
        (PANDA, [(-0.9, 0.9), (-0.9, 0.9), (-0.2, 1.1)]),
        (IIWA_14, [(-0.9, 0.9), (-0.9, 0.9), (-0.2, 1.1)]),
        (PLANAR_10, [(-1.0, 1.0), (-1.0, 1.0)]),
    ],
)
def test_seeds_are_found_for_arms_nobody_tuned_anything_for(tmp_path, figures, bounds):
    path = tmp_path / "arm.urdf"
    path.write_text(arm_urdf(*figures))
    arm = grr_torch.load_robot(path)
    task = grr_torch.Position(len(bounds))
    quality = grr_torch.build(arm, task, points=400, bounds=bounds, reachability=10).quality()
    assert quality.coverage > 0.95
    assert quality.connectivity > 0.85


@pytest.fixture
def turning_arm(tmp_path):
    """An arm whose joints can turn twice, from −2π or −π on."""
    joints = [(*joint[:2], -(2 - k % 2) * math.pi, (2 + k % 2) * math.pi) for k, joint in enumerate(PANDA[0])]
    path = tmp_path / "arm.urdf"
    path.write_text(arm_urdf(joints, PANDA[1]))
    return grr_torch.load_robot(path)


def test_found_seeds_lie_near_the_middle_of_limits_that_allow_several_turns(turning_arm):
    task, graph = grr_torch.Position(3), staggered_grid([(0.3, 0.6), (-0.3, 0.3), (0.2, 0.6)], 60)
    for seed in range(3):
        seeds = find_seeds(turning_arm, task, graph, candidates=6, seed=seed, tolerances=Tolerances())
        middle = 0.5 * (turning_arm.lower + turning_arm.upper)
        away = 0.5 * (seeds.amin(0) + seeds.amax(0)) - middle
        for turns in (-1, 1):
            moved = seeds + 2.0 * math.pi * turns
            allowed = ((moved >= turning_arm.lower) & (moved <= turning_arm.upper)).all(0)
            nearer = (away + 2.0 * math.pi * turns).abs() < away.abs() - 1e-9
            assert not bool((allowed & nearer).any())


def test_seeds_turn_together_and_only_by_what_changes_nothing(turning_arm, kinova, planar_5, generator):
    seeds = turning_arm.sample(50, generator) * torch.tensor([0.1, 0.9, 0.1, 0.1, 0.9, 0.1, 0.9], dtype=torch.float64)
    seeds[:, 0] -= 4.5
    moved = in_the_middle(turning_arm, seeds)
    turns = (moved - seeds) / (2.0 * math.pi)
    torch.testing.assert_close(turns, turns.round()[:1].expand_as(turns), atol=1e-9, rtol=0)
    assert float(turns[0, 0]) == pytest.approx(1.0)
    assert bool(turning_arm.within_limits(moved).all())
    for one, other in zip(turning_arm.forward_kinematics(moved), turning_arm.forward_kinematics(seeds), strict=True):
        torch.testing.assert_close(one, other)
    for robot in (kinova, planar_5):
        q = robot.sample(20, generator)
        assert in_the_middle(robot, q).numpy().tobytes() == q.numpy().tobytes()


def test_a_joint_that_another_follows_by_a_part_of_a_turn_is_not_turned(tmp_path, generator):
    joints = [(*joint[:2], -2.0 * math.pi, 2.0 * math.pi) for joint in PANDA[0]]
    follower = (
        '<link name="side"/><joint name="follower" type="revolute"><parent link="tool"/><child link="side"/>'
        '<axis xyz="0 0 1"/><limit lower="-9" upper="9" velocity="1" effort="1"/>'
        '<mimic joint="joint1" multiplier="0.5"/></joint></robot>'
    )
    path = tmp_path / "arm.urdf"
    path.write_text(arm_urdf(joints, PANDA[1]).replace("</robot>", follower))
    arm = grr_torch.load_robot(path, tool="tool")
    seeds = 0.1 * arm.sample(10, generator) - 4.5
    turned = (in_the_middle(arm, seeds) != seeds).all(0)
    assert turned.tolist() == [False] + [True] * 6


def test_where_nothing_is_reached_no_seeds_are_found(kinova):
    # inside the pedestal of the arm itself
    graph = staggered_grid([(-0.01, 0.01), (-0.01, 0.01), (0.0, 0.02)], 9)
    with pytest.raises(SeedError, match="no seeds were found"):
        find_seeds(kinova, grr_torch.FixedRotation(3), graph, tolerances=Tolerances())


def test_copies_have_nothing_between_them():
    graph = staggered_grid([(0.0, 1.0)] * 2, 30)
    copies = Copies.of(graph, 3)
    size = len(graph.points)
    assert torch.equal(copies.edges // size, (copies.edges // size)[:, :1].expand(-1, 2))
    indices, distances = copies.neighbours(torch.tensor([size + 4]), 8)
    expected, lengths = graph.neighbours(torch.tensor([4]), 8)
    assert torch.equal(distances, lengths)
    assert torch.equal((indices - size)[lengths.isfinite()], expected[lengths.isfinite()])


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


@pytest.mark.parametrize("options", [{"samples": 0}, {"nearest": 0}, {"samples": 10**6}])
def test_random_grr_refuses_empty_pools(planar_5, options):
    graph = staggered_grid([(-0.4, 0.4)] * 2, 20)
    with pytest.raises(ParameterError):
        random_grr(planar_5, grr_torch.Position(2), graph, **options)


def test_random_seeds_lose_no_edge_and_a_wrong_flag_is_put_right(planar_5):
    for seed in (1, 2):
        seeds = planar_5.sample(4, torch.Generator().manual_seed(seed))
        plain = grr_torch.build(planar_5, "fixed-rotation", points=150, refine=False, seeds=seeds)
        refined = refine(plain)
        assert bool((refined.connected | ~plain.connected).all())
        wrong = replace(plain, connected=plain.resolved[plain.edges].all(1))
        assert not torch.equal(wrong.connected, check_edges(wrong, Tolerances()))
        mended = refine(wrong)
        assert torch.equal(mended.connected, check_edges(mended, Tolerances()))


def test_a_map_in_single_precision_is_refined_too():
    robot = grr_torch.load_robot("planar_5", dtype=torch.float32)
    plain = grr_torch.build(robot, "position", points=200, refine=False)
    refined = refine(plain)
    assert refined.quality().smoothness < plain.quality().smoothness


def test_a_flat_graph_in_space_needs_no_seeds(kinova):
    sheet = staggered_grid([(0.3, 0.6), (-0.3, 0.3)], 60)
    points = torch.cat([sheet.points, torch.full((len(sheet.points), 1), 0.4, dtype=torch.float64)], dim=1)
    graph = grr_torch.TaskGraph(points, sheet.edges)
    assert int(grr_torch.build(kinova, "position", points=graph, seeds="auto").resolved.sum()) > 50


def test_progress_counts_what_is_done(kinova):
    told: dict[str, list[tuple[int, int]]] = {}
    plain = grr_torch.build(kinova, "position", points=500, refine=False)
    refine(plain, progress=lambda stage, done, total: told.setdefault(stage, []).append((done, total)))
    assert set(told) == {"repairing", "refining", "certifying", "checking edges", "checking again", "measuring cells"}
    assert all(0 <= done <= total for calls in told.values() for done, total in calls)
    assert all(calls[-1][0] == calls[-1][1] for calls in told.values())
    assert (len(plain.triangles().corners),) * 2 in told["measuring cells"]
