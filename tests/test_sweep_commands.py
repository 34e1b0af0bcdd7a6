"""The commands of fleets: what they say, and how they end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time

import pytest
from command_line import PROGRAM
from grr_torch.cli.main import app
from test_sweep import FLEET, SMALL, stamps
from typer.testing import CliRunner

from grr_torch.fleet.catalogue import read_catalogue, write_catalogue
from grr_torch.fleet.sweep import read_sweep


def test_the_commands_say_what_they_did(tmp_path):
    folder = tmp_path / "out"
    (tmp_path / "s.yaml").write_text(SMALL + "builds: [{points: 40}]")
    built = CliRunner().invoke(app, ["sweep", str(tmp_path / "s.yaml")])
    assert built.exit_code == 0, built.output
    assert "1 of 1 roadmaps, 1 of them built now" in built.output
    (tmp_path / "sweep.yaml").write_text(FLEET)
    words = ["sweep", str(tmp_path / "sweep.yaml"), "--out", str(folder)]
    first = CliRunner().invoke(app, words)
    assert first.exit_code == 1
    assert "3 of 4 roadmaps, 3 of them built now" in first.output
    assert "no point within reach" in first.stderr
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 1
    assert "3 of 4 roadmaps, 0 of them built now" in again.output
    shown = CliRunner().invoke(
        app, ["catalogue", str(folder), "--best", "smoothness", "--per", "orientation", "--per", "task", "--json"]
    )
    rows = json.loads(shown.stdout)["roadmaps"]
    assert {(row["task"], row["orientation"]) for row in rows} == {
        ("position", "any"),
        ("fixed-rotation", "rotation 0 0 0"),
    }
    table = CliRunner().invoke(app, ["catalogue", str(folder)])
    assert table.stdout.count("\n| ") == len(write_catalogue(folder)) + 1


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("sweep none.yaml", "none.yaml: does not exist"),
        ("sweep s.yaml --engine rey", "unknown engine 'rey'. Did you mean 'ray'?"),
        ("sweep s.yaml --address auto", "none without --engine ray"),
        ("sweep s.yaml --out s.yaml", "--out: got s.yaml; valid: a folder"),
        ("build --robot planar_5 --engine rey", "unknown engine 'rey'. Did you mean 'ray'?"),
        ("build --robot planar_5 --address auto", "none without --engine ray"),
        ("build --robot planar_5 --engine ray --device cuda", "cpu with --engine ray"),
        ("catalogue none", "none: is not a folder"),
        ("catalogue . --best smothness", "Did you mean 'smoothness'?"),
        ("catalogue . --per task", "none without --best"),
        ("catalogue .", "DIR: got .; valid: a folder of `grr-torch sweep`"),
    ],
)
def test_a_mistake_ends_with_exit_code_2(tmp_path, monkeypatch, words, complaint):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.yaml").write_text(SMALL + "builds: [{points: 40}]")
    result = CliRunner().invoke(app, words.split())
    assert result.exit_code == 2
    assert complaint in result.stderr
    assert result.stdout == ""
    assert [path.name for path in tmp_path.iterdir()] == ["s.yaml"]


@pytest.mark.parametrize("command", [["sweep"], ["catalogue"], ["bench", "cluster"]])
def test_help_has_an_example(command):
    result = CliRunner().invoke(app, [*command, "--help"])
    assert result.exit_code == 0
    assert f"Example: grr-torch {' '.join(command)}" in result.stdout


def test_ctrl_c_ends_with_130_and_the_next_run_goes_on(tmp_path):
    (tmp_path / "s.yaml").write_text(SMALL + f"grid: {{seed: {list(range(3000))}}}")
    process = subprocess.Popen(
        [*PROGRAM, "sweep", "s.yaml", "--out", "out"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "COLUMNS": "200"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    while len(stamps(tmp_path / "out")) < 3 and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "the same command goes on from there" in errors
    assert "Traceback" not in errors
    done = stamps(tmp_path / "out")
    assert len(read_catalogue(tmp_path / "out")) == len(done) >= 3
    assert not list((tmp_path / "out").glob(".*partial*"))
    assert set(done) <= {f"{order.hash}.grr" for order in read_sweep(tmp_path / "s.yaml")}
