"""Recordings: what is in them, that tours are continuous, and that they stay small."""

from __future__ import annotations

import warnings

import pytest
import torch
from random_robots import BOX_ARM

import grr_torch
from grr_torch.errors import GrrWarning
from grr_torch.interactive.scene import link_meshes
from grr_torch.recording.roadmap import record_roadmap
from grr_torch.recording.tour import tour
from grr_torch.spaces.configuration import normalise


@pytest.fixture(scope="module")
def kinova_roadmap(kinova):
    return grr_torch.build(kinova, "fixed-rotation", reachability=1)


def entities(path):
    from rerun.chunk import RrdReader

    return {column.entity_path for column in RrdReader(path).store().schema().component_columns()}


def test_a_kinova_recording_has_all_its_parts_and_is_small(kinova_roadmap, tmp_path):
    path = tmp_path / "k.rrd"
    record_roadmap(kinova_roadmap, path)
    assert path.stat().st_size < 20e6
    found = entities(path)
    wanted = {"connected", "broken", "grid", "unresolved", "clearance"}
    wanted |= {f"by_joint/{name}" for name in kinova_roadmap.robot.joint_names}
    assert {f"/roadmap/{name}" for name in wanted} <= found
    assert {"/expansion/vertices", "/expansion/edges", "/tour/path", "/joints/joint_1"} <= found
    assert "/robot/joints/joint_4" in found
    assert any("visual_geometries" in entity for entity in found)


def test_a_tour_follows_connected_edges_without_jumps(kinova_roadmap):
    points, q = tour(kinova_roadmap)
    robot = kinova_roadmap.robot
    position, _ = robot.forward_kinematics(q)
    assert (position - points).norm(dim=1).max() <= 1e-4
    assert (q[1:] - q[:-1]).norm(dim=1).max() < 1.0
    assert bool(robot.within_limits(normalise(q, robot.continuous)).all())
    assert not bool(robot.in_self_collision(q).any())


def test_tours_are_unwrapped(planar_roadmap):
    _, q = tour(planar_roadmap)
    assert (q[1:] - q[:-1]).abs().max() < torch.pi


def test_a_roadmap_without_edges_is_recorded(planar_5, tmp_path):
    graph = grr_torch.TaskGraph(torch.tensor([[0.3, 0.1]], dtype=torch.float64), torch.empty(0, 2, dtype=torch.long))
    roadmap = grr_torch.build(planar_5, "position", points=graph, seeds=[[0.1, 0.2, 0.2, 0.2, 0.2]])
    record_roadmap(roadmap, tmp_path / "one.rrd")
    assert (tmp_path / "one.rrd").stat().st_size > 0


@pytest.fixture
def box_roadmap(tmp_path):
    """A small roadmap of the box arm, after changes to its URDF."""

    def build(*changes):
        import trimesh

        trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "hand.stl")
        path = tmp_path / "arm.urdf"
        text = BOX_ARM
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        path.write_text(text)
        task, bounds = grr_torch.Position(3), [(-0.5, 0.5)] * 2 + [(0.2, 0.9)]
        robot = grr_torch.load_robot(path, tool="tip")
        return grr_torch.build(robot, task, points=60, bounds=bounds, seeds=[[0.0, 1.0, 0.5]], refine=False)

    return build


BALL = '<collision><origin xyz="0 0 0.06"/><geometry><sphere radius="0.05"/></geometry></collision>'


FREE = '<link name="free"/><joint name="f" type="ball"><parent link="tip"/><child link="free"/></joint>'


@pytest.mark.parametrize(
    "change",
    [
        (' effort="1" velocity="1"', ""),
        ('<link name="tip"/>', '<link name="tip"><inertial><origin xyz="0 0 0"/></inertial></link>'),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><safety_controller soft_lower_limit="1"/>'),
        ("</robot>", FREE + "</robot>"),
        (BALL, '<visual><geometry><sphere radius="1"/></geometry><material><color rgba="1 0 0"/></material></visual>'),
        (BALL, '<visual><geometry><mesh filename="hand.stl" scale="0.5"/></geometry></visual>'),
    ],
    ids=[
        "limit without velocity",
        "inertia without mass",
        "safety",
        "joint of another type",
        "colour of three numbers",
        "scale of one number",
    ],
)
def test_a_urdf_that_is_read_is_displayed(box_roadmap, tmp_path, change):
    """Displays have reasons to refuse a URDF that are none of the kinematics'."""
    roadmap = box_roadmap(change)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        record_roadmap(roadmap, tmp_path / "r.rrd")
        assert set(link_meshes(roadmap.robot)) == {"base", "upper", "fore", "hand"}
    found = entities(tmp_path / "r.rrd")
    assert {"/robot/joints/elbow", "/tf_static"} <= found
    assert any("visual_geometries" in entity and "hand" in entity for entity in found)


def test_a_robot_that_rerun_refuses_is_left_out_with_a_warning(run_cli, box_arm, tmp_path):
    box_arm.write_text(BOX_ARM.replace('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><axis xyz="0 1 0"/>'))
    options = ["--robot", box_arm, "--bounds", "-0.5 0.5 -0.5 0.5 0.2 0.9", "--points", "60", "--no-refine"]
    code, _, errors = run_cli("build", *options, "--out", "r.grr")
    assert code == 0
    assert len(errors.splitlines()) == 1
    assert errors.startswith("warning: the robot is left out of the recording: rerun cannot display its URDF:")
    assert "duplicate field `axis`" in errors
    roadmap = grr_torch.Roadmap.load(tmp_path / "r.grr")
    assert bool(roadmap.resolved.any())
    found = entities(tmp_path / "r.rrd")
    assert {"/roadmap/connected", "/tour/path"} <= found
    assert not any(entity.startswith("/robot") for entity in found)


def test_meshes_that_are_gone_are_left_out_with_a_warning(box_roadmap, tmp_path, capfd):
    roadmap = box_roadmap(('<sphere radius="0.05"/>', '<mesh filename="hand.stl"/>'))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        record_roadmap(roadmap, tmp_path / "with.rrd")
    (tmp_path / "hand.stl").unlink()
    with pytest.warns(
        GrrWarning, match=r"meshes left out of the recording, not found: hand\.stl\..*--package-dir"
    ) as warned:
        record_roadmap(roadmap, tmp_path / "without.rrd")
    assert len(warned) == 1
    with pytest.warns(GrrWarning, match=r"meshes left out of the page, not found: hand\.stl\."):
        assert set(link_meshes(roadmap.robot)) == {"base", "upper", "fore"}
    assert capfd.readouterr().err == ""  # neither display has more to say of them
