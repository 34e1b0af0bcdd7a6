"""The command line as a person uses it: each test starts the program anew."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from command_line import run
from grr_torch.cli.main import join_numbers

import grr_torch

QUALITY = {
    "vertices",
    "edges",
    "resolved_vertices",
    "reachable_vertices",
    "coverage",
    "connected_edges",
    "reachable_edges",
    "connectivity",
    "resolved_edges",
    "connectivity_resolved",
    "smoothness",
    "smoothness_median",
    "smoothness_p99",
    "smoothness_max",
    "steep_edges",
    *(f"{shape}{figure}" for shape in ("triangles", "squares") for figure in ("", "_wound", "_spread", "_certified")),
    "max_position_error",
    "max_rotation_error",
    "min_self_collision_distance",
    "self_collisions",
    "joint_limit_violations",
}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder = tmp_path_factory.mktemp("built")
    return folder, run("build", "--robot", "planar_5", "--points", 200, "--reachability", 4, "--json", cwd=folder)


def test_build_writes_a_roadmap_and_a_recording_and_prints_one_object(built):
    folder, result = built
    assert result.returncode == 0, result.stderr
    data = json.loads(result.stdout)
    assert set(data) == QUALITY | {"parts", "bounds", "build_seconds", "refinement", "out", "record"}
    assert (data["out"], data["record"]) == ("planar_5.grr", "planar_5.rrd")
    assert sorted(path.name for path in folder.iterdir()) == ["planar_5.grr", "planar_5.rrd"]
    stored = grr_torch.Roadmap.load(folder / "planar_5.grr").quality().to_dict()
    assert {name: data[name] for name in QUALITY} == pytest.approx(stored)


def test_info_shows_verifies_and_speaks_json(built):
    folder, _ = built
    shown = run("info", "planar_5.grr", cwd=folder)
    assert shown.returncode == 0
    assert "connectivity" in shown.stdout
    verified = run("info", "planar_5.grr", "--verify", "--json", cwd=folder)
    data = json.loads(verified.stdout)
    assert data["verified"] is True
    assert set(data) >= QUALITY | {"parts"}


def test_info_verify_catches_an_edited_file(built, tmp_path):
    from safetensors.torch import load_file, save_file
    from test_roadmap_file import header

    source, copy = built[0] / "planar_5.grr", tmp_path / "edited.grr"
    tensors = load_file(source)
    tensors["configurations"] += 1e-3
    save_file(tensors, copy, metadata=header(source))
    result = run("info", copy, "--verify", cwd=tmp_path)
    assert result.returncode == 2
    assert "not consistent with itself: tensors, quality" in result.stderr
    assert "Traceback" not in result.stderr


def test_view_saves_a_recording(built, tmp_path):
    result = run("view", built[0] / "planar_5.grr", "--save", tmp_path / "v.rrd", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "v.rrd").stat().st_size > 10_000


def test_view_without_a_screen_says_so(built, tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    if sys.platform != "linux":
        pytest.skip("the screen is told from the environment on Linux only")
    result = run("view", built[0] / "planar_5.grr", cwd=tmp_path)
    assert result.returncode == 2
    assert result.stderr == "error: there is no screen to open the rerun viewer on; write a file with --save F.rrd\n"


def test_robots_lists_the_bundled_ones(tmp_path):
    assert set(json.loads(run("robots", "--json", cwd=tmp_path).stdout)) == {"kinova", "planar_3", "planar_5"}
    assert "fixed-rotation (default): 3,100 points" in run("robots", cwd=tmp_path).stdout


def test_a_robot_never_seen_before_is_built_from_its_urdf(box_arm, tmp_path):
    (tmp_path / "seeds.csv").write_text("0.1, 1.0, 0.5\n2.0, 1.5, 0.2\n")
    words = "--task position --points 80 --bounds -0.6 0.6 -0.6 0.6 0.2 1.0 --base base --tool tip"
    result = run(
        "build",
        "--robot",
        box_arm,
        *words.split(),
        "--seeds",
        "seeds.csv",
        "--margin",
        "0.01",
        "--no-record",
        cwd=tmp_path,
    )
    assert result.returncode == 0, result.stderr
    roadmap = grr_torch.Roadmap.load(tmp_path / "box_arm.grr")
    assert roadmap.robot.joint_names == ("turn", "elbow", "wrist")
    assert bool(roadmap.resolved.any())
    assert roadmap.robot.margin == 0.01
    assert not (tmp_path / "box_arm.rrd").exists()


def test_joints_are_held(tmp_path):
    (tmp_path / "seeds.txt").write_text("0.1 0.2 0.2 0.2\n")
    words = "--robot planar_5 --hold joint_5=0.25 --points 100 --no-record --seeds seeds.txt"
    result = run("build", *words.split(), cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    robot = grr_torch.Roadmap.load(tmp_path / "planar_5.grr").robot
    assert (robot.n, robot.held_joints) == (4, {"joint_5": 0.25})


def test_a_rotation_is_taken(tmp_path):
    words = "--robot planar_5 --task fixed-rotation --rotation 0 0 1.2 --points 100 --no-record --json"
    result = run("build", *words.split(), cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert grr_torch.Roadmap.load(tmp_path / "planar_5.grr").task.rpy == (0.0, 0.0, 1.2)


def test_spheres_are_fitted_and_used(box_arm, tmp_path):
    fitted = run("spheres", box_arm, "--out", "s.yaml", "--spheres", 3, "--starts", 0, "--samples", 300, cwd=tmp_path)
    assert fitted.returncode == 0, fitted.stderr
    assert "hand – upper" in fitted.stdout
    robot = grr_torch.load_robot(box_arm, spheres=tmp_path / "s.yaml")
    assert robot.spheres.checked


@pytest.mark.parametrize(
    "command",
    ["", "build", "info", "view", "solve", "plan", "teleop", "smm", "robots", "spheres", "export", "bench devices"],
)
def test_help_has_an_example(tmp_path, command):
    result = run(*command.split(), "--help", cwd=tmp_path)
    assert result.returncode == 0
    assert "grr-torch" in result.stdout
    assert not command or "Example:" in result.stdout


def test_help_imports_nothing_heavy(tmp_path):
    heavy = ("torch", "numpy", "rerun", "trimesh", "viser")
    code = f"import sys, grr_torch.cli.main; print([m for m in {heavy} if m in sys.modules])"
    result = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"


def test_the_numbers_after_bounds_become_one_argument(tmp_path, monkeypatch):
    assert join_numbers(["build", "--bounds", "-1", "1", "-2e-1", ".5", "--points", "3"]) == [
        "build", "--bounds=-1 1 -2e-1 .5", "--points", "3",
    ]  # fmt: skip
    assert join_numbers(["--start", "0", "-1", "--goal", "2", "3", "--smooth"]) == [
        "--start=0 -1",
        "--goal=2 3",
        "--smooth",
    ]
    assert join_numbers(["--bounds", "-1 1 0 2"]) == ["--bounds", "-1 1 0 2"]
    assert join_numbers(["solve", "--point", "0.1", ""]) == ["solve", "--point=0.1 "]
    assert join_numbers(["--point=0.4", "0.2", "-.3", "r.grr"]) == ["--point=0.4 0.2 -.3", "r.grr"]
    assert join_numbers(["--bounds=-1 1 0 2", "--hold", "a=1", "--rotation=0", "1", "2"]) == [
        "--bounds=-1 1 0 2",
        "--hold",
        "a=1",
        "--rotation=0 1 2",
    ]
    # a map may have any name, once it is there
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rr").touch()
    words = ["--start", "0.3", "0", "--goal", "0", "0.3", "rr", "--out", "p.csv"]
    assert join_numbers(words) == ["--start=0.3 0", "--goal=0 0.3", "rr", "--out", "p.csv"]
