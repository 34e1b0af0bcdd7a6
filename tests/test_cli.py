"""The command line as a person uses it: each test starts the program anew."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import pytest
import torch
import typer
from grr_torch.cli.main import join_bounds
from grr_torch.cli.show import reports_errors

import grr_torch

PROGRAM = [sys.executable, "-P", "-m", "grr_torch.cli.main"]
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


def run(*arguments, cwd):
    environment = {**os.environ, "COLUMNS": "200"}
    words = [str(argument) for argument in arguments]
    return subprocess.run([*PROGRAM, *words], cwd=cwd, capture_output=True, text=True, env=environment, check=False)


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
    ("words", "complaint"),
    [
        ("build --robot kinva", "unknown robot 'kinva'. Did you mean 'kinova'?"),
        ("build --robot none.urdf", "none.urdf: cannot be read"),
        ("build --robot empty.urdf", "empty.urdf: is empty"),
        ("build --robot planar_5 --tool hand", "unknown link 'hand'. Known: base_link"),
        ("build --robot planar_5 --base link_9", "unknown link 'link_9'"),
        ("build --robot planar_5 --task rotate", "Did you mean 'fixed-rotation'? Known: position"),
        ("build --robot planar_5 --points 0", "points: got 0"),
        ("build --robot planar_5 --points 99999999999", "points: got 99999999999"),
        ("build --robot planar_5 --bounds 1 -1 0 1", "low < high"),
        ("build --robot planar_5 --bounds 1 nan 0 1", "low < high"),
        ("build --robot planar_5 --bounds 0 1 0", "four or six numbers"),
        ("build --robot planar_5 --bounds 8 9 8 9", "no point within reach"),
        ("build --robot planar_5 --seeds none.csv", "none.csv: cannot be read"),
        ("build --robot planar_5 --seeds short.csv", "valid: (S, 5)"),
        ("build --robot planar_5 --seeds nan.csv", "seeds 0 hold NaN"),
        ("build --robot planar_5 --seeds words.csv", "is not a table of numbers"),
        ("build --robot planar_5 --hold joint_1", "JOINT=VALUE"),
        ("build --robot planar_5 --hold elbow=1", "unknown joint 'elbow'"),
        ("build --robot planar_5 --margin -1", "margin: got -1.0"),
        ("build --robot planar_5 --device tpu9", "device: got tpu9"),
        ("build --robot planar_5 --out no/such/f.grr", "folder 'no/such' does not exist"),
        ("build --robot planar_5 --out .", "it is a folder"),
        ("build --robot planar_5 --task position --rotation 0 0 1", "none for the task 'position'"),
        ("build --robot kinova --rotation 0 3,14 0,2", "--rotation: got '0 3,14 0,2'; valid: 3 finite numbers"),
        ("build --robot kinova --rotation 0 0 pi/2", "--rotation: got '0 0 pi/2'; valid: 3 finite numbers"),
        ("build --robot kinova --rotation 0 0 -pi", "--rotation: got '0 0 -pi'; valid: 3 finite numbers"),
        ("smm --robot planar_3 --point 0.1 y", "--point: got '0.1 y'"),
        ("build --robot kinova --rotation 0 3.14", "--rotation: got '0 3.14'; valid: 3 finite numbers: roll pitch yaw"),
        ("build --robot kinova --task axis --axis 0 z 1", "--axis: got '0 z 1'; valid: 3 finite numbers: x y z"),
        ("build --robot kinova --spheres words.csv", "is not a sphere file"),
        ("build --robot planar_5 --reachability -3", "reachability: got -3"),
        ("build --robot planar_5 --seeds short.csv --out short.csv", "another file than those that are read"),
        ("build --robot planar_5 --out fifo", "not a regular file"),
        ("build --robot fifo", "fifo: is not a regular file"),
        ("build --robot xacro.urdf", "is xacro, not URDF"),
        ("build --robot doctype.urdf", "has a DOCTYPE"),
        ("build --robot planar_5 --hold joint_1=0 --hold joint_1=1", "one value for 'joint_1'"),
        ("build --robot planar_5 --bounds -1e300 1e300 0 1", "low < high"),
        ("build --robot planar_5 --seed 99999999999999999999", "seed: got 99999999999999999999"),
        ("build --robot planar_5 --seeds gap.csv", "is not a table of numbers"),
        ("build --robot planar_5 --reachability 99999999", "reachability: got 99999999"),
        ("build --robot planar_5 --out x.rrd", "--record: got x.rrd; valid: another file than that of --out"),
        ("build --robot planar_5 --seed -1", "Invalid value for '--seed'"),
        ("info none.grr", "none.grr: is not a file"),
        ("info words.csv", "truncated or not a roadmap"),
        ("view words.csv --save x.rrd", "truncated or not a roadmap"),
        ("view words.csv --save words.csv", "--save: got words.csv; valid: another file than those that are read"),
        ("smm --roadmap words.csv --record ./words.csv", "--record: got words.csv; valid: another file than those"),
        ("smm --roadmap words.csv --out words.csv", "--out: got words.csv; valid: another file than those"),
        ("bench learning words.csv --json words.csv", "--json: got words.csv; valid: another file than those"),
        ("bench scale --plot a.png --json a.png", "--json: got a.png; valid: another file than that of --plot"),
        ("export words.csv --out words.csv", "--out: got words.csv; valid: another file than those"),
        ("train-ik words.csv --out words.csv", "--out: got words.csv; valid: another file than those"),
        ("export-ik words.csv --onnx words.csv", "--onnx: got words.csv; valid: another file than those"),
        ("spheres words.csv --out words.csv", "--out: got words.csv; valid: another file than those"),
        ("bench teleop --paths words.csv", "words.csv: cannot be read as npz: it is none, or has objects in it"),
        ("spheres none.urdf --out s.yaml", "none.urdf: cannot be read"),
        ("build", "Missing option"),
        ("solve --point 0.1 0.3 rr", "Missing argument 'FILE.grr'"),
        ("bild", "No such command"),
    ],
)
def test_a_mistake_is_one_clear_line_and_exit_code_2(tmp_path, words, complaint):
    (tmp_path / "empty.urdf").touch()
    (tmp_path / "short.csv").write_text("0 0 0")
    (tmp_path / "nan.csv").write_text("0 0 0 0 nan")
    (tmp_path / "words.csv").write_text("no numbers here")
    (tmp_path / "gap.csv").write_text("0.5,,0.5,0.5,0.5,0.5")
    (tmp_path / "xacro.urdf").write_text('<robot name="r" xmlns:xacro="x/xacro"><xacro:macro name="m"/></robot>')
    (tmp_path / "doctype.urdf").write_text('<!DOCTYPE r [<!ENTITY a "b">]><robot name="r"><link name="a"/>&a;</robot>')
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    os.mkfifo(tmp_path / "fifo")
    result = run(*words.split(), cwd=tmp_path)
    assert result.returncode == 2
    assert complaint in result.stderr
    assert "Traceback" not in result.stderr
    assert result.stdout == ""
    if result.stderr.startswith("error: "):
        assert result.stderr.count("\n") == 1
    assert {path: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == before


def test_ctrl_c_leaves_no_file(tmp_path):
    words = ["build", "--robot", "kinova", "--reachability", "100000"]
    process = subprocess.Popen(
        [*PROGRAM, *words],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        # a shell's background jobs ignore the signal, and so would their children
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    time.sleep(9)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in errors
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "command",
    ["", "build", "info", "view", "solve", "plan", "teleop", "smm", "robots", "spheres", "export", "bench devices"],
)
def test_help_has_an_example(tmp_path, command):
    result = run(*command.split(), "--help", cwd=tmp_path)
    assert result.returncode == 0
    assert "grr-torch" in result.stdout
    assert not command or "Example:" in result.stdout


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20 GiB.\nMore."), "Tried to allocate 20 GiB.\n"),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory"), "can't allocate memory"),
        (MemoryError(), "MemoryError"),
    ],
)
def test_a_full_memory_is_one_clear_line(capsys, error, said):
    @reports_errors
    def command():
        raise error

    with pytest.raises(typer.Exit) as caught:
        command()
    assert caught.value.exit_code == 2
    message = capsys.readouterr().err
    assert message.startswith("error: the memory is full")
    assert said in message


def test_another_error_of_torch_is_not_hidden():
    @reports_errors
    def command():
        raise RuntimeError("mixed devices")

    with pytest.raises(RuntimeError, match="mixed"):
        command()


def test_help_imports_nothing_heavy(tmp_path):
    heavy = ("torch", "numpy", "rerun", "trimesh", "viser")
    code = f"import sys, grr_torch.cli.main; print([m for m in {heavy} if m in sys.modules])"
    result = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"


def test_the_numbers_after_bounds_become_one_argument(tmp_path, monkeypatch):
    assert join_bounds(["build", "--bounds", "-1", "1", "-2e-1", ".5", "--points", "3"]) == [
        "build", "--bounds=-1 1 -2e-1 .5", "--points", "3",
    ]  # fmt: skip
    assert join_bounds(["--start", "0", "-1", "--goal", "2", "3", "--smooth"]) == [
        "--start=0 -1",
        "--goal=2 3",
        "--smooth",
    ]
    assert join_bounds(["--bounds", "-1 1 0 2"]) == ["--bounds", "-1 1 0 2"]
    assert join_bounds(["solve", "--point", "0.1", ""]) == ["solve", "--point=0.1 "]
    # a map may have any name, once it is there
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rr").touch()
    words = ["--start", "0.3", "0", "--goal", "0", "0.3", "rr", "--out", "p.csv"]
    assert join_bounds(words) == ["--start=0.3 0", "--goal=0 0.3", "rr", "--out", "p.csv"]
