"""Building roadmaps: the paper's four problems, determinism, and what may be given."""

from __future__ import annotations

import importlib
import math
import warnings
from dataclasses import replace

import pytest
import torch
from small_urdfs import hinge, robot_text

import grr_torch
from grr_torch.errors import GrrWarning, ParameterError, SeedError, UnknownNameError
from grr_torch.projection.project import project
from grr_torch.resolution.expand import expand
from grr_torch.resolution.reachability import reach
from grr_torch.resolution.seeds import read_seeds
from grr_torch.spaces.configuration import average, distance, embed
from grr_torch.spaces.graph import TaskGraph, staggered_grid

# reachable vertices and edges between them, as the arm's own shapes allow
PROBLEMS = [
    ("planar_5", "position", 761, 2168, 1.0, 1.0, 5.25, 0.995),
    ("planar_5", "fixed-rotation", 488, 1379, 1.0, 1.0, 8.9, 0.985),
    ("kinova", "position", 1267, 6105, 0.999, 0.998, 2.51, 0.985),
    ("kinova", "fixed-rotation", 430, 1896, 0.985, 0.98, 4.17, 0.99),
]


@pytest.mark.parametrize(
    ("name", "kind", "reachable", "edges", "coverage", "connectivity", "smoothness", "certified"), PROBLEMS
)
def test_the_paper_s_problems(name, kind, reachable, edges, coverage, connectivity, smoothness, certified):
    roadmap = grr_torch.build(grr_torch.load_robot(name), kind)
    quality = roadmap.quality()
    assert quality.resolved_vertices >= coverage * reachable
    assert quality.connected_edges >= connectivity * edges
    assert quality.smoothness <= smoothness
    assert quality.triangles_certified >= certified
    assert quality.max_position_error <= 1e-4
    assert quality.max_rotation_error <= 1e-3
    assert quality.joint_limit_violations == 0
    assert quality.self_collisions == (0 if name == "kinova" else None)
    if name == "kinova":
        assert quality.min_self_collision_distance >= 0.002


def test_reachable_vertices_are_found_and_nothing_else(planar_5):
    """The planar arm reaches the disc of radius 0.5, and resolves all of it."""
    roadmap = grr_torch.build(planar_5, "position", points=300, reachability=8)
    inside = roadmap.points.norm(dim=1) <= 0.5 + 1e-9
    assert torch.equal(roadmap.reachable, inside)
    quality = roadmap.quality()
    assert quality.coverage == 1.0
    assert quality.reachable_edges == int(inside[roadmap.edges].all(1).sum())


def test_the_same_inputs_give_the_same_bytes(kinova):
    first, second = (grr_torch.build(kinova, "position", points=400, reachability=2, seed=5) for _ in range(2))
    for name in ("points", "configurations", "resolved", "edges", "connected", "wave", "reachable"):
        assert getattr(first, name).numpy().tobytes() == getattr(second, name).numpy().tobytes()


def test_connected_edges_pass_the_check_and_the_rest_does_not(kinova):
    roadmap = grr_torch.build(kinova, "fixed-rotation", points=1500)
    both = roadmap.resolved[roadmap.edges].all(1)
    assert not bool(roadmap.connected[~both].any())
    a, b = roadmap.edges[both].T
    p, q = roadmap.points, roadmap.configurations
    found = grr_torch.is_continuous(kinova, roadmap.task, p[a], p[b], q[a], q[b])
    assert torch.equal(found, roadmap.connected[both])


def test_waves_grow_along_edges_from_the_seeds(planar_roadmap):
    wave = planar_roadmap.wave
    assert torch.equal(wave >= 0, planar_roadmap.resolved)
    a, b = planar_roadmap.edges.T
    earliest = torch.full_like(wave, 1000)
    for start, end in ((a, b), (b, a)):
        earlier = torch.where(wave[start] >= 0, wave[start], 1000)
        earliest = earliest.scatter_reduce(0, end, earlier, "amin")
    later = wave > 0
    assert bool((earliest[later] < wave[later]).all())


def test_one_wave_is_the_projected_average_of_resolved_neighbours(planar_5):
    """A hand-made graph of two seeds and a point between them, nearer to the first."""
    q = torch.tensor([[0.3, 0.4, 0.4, 0.4, 0.4], [0.9, 0.4, 0.4, 0.4, 0.4]], dtype=torch.float64)
    ends = planar_5.forward_kinematics(q)[0][:, :2]
    middle = 0.6 * ends[:1] + 0.4 * ends[1:]
    graph = TaskGraph(torch.cat([ends, middle]), torch.tensor([[0, 2], [1, 2]]))
    task = grr_torch.Position(2)
    expansion = expand(planar_5, task, graph, q)
    d = (ends - middle).norm(dim=1)
    weights = (d.max() / d) ** 2
    mean = average((weights[:, None] * embed(q, planar_5.continuous)).sum(0), planar_5.continuous)
    expected, _ = project(planar_5, task, middle[0], mean)
    assert distance(expansion.configurations[2], expected, planar_5.continuous) < 1e-12
    assert expansion.wave.tolist() == [0, 0, 1]


def test_quality_figures_are_what_they_say(planar_roadmap):
    quality = planar_roadmap.quality()
    a, b = planar_roadmap.edges[planar_roadmap.connected].T
    q, p = planar_roadmap.configurations, planar_roadmap.points
    slopes = distance(q[a], q[b], planar_roadmap.robot.continuous) / (p[a] - p[b]).norm(dim=1)
    assert quality.smoothness == pytest.approx(float(slopes.mean()))
    assert quality.smoothness_max == pytest.approx(float(slopes.max()))
    assert quality.smoothness_median == pytest.approx(float(slopes.quantile(0.5)))
    assert quality.connectivity == quality.connected_edges / quality.reachable_edges


def test_without_reachability_nothing_is_claimed(planar_5):
    quality = grr_torch.build(planar_5, "position", points=50).quality()
    assert quality.reachable_vertices is None
    assert quality.coverage is None
    assert quality.connectivity is None
    assert quality.connectivity_resolved is not None


def test_a_robot_of_one_s_own_is_built_from_its_urdf(box_arm):
    robot = grr_torch.load_robot(box_arm)
    roadmap = grr_torch.build(
        robot,
        grr_torch.Position(3),
        points=300,
        bounds=[(-0.6, 0.6), (-0.6, 0.6), (0.1, 1.0)],
        seeds=[[0.0, 1.0, 0.5], [2.0, 1.0, 0.5]],
    )
    assert roadmap.quality().resolved_vertices > 20


def test_a_graph_of_one_s_own_is_used(planar_5, generator):
    graph = grr_torch.random_graph([(-0.4, 0.4)] * 2, 150, k=6, generator=generator)
    roadmap = grr_torch.build(planar_5, "position", points=graph)
    assert torch.equal(roadmap.points, graph.points)
    assert roadmap.quality().resolved_vertices == int((graph.points.norm(dim=1) <= 0.5).sum())


def test_reach_holds_every_tool_position(kinova, generator):
    centre, radius = reach(kinova)
    position = kinova.forward_kinematics(kinova.sample(5000, generator))[0]
    assert (position - centre).norm(dim=1).max() <= radius


def test_unusable_seeds_are_named_and_the_build_goes_on(kinova, generator):
    good = grr_torch.load_preset("kinova").problems["position"].seeds
    q = kinova.sample(5000, generator)
    colliding = q[kinova.self_collision_distance(q) < -0.01][0]
    # in self-collision too: the limits are what is wrong
    beyond = colliding + torch.tensor([0.0, 4.0 * math.pi, 0, 0, 0, 0, 0])
    assert bool(kinova.in_self_collision(beyond))
    seeds = torch.stack([torch.tensor(good[0]), colliding, beyond, torch.tensor(good[1])])
    wanted = "2 of 4 seeds are not used: seed 1: in self-collision; seed 2: outside joint limits"
    with pytest.warns(GrrWarning, match=wanted):
        roadmap = grr_torch.build(kinova, "position", points=300, seeds=seeds)
    assert bool(roadmap.resolved.any())


def test_only_seeds_that_were_given_are_warned_of(planar_5, monkeypatch):
    beyond = torch.tensor([[0.3, 0.4, 0.4, 0.4, 0.4], [0.3, 9.0, 0.4, 0.4, 0.4]], dtype=torch.float64)
    robot = replace(planar_5, upper=torch.full_like(planar_5.upper, 3.0))
    with pytest.warns(GrrWarning, match="1 of 2 seeds are not used"):
        given = grr_torch.build(robot, "position", points=50, seeds=beyond, refine=False)
    # the package's `build` is the function
    module = importlib.import_module("grr_torch.resolution.methods")
    monkeypatch.setattr(module, "find_seeds", lambda *_, **__: beyond)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = grr_torch.build(robot, "position", points=50, seeds="auto", refine=False)
    assert torch.equal(found.wave, given.wave)


@pytest.mark.parametrize(
    ("seeds", "complaint"),
    [
        ([[0.0, 0.0]], r"valid: \(S, 5\)"),
        ([], "seeds have shape|no seeds"),
        ([[math.nan] * 5, [0.0] * 5], "seeds 0 hold NaN"),
        ([[0.0] * 5, [0.0] * 4], "not a table"),
    ],
)
def test_bad_seeds_are_errors(planar_5, seeds, complaint):
    with pytest.raises(SeedError, match=complaint):
        grr_torch.build(planar_5, "position", seeds=seeds)


def test_seeds_that_all_collide_are_an_error(kinova, generator):
    q = kinova.sample(5000, generator)
    q = q[kinova.self_collision_distance(q) < -0.04][:3]
    with pytest.raises(SeedError, match="none of 3 seeds can be used: seed 0: in self-collision") as caught:
        grr_torch.build(kinova, "position", seeds=q)
    assert set(caught.value.reasons) == {0, 1, 2}


def test_seed_files_are_read(tmp_path):
    (tmp_path / "a.csv").write_text("# two\n0, 0.1, 0.2\n\n1 1.1 1.2\n")
    assert read_seeds(tmp_path / "a.csv").tolist() == [[0.0, 0.1, 0.2], [1.0, 1.1, 1.2]]


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"bounds": [(5, 6), (5, 6), (5, 6)]}, "points within 1.151 m of"),
        ({"points": 0}, "points: got 0"),
        ({"neighbours": 0}, "neighbours: got 0"),
        ({"reachability": -1}, "reachability: got -1"),
        ({"bounds": [(1, -1), (0, 1), (0, 1)]}, "low < high"),
        ({"task": grr_torch.Position(2)}, "2 for R2"),
        (
            {"points": 10, "task": grr_torch.Position(3), "robot": "planar_3", "bounds": [(0, 0.2)] * 3},
            "stays in a plane",
        ),
        ({"task": grr_torch.FixedRotation(2), "bounds": [(-1, 1), (-1, 1)]}, "tool leaves the plane"),
        (
            {"task": grr_torch.FixedRotation(2), "points": 9, "robot": "two", "bounds": [(0, 0.2)] * 2},
            "which fixes 3 coordinates; valid: one that fixes no more than r has joints, 2",
        ),
        ({"reachability": 1.5}, "reachability: got 1.5"),
        ({"neighbours": 2.5}, "neighbours: got 2.5"),
        ({"samples": 1.5, "method": "random"}, "samples: got 1.5"),
        ({"samples": 9}, 'samples: got 9; valid: none with method "expansion"'),
        ({"nearest": 3}, 'nearest: got 3; valid: none with method "expansion"'),
        ({"nearest": 0, "method": "random"}, "nearest: got 0; valid: a whole number, 1 or more"),
        ({"neighbours": 9, "method": "random"}, "neighbours: got 9"),
        ({"candidates": 9, "method": "random"}, "candidates: got 9"),
        ({"candidates": 9}, "candidates: got 9; valid: none with seeds that are given"),
        ({"points": staggered_grid([(0, 0.5)] * 3, 20), "bounds": [(0, 1)] * 3}, "bounds: got .*its own bounds"),
    ],
)
def test_bad_parameters_are_errors(kinova, options, complaint, tmp_path):
    task, name = options.pop("task", "position"), options.pop("robot", None)
    if name == "two":
        parts = [hinge(f"j{k}", f"l{k}", f"l{k + 1}") for k in range(2)]
        (tmp_path / "two.urdf").write_text(robot_text(*parts, links=("l0", "l1", "l2")))
        name = tmp_path / "two.urdf"
    robot = grr_torch.load_robot(name) if name else kinova
    with pytest.raises(ParameterError, match=complaint):
        grr_torch.build(robot, task, **options)


def test_bounds_in_centimetres_are_warned_of(planar_5):
    with pytest.warns(GrrWarning, match=r"only \d+ of 313 points lie within 0.500 m .* are the bounds in metres"):
        grr_torch.build(planar_5, "position", points=300, bounds=[(-50, 50), (-50, 50)])


def test_an_unknown_task_lists_the_known(kinova):
    with pytest.raises(UnknownNameError, match="Known: position, fixed-rotation"):
        grr_torch.build(kinova, "rotation")


def test_unknown_seeds_and_methods_are_errors(planar_5):
    with pytest.raises(UnknownNameError, match="auto"):
        grr_torch.build(planar_5, "position", seeds="abc")
    with pytest.raises(UnknownNameError, match="expansion, random"):
        grr_torch.build(planar_5, "position", method="abc")


def test_what_is_no_robot_or_no_task_is_refused(planar_5):
    with pytest.raises(ParameterError, match=r"robot: got 'kinova'; valid: a Robot, such as load_robot\('kinova'\)"):
        grr_torch.build("kinova")
    with pytest.raises(ParameterError, match=r"task: got 'position'; valid: a TaskSpace, such as Position\(3\)"):
        grr_torch.self_motion_manifold(planar_5, "position", [0.3, 0.1])
