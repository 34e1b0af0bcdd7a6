"""The commands on spaces in which rotation varies."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from grr_torch.cli.main import app, join_numbers
from typer.testing import CliRunner

import grr_torch


def run(*words: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, join_numbers([str(word) for word in words]))
    return result.exit_code, result.output


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A small roadmap of poses in the plane, and what `build` printed."""
    folder = tmp_path_factory.mktemp("pose")
    words = ("--robot", "planar_5", "--task", "pose", "--points", 100, "--rotations", 6, "--out", folder / "map.grr")
    code, output = run("build", *words, "--json")
    assert code == 0, output
    return folder, json.loads(output)


def test_build_info_and_robots_tell_of_rotations(built):
    folder, figures = built
    roadmap = grr_torch.Roadmap.load(folder / "map.grr")
    assert figures["vertices"] == len(roadmap.points) == 6 * len(roadmap.graph.positions.points)
    assert (folder / "map.rrd").stat().st_size > 0
    code, output = run("info", folder / "map.grr", "--verify")
    assert code == 0
    assert "6 rotations (yaw)" in output
    assert "NOT verified" not in output
    assert "× 8 rotations" in run("robots")[1]


def test_points_are_solved_by_the_names_of_their_columns(built):
    folder, _ = built
    with (folder / "points.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["yaw", "note", "y", "x"])
        writer.writerow([0.3, 7, 0.1, 0.2])
    code, output = run("solve", folder / "map.grr", "--points", folder / "points.csv", "--out", folder / "joints.csv")
    assert code == 0, output
    (row,) = csv.DictReader((folder / "joints.csv").open())
    assert (float(row["x"]), float(row["y"]), float(row["yaw"])) == (0.2, 0.1, 0.3)
    assert row["valid"] == "true"
    joints = [float(row[f"joint_{k}"]) for k in range(1, 6)]
    assert np.angle(np.exp(1j * (sum(joints) - 0.3))) == pytest.approx(0.0, abs=2e-3)
    code, output = run("solve", folder / "map.grr", "--point", 0.2, 0.1, 0.3, "--json")
    assert json.loads(output)["points"][0]["valid"]
    code, output = run("solve", folder / "map.grr", "--point", 0.2, 0.1)
    assert code == 2
    assert "3 finite numbers: x y yaw" in output


def test_a_plan_turns_the_tool_and_is_recorded(built):
    folder, _ = built
    ends = ("--start", 0.2, 0.1, 0.0, "--goal", 0.1, 0.2, 1.5)
    files = ("--out", folder / "path.npz", "--record", folder / "path.rrd")
    code, output = run("plan", folder / "map.grr", *ends, *files)
    assert code == 0, output
    with np.load(folder / "path.npz") as path:
        assert path["points"].shape[1] == 3
        assert path["points"][-1].tolist() == pytest.approx([0.1, 0.2, 1.5])
    assert (folder / "path.rrd").stat().st_size > 0


def test_the_manifold_of_a_pose_is_sampled():
    words = ("--robot", "planar_5", "--task", "pose", "--point", 0.2, 0.1, 0.5, "--samples", 40, "--json")
    code, output = run("smm", *words)
    assert code == 0, output
    assert json.loads(output)["points"][0]["dimension"] == 2


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("build", "--robot", "planar_5", "--task", "pose", "--rotations", 0), "a whole number from 1"),
        (("build", "--robot", "planar_5", "--task", "position", "--rotations", 4), "does not vary"),
        (("build", "--robot", "kinova", "--task", "axis", "--axis", 0, 0, 0), "not all zero"),
        (("build", "--robot", "kinova", "--task", "pose", "--axis", 0, 0, 1), "which has none"),
        (("build", "--robot", "kinova", "--task", "yaw", "--neighbours", 9), "1 to 3 edges"),
        (("smm", "--robot", "kinova", "--task", "axis", "--point", 0.3, 0, 0.3, 0, 0, 0), "direction"),
        (("smm", "--robot", "kinova", "--task", "pose", "--point", 0.3, 0, 0.3, 0, 0, 0, 0), "quaternion"),
        (("bench", "rotations", "--problem", "planar_5 axis"), "unknown problem"),
    ],
)
def test_a_mistake_is_one_clear_line_and_exit_code_2(words, complaint, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, output = run(*words)
    assert code == 2
    assert complaint in output
    assert "Traceback" not in output
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("path", ["circle", "line"])
def test_a_path_is_replayed_and_recorded(built, path, tmp_path):
    words = ("--path", path, "--record", tmp_path / "t.rrd", "--out", tmp_path / "t.npz", "--json")
    code, output = run("teleop", built[0] / "map.grr", *words)
    assert code == 0, output
    summary = json.loads(output)
    assert summary["shares"]["tracking"] > 0.9
    assert summary["final_deviation"] < 1e-3
    assert summary["final_turn"] < 1e-2
    assert (tmp_path / "t.rrd").stat().st_size > 10_000
    assert np.load(tmp_path / "t.npz")["targets"].shape[1] == 3


def test_the_comparison_of_teleoperation_says_that_it_does_not_turn(built):
    code, output = run("bench", "teleop", built[0] / "map.grr")
    assert code == 2
    assert "do not turn" in output


def test_bench_prints_a_row_of_measured_figures(tmp_path):
    words = ("--problem", "planar_5 pose", "--points", 40, "--rotations", 4, "--json", tmp_path / "table.json")
    code, output = run("bench", "rotations", *words)
    assert code == 0, output
    (row,) = json.loads((tmp_path / "table.json").read_text())["roadmaps"]
    assert row["vertices"] == row["positions"] * row["rotations"]
    assert row["seconds"] > 0.0
    assert row["memory"] > 50.0
    assert f"{row['positions']} × 4" in output
