"""Seeds that are found: for any arm, nearly as good as chosen ones, and turned only as the task allows."""

from __future__ import annotations

import math

import pytest
import torch
from public_arms import IIWA_14, PANDA, PLANAR_10, arm_urdf

import grr_torch
from grr_torch.errors import ParameterError, SeedError
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.auto_seeds import _costs, _relaxed, find_seeds
from grr_torch.resolution.expand import expand
from grr_torch.resolution.seeds import in_the_middle
from grr_torch.spaces.graph import Copies, staggered_grid


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


def test_a_flat_graph_in_space_needs_no_seeds(kinova):
    sheet = staggered_grid([(0.3, 0.6), (-0.3, 0.3)], 60)
    points = torch.cat([sheet.points, torch.full((len(sheet.points), 1), 0.4, dtype=torch.float64)], dim=1)
    graph = grr_torch.TaskGraph(points, sheet.edges)
    assert int(grr_torch.build(kinova, "position", points=graph, seeds="auto").resolved.sum()) > 50


def test_a_bundled_robot_with_a_joint_held_finds_its_own_seeds():
    robot = grr_torch.load_robot("kinova", held_joints={"joint_3": 0.0})
    roadmap = grr_torch.build(robot, points=400)
    assert roadmap.parameters["seeds"] == "auto"
    assert roadmap.parameters["max_slope"] is None
    assert roadmap.resolved.any()
