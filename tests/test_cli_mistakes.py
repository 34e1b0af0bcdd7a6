"""The command line when something is wrong: one clear line, and no file is left or lost."""

from __future__ import annotations

import os
import signal
import subprocess
import time

import pytest
import torch
import typer
from command_line import PROGRAM, run
from grr_torch.cli.show import reports_errors


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
        (
            "build --robot planar_5 --bounds 1 nan 0 1",
            "--bounds: got '1 nan 0 1'; valid: four or six numbers, all finite",
        ),
        ("build --robot planar_5 --bounds 0 1 0", "four or six numbers"),
        ("build --robot planar_5 --bounds 8 9 8 9", "no point within reach"),
        ("build --robot planar_5 --seeds none.csv", "none.csv: does not exist"),
        ("build --robot planar_5 --seeds short.csv", "short.csv: has 3 columns; valid: 5, or columns named joint_1"),
        ("build --robot planar_5 --seeds nan.csv", "nan.csv: row 1 holds NaN, infinite or missing values"),
        ("build --robot planar_5 --seeds words.csv", "words.csv: has 3 columns; valid: 5, or columns named joint_1"),
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
        ("build --robot planar_5 --seeds gap.csv", "gap.csv: row 1 holds NaN, infinite or missing values"),
        ("build --robot planar_5 --reachability 99999999", "reachability: got 99999999"),
        ("build --robot planar_5 --out x.rrd", "--record: got x.rrd; valid: another file than that of --out"),
        ("build --robot planar_5 --method random --seeds auto", 'seeds: got auto; valid: none with method "random"'),
        ("build --robot planar_5 --seed -1", "Invalid value for '--seed'"),
        ("info none.grr", "none.grr: does not exist"),
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
    (tmp_path / "gap.csv").write_text("0.5,,0.5,0.5,0.5")
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
