"""Recordings: what is in them, that tours are continuous, and that they stay small."""

from __future__ import annotations

import warnings

import pytest
import torch

import grr_torch
from grr_torch.errors import GrrWarning
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


def test_meshes_that_are_gone_are_left_out_with_a_warning(tmp_path):
    import trimesh
    from random_robots import BOX_ARM

    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "hand.stl")
    path = tmp_path / "arm.urdf"
    path.write_text(BOX_ARM.replace('<sphere radius="0.05"/>', '<mesh filename="hand.stl"/>'))
    robot = grr_torch.load_robot(path)
    task, bounds = grr_torch.Position(3), [(-0.5, 0.5)] * 2 + [(0.2, 0.9)]
    roadmap = grr_torch.build(robot, task, points=60, bounds=bounds, seeds=[[0.0, 1.0, 0.5]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        record_roadmap(roadmap, tmp_path / "with.rrd")
    (tmp_path / "hand.stl").unlink()
    with pytest.warns(GrrWarning, match=r"1 meshes are left out of the recording, not found: hand\.stl"):
        record_roadmap(roadmap, tmp_path / "without.rrd")
