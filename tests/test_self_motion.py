"""Self-motion manifolds: against the theory of planar linkages, and laws that hold for every arm."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from grr_torch.cli.main import app, join_numbers
from test_cli import run
from typer.testing import CliRunner

import grr_torch
from grr_torch.applications.self_motion import roadmap_choice
from grr_torch.applications.trace_curves import End
from grr_torch.errors import ParameterError
from grr_torch.recording.self_motion import record_self_motion
from grr_torch.recording.walk import walk
from grr_torch.spaces.configuration import distance
from grr_torch.spaces.task import make_task

POINT = [0.4, 0.2, 0.3]


def planar_arm(folder, lengths, limits=None):
    """A planar arm of links of some lengths, its joints continuous or within ± limits."""
    kind, limit = ("continuous", "") if limits is None else ("revolute", f'<limit lower="-{limits}" upper="{limits}"/>')
    lines, offset = ['<robot name="planar"><link name="link_0"/>'], 0.0
    for k, length in enumerate(lengths, 1):
        lines.append(
            f'<link name="link_{k}"/><joint name="joint_{k}" type="{kind}"><parent link="link_{k - 1}"/>'
            f'<child link="link_{k}"/><origin xyz="{offset} 0 0"/><axis xyz="0 0 1"/>{limit}</joint>'
        )
        offset = length
    lines.append(
        f'<link name="tool"/><joint name="end" type="fixed"><parent link="link_{len(lengths)}"/><child link="tool"/>'
        f'<origin xyz="{offset} 0 0"/></joint></robot>'
    )
    path = folder / "planar.urdf"
    path.write_text("".join(lines))
    return grr_torch.load_robot(path, tool="tool")


def polygon_components(lengths, radius):
    """How many families a closed polygon of these sides has (Kapovich and Millson 1995).

    Two, mirror images of each other, if there are three sides of which any two are longer than half of all; else one;
    none if one side is longer than the others together. With four sides, Grashof's condition.
    """
    sides = sorted([*lengths, radius])
    if sides[-1] > sum(sides) / 2.0:
        return 0
    return 2 if sides[-3] + sides[-2] > sum(sides) / 2.0 else 1


@pytest.fixture(scope="module")
def planar_3():
    return grr_torch.load_robot("planar_3")


@pytest.fixture(scope="module")
def fixed_rotation(kinova):
    task = grr_torch.FixedRotation(3, kinova.preset.problems["fixed-rotation"].rotation)
    return grr_torch.self_motion_manifold(kinova, task, POINT, samples=300)


def check(manifold):
    """What holds for every manifold: at the point, within limits, edges within components, labels in order."""
    robot, task, q = manifold.robot, manifold.task, manifold.configurations
    poses = robot.forward_kinematics(q)
    columns = [part.movedim(0, -1) for part in poses]
    error = task.error(manifold.point[:, None].expand(-1, len(q)), *columns)
    translation, rotation = task.residuals(error)
    assert float(translation.max()) <= 1e-6
    assert float(rotation.max()) <= 1e-5
    assert bool(robot.within_limits(q).all())
    assert torch.equal(manifold.free, ~robot.in_self_collision(q))
    assert manifold.component.unique().tolist() == list(range(manifold.components))
    assert bool((manifold.component.diff() >= 0).all())
    a, b = manifold.edges.T
    assert torch.equal(manifold.component[a], manifold.component[b])
    low, high = manifold.ranges()[manifold.component].unbind(2)
    turns = torch.where(robot.continuous, ((q - low + 1e-9) / (2.0 * math.pi)).floor() * 2.0 * math.pi, 0.0)
    assert bool(((q - turns >= low - 1e-9) & (q - turns <= high + 1e-9)).all())


def check_curves(manifold, step=0.05):
    """What holds for every curve: short steps, smooth, closed or ending at limits."""
    robot = manifold.robot
    for component in range(manifold.components):
        curve = manifold.curve(component)
        steps = curve.diff(dim=0)
        assert float(steps.norm(dim=1).max()) <= 1.3 * step
        directions = steps / steps.norm(dim=1, keepdim=True)
        assert float((directions[1:] * directions[:-1]).sum(1).min()) > 0.9
        if manifold.closed[component]:
            assert float(distance(curve[0], curve[-1], robot.continuous)) < 1e-12
            assert float(directions[0] @ directions[-1]) > 0.9
        else:
            assert manifold.ends[component].tolist() == [End.LIMIT, End.LIMIT]
            room = torch.minimum(curve[[0, -1]] - robot.lower, robot.upper - curve[[0, -1]])
            assert float(room.amin(1).max()) < 1e-5


@pytest.mark.parametrize("share", [0.0, 0.1, 0.31, 0.35, 0.6, 0.95])
def test_curves_of_planar_3_are_as_many_as_grashof_says_and_all_close(planar_3, share):
    radius = 0.3 * share
    point = [0.6 * radius, -0.8 * radius]
    manifold = grr_torch.self_motion_manifold(planar_3, grr_torch.Position(2), point, samples=60)
    assert manifold.dimension == 1
    assert manifold.components == (2 if radius < 0.1 else 1)
    assert bool(manifold.closed.all())
    check(manifold)
    check_curves(manifold)


def test_a_curve_of_planar_3_has_the_analytic_length_in_the_degenerate_case(planar_3):
    # with the tool on the first joint's axis the links are an equilateral triangle, and only joint 1 turns
    manifold = grr_torch.self_motion_manifold(planar_3, grr_torch.Position(2), [0.0, 0.0], samples=20)
    elbows = sorted(float(manifold.curve(c)[0, 1]) for c in range(2))
    assert elbows == pytest.approx([-2.0 * math.pi / 3.0, 2.0 * math.pi / 3.0], abs=1e-4)
    for component in range(2):
        turn = manifold.curve(component)[-1] - manifold.curve(component)[0]
        assert turn.abs().tolist() == pytest.approx([2.0 * math.pi, 0.0, 0.0], abs=1e-4)


@pytest.mark.parametrize("n", [3, 4, 5])
def test_random_planar_arms_have_the_components_of_their_polygon(tmp_path, n):
    rng = np.random.default_rng(n)
    seen = set()
    for seed in range(5 if n == 3 else 12):
        lengths = rng.uniform(0.05, 0.5, n)
        lengths[3:] *= rng.uniform(0.1, 1.0)
        radius = rng.uniform(0.0, 0.6) * lengths.sum()
        expected = polygon_components(lengths, radius)
        robot, point = planar_arm(tmp_path, lengths), [0.6 * radius, 0.8 * radius]
        if expected == 0:
            with pytest.raises(ParameterError, match="not reachable"):
                grr_torch.self_motion_manifold(robot, grr_torch.Position(2), point, samples=50)
            continue
        manifold = grr_torch.self_motion_manifold(
            robot, grr_torch.Position(2), point, samples=60 if n == 3 else 400, seed=seed
        )
        assert manifold.components == expected
        check(manifold)
        if n == 3:
            check_curves(manifold)
            assert bool(manifold.closed.all())
        seen.add(expected)
    assert seen == {1, 2}


def test_limits_cut_curves_open(tmp_path):
    robot = planar_arm(tmp_path, [0.3, 0.25, 0.2], limits=2.0)
    manifold = grr_torch.self_motion_manifold(robot, grr_torch.Position(2), [0.3, 0.2], samples=200)
    assert not bool(manifold.closed.any())
    check(manifold)
    check_curves(manifold)


def test_the_kinova_with_fixed_rotation_has_eight_open_curves(fixed_rotation):
    # shoulder, elbow and wrist each bend either way
    assert fixed_rotation.components == 8
    signs = {tuple(fixed_rotation.curve(c)[0, [1, 3, 5]].sign().tolist()) for c in range(8)}
    assert len(signs) == 8
    check(fixed_rotation)
    check_curves(fixed_rotation)


@pytest.mark.parametrize(
    ("name", "kind", "point", "dimension", "components"),
    [
        ("planar_5", "position", [0.2, 0.1], 3, 1),
        ("planar_5", "fixed-rotation", [0.2, 0.1], 2, 1),
        ("kinova", "position", [0.8, 0.3, 0.2], 4, 2),  # the shoulder cannot pass the vertical that far out
        ("kinova", "position", [0.3, 0.2, 0.3], 4, 2),  # nor the elbow be straight that near
    ],
)
def test_manifolds_of_more_dimensions(name, kind, point, dimension, components):
    robot = grr_torch.load_robot(name)
    task = make_task(kind, len(point), robot.preset.problems[kind].rotation)
    manifold = grr_torch.self_motion_manifold(robot, task, point, samples=600)
    assert (manifold.dimension, manifold.components) == (dimension, components)
    assert len(manifold.configurations) <= 600
    assert manifold.ends is None
    assert not bool(manifold.closed.any())
    check(manifold)
    q = walk(manifold, 0)
    assert float(q.diff(dim=0).norm(dim=1).max()) < 0.3
    position, _ = robot.forward_kinematics(q)
    assert float((position[:, : task.dimension] - manifold.point).norm(dim=1).max()) <= 1e-4
    with pytest.raises(ParameterError, match="only there components are curves"):
        manifold.curve(0)


def test_components_come_out_the_same_from_any_seed(tmp_path, planar_3, kinova, fixed_rotation):
    others = [
        (fixed_rotation, {"samples": 300}),
        (grr_torch.self_motion_manifold(planar_3, grr_torch.Position(2), [0.02, 0.05], samples=40), {"samples": 40}),
        (grr_torch.self_motion_manifold(kinova, grr_torch.Position(3), [0.3, 0.2, 0.3]), {}),
    ]
    for first, options in others:
        again = grr_torch.self_motion_manifold(first.robot, first.task, first.point, seed=7, **options)
        assert again.components == first.components
        for component in range(again.components):
            q = again.configurations[again.component == component]
            assert {first.component_of(row) for row in q[:: len(q) // 5]} - {None} == {component}
        same = grr_torch.self_motion_manifold(first.robot, first.task, first.point, seed=7, **options)
        assert torch.equal(same.configurations, again.configurations)


def test_samples_in_self_collision_are_kept_and_marked(kinova):
    task = grr_torch.Position(3)
    manifold = grr_torch.self_motion_manifold(kinova, task, [0.15, 0.1, 0.25], samples=600)
    assert 0 < int((~manifold.free).sum()) < len(manifold.free)


def test_bad_points_are_refused(planar_3, kinova, planar_5):
    plane = grr_torch.Position(2)
    for point in ([0.1], [0.1, 0.1, 0.1], [math.nan, 0.1], [[0.1, 0.1]], "here", torch.zeros(2, dtype=torch.cfloat)):
        with pytest.raises(ParameterError, match="point"):
            grr_torch.self_motion_manifold(planar_3, plane, point)
    with pytest.raises(ParameterError, match=r"not reachable: it lies 0\.4 m from the first joint"):
        grr_torch.self_motion_manifold(planar_3, plane, [0.4, 0.0])
    # straight above the base, gripper down
    down = grr_torch.FixedRotation(3, kinova.preset.problems["fixed-rotation"].rotation)
    with pytest.raises(ParameterError, match="not reachable: none of 300 random starts"):
        grr_torch.self_motion_manifold(kinova, down, [0.0, 0.0, 1.1], samples=300)
    with pytest.raises(ParameterError, match="fewer equations than joints"):
        grr_torch.self_motion_manifold(planar_3, make_task("fixed-rotation", 2), [0.1, 0.1])
    for option in ({"samples": 0}, {"samples": 1.5}, {"step": 0.0}, {"step": math.nan}, {"seed": -1}):
        with pytest.raises(ParameterError):
            grr_torch.self_motion_manifold(planar_5, plane, [0.1, 0.1], **option)


def test_the_roadmap_s_choice_lies_on_the_manifold(planar_roadmap):
    vertex = int(planar_roadmap.resolved.nonzero()[3, 0])
    at_vertex = planar_roadmap.points[vertex]
    assert torch.equal(roadmap_choice(planar_roadmap, at_vertex), planar_roadmap.configurations[vertex])
    for point in (at_vertex, at_vertex * 0.97):
        choice = roadmap_choice(planar_roadmap, point)
        manifold = grr_torch.self_motion_manifold(planar_roadmap.robot, planar_roadmap.task, point)
        assert manifold.component_of(choice) == 0
    assert roadmap_choice(planar_roadmap, [0.6, 0.6]) is None


def test_recordings_hold_their_parts(fixed_rotation, planar_3, tmp_path):
    from test_recording import entities

    record_self_motion([fixed_rotation], tmp_path / "one.rrd", [fixed_rotation.configurations[0]])
    found = entities(tmp_path / "one.rrd")
    wanted = {f"/configuration_space/point_1/component_{c}/{part}" for c in range(1, 9) for part in ("curve", "ends")}
    wanted |= {
        "/configuration_space/roadmap/choices",
        "/space/component_1/arms",
        "/joints/joint_7",
        "/robot/joints/joint_4",
    }
    assert wanted <= found
    roadmap = grr_torch.build(planar_3, "position", points=60)
    vertices = roadmap.cells()[0].corners[0].tolist()
    manifolds = [
        grr_torch.self_motion_manifold(planar_3, roadmap.task, roadmap.points[vertex], samples=30)
        for vertex in vertices
    ]
    record_self_motion(manifolds, tmp_path / "three.rrd", [roadmap.configurations[v] for v in vertices], roadmap)
    assert {"/space/path", "/space/roadmap", "/configuration_space/roadmap/edges"} <= entities(tmp_path / "three.rrd")
    with pytest.raises(ParameterError, match="manifolds"):
        record_self_motion([], tmp_path / "none.rrd")
    with pytest.raises(ParameterError, match="choices"):
        record_self_motion(manifolds, tmp_path / "none.rrd", [None])


def test_the_command_prints_writes_and_refuses(tmp_path):
    result = run(
        "smm", "--robot", "planar_3", "--samples", 30, "--record", "a.rrd", "--out", "a.npz", "--json", cwd=tmp_path
    )
    assert result.returncode == 0, result.stderr
    data = json.loads(result.stdout)
    assert len(data["points"]) == 3
    assert all(point["roadmap_component"] is not None for point in data["points"])
    arrays = np.load(tmp_path / "a.npz", allow_pickle=False)
    count = sum(part["samples"] for point in data["points"] for part in point["components"])
    assert arrays["configurations"].shape == (count, 3)
    assert arrays["component"].max() + 1 == len(arrays["closed"]) == len(arrays["component_point"])
    words = ["smm", "--robot", "planar_5", "--point", "0.2", "-0.1", "--samples", "50"]
    table = CliRunner().invoke(app, join_numbers(words))
    assert table.exit_code == 0, table.output
    assert "no curve" in table.output
    for words, message in (
        (("--robot", "planar_3", "--point", 0.5, 0.5), "not reachable"),
        (("--robot", "planar_3", "--point", 0.1), "two or three numbers"),
        (("--robot", "planar_3", "--point", "nan", 0.1), "finite"),
        (("--point", 0.1, 0.1), "--robot"),
        (("--robot", "planar_3", "--task", "fixed-rotation"), "Known: position"),
    ):
        refused = CliRunner().invoke(app, join_numbers(["smm", *map(str, words)]))
        assert (refused.exit_code, message in refused.output) == (2, True), refused.output
