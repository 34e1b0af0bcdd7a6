"""Roadmap files: they come back equal, need nothing else, and do not lie unnoticed."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

import grr_torch
from grr_torch.errors import FileFormatError
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.roadmap_file import roadmap_hash
from grr_torch.resolution.verify import verify_file
from grr_torch.robots.urdf_json import urdf_from_json, urdf_to_json
from grr_torch.tensor_file import read_tensors, tensor_hash, write_tensors

TENSORS = ("points", "configurations", "resolved", "edges", "connected", "wave", "reachable")
TABLES = ("neighbour_starts", "neighbour_ends", "uncertified_triangles", "uncertified_squares")


@pytest.fixture
def saved(planar_roadmap, tmp_path):
    path = tmp_path / "map.grr"
    planar_roadmap.save(path)
    return path


def header(path):
    with safe_open(path, framework="pt") as file:
        return dict(file.metadata())


def test_a_roadmap_comes_back_equal(planar_roadmap, saved):
    again = grr_torch.Roadmap.load(saved)
    for name in TENSORS:
        assert torch.equal(getattr(again, name).nan_to_num(9.9), getattr(planar_roadmap, name).nan_to_num(9.9))
    assert again.task == planar_roadmap.task
    assert again.parameters == planar_roadmap.parameters
    assert again.quality() == planar_roadmap.quality()


def test_the_robot_comes_back_whole(kinova, tmp_path, generator):
    robot = grr_torch.load_robot("kinova", held_joints={"joint_7": 0.3}, margin=0.01)
    seeds = [seed[:6] for seed in grr_torch.load_preset("kinova").problems["position"].seeds]
    grr_torch.build(robot, "position", points=100, seeds=seeds).save(tmp_path / "k.grr")
    again = grr_torch.Roadmap.load(tmp_path / "k.grr").robot
    q = robot.sample(50, generator)
    assert torch.equal(again.jacobian(q), robot.jacobian(q))
    assert torch.equal(again.self_collision_distance(q), robot.self_collision_distance(q))
    assert (again.margin, again.joint_names) == (0.01, robot.joint_names)
    assert torch.equal(again.lower, robot.lower)


def test_a_float32_roadmap_is_verified_as_such(tmp_path):
    robot = grr_torch.load_robot("planar_5", dtype=torch.float32)
    grr_torch.build(robot, "position", points=60).save(tmp_path / "f.grr")
    assert grr_torch.Roadmap.load(tmp_path / "f.grr").robot.dtype == torch.float32
    assert all(check.passed for check in verify_file(tmp_path / "f.grr"))


def test_it_loads_without_the_urdf(box_arm, tmp_path):
    robot = grr_torch.load_robot(box_arm)
    task, bounds = grr_torch.Position(3), [(-0.5, 0.5)] * 2 + [(0.2, 0.9)]
    grr_torch.build(robot, task, points=60, bounds=bounds, seeds=[[0.0, 1.0, 0.5]]).save(tmp_path / "b.grr")
    box_arm.unlink()
    assert grr_torch.Roadmap.load(tmp_path / "b.grr").robot.n == 3


def test_the_file_names_its_tensors_and_origin(saved):
    assert set(load_file(saved)) == {*TENSORS, *TABLES}
    metadata = {name: json.loads(value) for name, value in header(saved).items()}
    assert metadata["format_version"] == 4
    assert metadata["package_version"] == grr_torch.__version__
    assert metadata["robot"]["tool"] == "tool"
    assert len(metadata["robot"]["urdf_sha256"]) == 64
    assert metadata["quality"]["coverage"] == 1.0
    assert metadata["parameters"]["seed"] == 0


def test_an_untouched_file_is_verified(saved):
    assert all(check.passed for check in verify_file(saved))


@pytest.mark.parametrize("name", ["configurations", "connected", "points", "reachable", "wave"])
def test_edited_tensors_are_caught(saved, name):
    tensors, metadata = load_file(saved), header(saved)
    vertex = int(tensors["resolved"].nonzero()[3, 0])
    if name == "connected":
        tensors[name][int(tensors[name].nonzero()[0, 0])] = False
    elif name == "reachable":
        tensors[name][int((~tensors[name]).nonzero()[0, 0])] = True
    else:
        tensors[name][vertex] += 1
    save_file(tensors, saved, metadata=metadata)
    failed = {check.name for check in verify_file(saved) if not check.passed}
    assert "tensors" in failed
    if name == "configurations":
        assert {"quality", "residuals"} <= failed


def test_an_edited_quality_is_caught(saved):
    metadata = header(saved)
    metadata["quality"] = metadata["quality"].replace('"smoothness": ', '"smoothness": 0')
    edited = json.loads(header(saved)["quality"])
    metadata["quality"] = json.dumps({**edited, "smoothness": 1.0})
    save_file(load_file(saved), saved, metadata=metadata)
    assert {check.name for check in verify_file(saved) if not check.passed} == {"quality", "metadata"}


def damage(saved, how):
    tensors, metadata = load_file(saved), header(saved)
    if how == "truncated":
        saved.write_bytes(saved.read_bytes()[:-100])
        return
    if how == "text":
        saved.write_text("hello")
        return
    if how == "empty":
        saved.write_bytes(b"")
        return
    if how == "version":
        metadata["format_version"] = "99"
    elif how == "foreign":
        metadata = {}
    elif how == "metadata":
        metadata["robot"] = "{"
    elif how == "robot":
        metadata["robot"] = json.dumps({"name": "x"})
    elif how == "quality":
        metadata["quality"] = "{}"
    elif how == "parameters":
        del metadata["parameters"]
    elif how == "bound":
        metadata["parameters"] = json.dumps({**json.loads(metadata["parameters"]), "raised_slope": "steep"})
    elif how == "missing":
        del tensors["wave"]
    elif how == "short":
        tensors["resolved"] = tensors["resolved"][:-1]
    elif how == "dtype":
        tensors["points"] = tensors["points"].float()
    elif how == "table":
        tensors["uncertified_triangles"] = tensors["uncertified_triangles"][:, :2].contiguous()
    elif how == "columns":
        tensors["configurations"] = tensors["configurations"][:, :3].contiguous()
    save_file(tensors, saved, metadata=metadata)


DAMAGES = {
    "truncated": "truncated",
    "text": "truncated or not a roadmap",
    "empty": "truncated or not a roadmap",
    "version": "format version 99; this version reads 4",
    "foreign": "not a roadmap of grr-torch",
    "metadata": "cannot be read",
    "robot": "metadata without .urdf_directory.",
    "quality": "lacks the quality figures",
    "parameters": "metadata without 'parameters'",
    "bound": "'raised_slope' is no number above 0",
    "missing": "lacks the tensors wave",
    "short": "'resolved' has",
    "dtype": "'points' is torch.float32",
    "columns": "rows of",
    "table": "'uncertified_triangles' has rows of 2, not 3",
}


@pytest.mark.parametrize("how", DAMAGES)
def test_a_damaged_file_is_a_clear_error(saved, how):
    damage(saved, how)
    with pytest.raises(FileFormatError, match=DAMAGES[how]) as caught:
        grr_torch.Roadmap.load(saved)
    assert caught.value.path == saved


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("configurations", torch.nan, "without a finite configuration"),
        ("points", torch.inf, "points that are not finite"),
        ("wave", -1, "waves that do not fit"),
    ],
)
def test_contents_that_contradict_each_other_are_found_when_asked_for(saved, name, value, reason):
    tensors, metadata = load_file(saved), header(saved)
    tensors[name][int(tensors["resolved"].nonzero()[0, 0])] = value
    save_file(tensors, saved, metadata=metadata)
    checks = {check.name: check for check in verify_file(saved)}
    assert reason in checks["contents"].detail
    assert {name for name, check in checks.items() if not check.passed} == {"tensors", "contents"}
    assert name in checks["tensors"].detail


@pytest.mark.parametrize("name", ["edges", "neighbour_starts", "neighbour_ends", "uncertified_triangles"])
@pytest.mark.parametrize("value", [-1, 1_000_000])
def test_vertices_that_are_not_there_are_found_when_a_file_is_opened(saved, name, value):
    tensors, metadata = load_file(saved), header(saved)
    tensors[name][0] = value
    save_file(tensors, saved, metadata=metadata)
    with pytest.raises(FileFormatError, match=f"tensor '{name}' has entries from"):
        grr_torch.Roadmap.load(saved)


@pytest.mark.parametrize("name", ["neighbour_ends", "uncertified_triangles"])
def test_edited_tables_are_caught(saved, name):
    tensors, metadata = load_file(saved), header(saved)
    tensors[name] = tensors[name].flip(0)
    save_file(tensors, saved, metadata=metadata)
    assert {check.name for check in verify_file(saved) if not check.passed} == {"tensors", "tables"}


def test_a_file_is_mapped_not_read(saved):
    last = grr_torch.Roadmap.load(saved).resolved[-1:]
    before = bool(last)
    with saved.open("r+b") as file:
        file.seek(-1, 2)
        file.write(bytes([not before]))
    assert bool(last) is not before, "what changes in the file changes in the tensor"


def test_a_loaded_map_solves_as_the_one_that_was_saved(planar_roadmap, saved, generator):
    points = 1.2 * (torch.rand(500, 2, dtype=torch.float64, generator=generator) - 0.5)
    again = grr_torch.Roadmap.load(saved)
    first, second = planar_roadmap.solve(points), again.solve(points)
    assert torch.equal(first.configurations.nan_to_num(9.9), second.configurations.nan_to_num(9.9))
    assert (first.status == second.status).all()
    assert "_measured" not in vars(again) or "cells" not in vars(again)["_measured"], "no cell was measured for it"


def test_parsing_no_xml_gives_the_same_urdf(box_arm):
    for robot in (grr_torch.load_robot("kinova"), grr_torch.load_robot(box_arm)):
        urdf = robot.urdf
        again = urdf_from_json(
            json.loads(json.dumps(urdf_to_json(urdf))), text=urdf.text, directory=urdf.directory, package_dirs=[]
        )
        assert urdf_to_json(again) == urdf_to_json(urdf)
        assert (again.links, again.root, again.leaves()) == (urdf.links, urdf.root, urdf.leaves())


@pytest.mark.parametrize("shape", [(0,), (0, 3), (5,), (4, 7), (3, 0)])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.int64, torch.int32, torch.uint8, torch.bool])
def test_what_is_written_is_what_the_library_reads(tmp_path, generator, shape, dtype):
    tensor = (10.0 * torch.rand(shape, generator=generator)).to(dtype)
    tensors = {"a": tensor, "turned": tensor.T if tensor.ndim == 2 else tensor.flip(0), "b": torch.ones(3).bool()}
    write_tensors(tmp_path / "t.safetensors", tensors, {"key": "välue"})
    assert header(tmp_path / "t.safetensors") == {"key": "välue"}
    for again in (load_file(tmp_path / "t.safetensors"), read_tensors(tmp_path / "t.safetensors", "tensors")[1]):
        assert all(torch.equal(again[name], tensor) for name, tensor in tensors.items())
    assert tensor_hash(tensors["turned"]) == tensor_hash(again["turned"])


def test_a_missing_file_is_a_clear_error(tmp_path):
    with pytest.raises(FileFormatError, match="none.grr: does not exist"):
        grr_torch.Roadmap.load(tmp_path / "none.grr")
    with pytest.raises(FileFormatError, match="is not a regular file"):
        grr_torch.Roadmap.load(tmp_path)


def test_networkx_gets_the_resolved_part(planar_roadmap):
    graph = planar_roadmap.to_networkx()
    assert graph.number_of_nodes() == int(planar_roadmap.resolved.sum())
    assert graph.number_of_edges() == int(planar_roadmap.connected.sum())
    node = next(iter(graph.nodes))
    np.testing.assert_array_equal(graph.nodes[node]["configuration"], planar_roadmap.configurations[node].numpy())
    slopes = [data["configuration_distance"] / data["point_distance"] for *_, data in graph.edges(data=True)]
    assert np.mean(slopes) == pytest.approx(planar_roadmap.quality().smoothness)


def test_maps_go_by_the_same_name_whether_or_not_they_know_what_is_reachable(planar_5):
    plain, asked = (grr_torch.build(planar_5, "position", points=100, reachability=tries) for tries in (0, 5))
    assert plain.reachable is None
    assert asked.reachable is not None
    assert roadmap_hash(plain) == roadmap_hash(asked)
    other = grr_torch.build(planar_5, "position", points=100, refine=False)
    assert roadmap_hash(other) != roadmap_hash(plain)


def test_numbers_of_numpy_are_saved_as_numbers(tmp_path):
    robot = grr_torch.load_robot("planar_5", held_joints={"joint_2": np.float32(0.5)})
    numbers = {"max_slope": np.float32(50.0), "tolerances": Tolerances(position=np.float32(1e-4))}
    roadmap = grr_torch.build(robot, "position", points=40, refine=False, **numbers)
    roadmap.save(tmp_path / "map.grr")
    again = grr_torch.Roadmap.load(tmp_path / "map.grr")
    assert again.robot.held_joints == {"joint_2": 0.5}
    assert again.parameters["max_slope"] == 50.0
