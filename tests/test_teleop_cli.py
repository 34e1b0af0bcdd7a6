"""`grr-torch teleop`: replays, mistakes, and a live session that is ended."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
import urllib.request

import numpy as np
import pytest
from command_line import PROGRAM
from grr_torch.cli.main import app
from test_teleop import entities
from typer.testing import CliRunner

from grr_torch.applications.teleoperate import Teleoperator
from grr_torch.errors import MissingPackageError
from grr_torch.experiments.paths import draw_paths
from grr_torch.interactive.session import Session


@pytest.fixture(scope="module")
def file(planar_roadmap, tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "map.grr"
    planar_roadmap.save(path)
    return path


def invoke(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


def test_the_command_replays_records_and_sums_up(file, tmp_path):
    result = invoke("teleop", file, "--path", "circle", "--record", tmp_path / "c.rrd", "--out", tmp_path / "c.npz")
    assert result.exit_code == 0, result.output
    for words in ("tracking", "largest joint step", "longest stall", "smallest clearance", "c.rrd", "c.npz"):
        assert words in result.output
    assert "/status" in entities(tmp_path / "c.rrd")
    with np.load(tmp_path / "c.npz", allow_pickle=False) as data:
        np.savetxt(tmp_path / "again.csv", data["targets"][:100], delimiter=",")
        first = data["configurations"][:100]
    again = invoke("teleop", file, "--path", tmp_path / "again.csv", "--out", tmp_path / "again.npy", "--json")
    assert again.exit_code == 0, again.output
    assert json.loads(again.stdout)["steps"] >= 100
    assert np.allclose(np.load(tmp_path / "again.npy", allow_pickle=False)[:100], first, atol=1e-9)


def test_foresight_is_that_of_the_teleoperator(kinova_roadmap, tmp_path):
    kinova_roadmap.save(tmp_path / "kinova.grr")
    # through the robot's base
    targets = draw_paths(kinova_roadmap, "line_self", 1, seed=3)[0]
    np.savetxt(tmp_path / "line.csv", targets, delimiter=",")
    led = {}
    for foresight in (0.0, 2.0):
        options = {"path": tmp_path / "line.csv", "max-step": 0.04, "foresight": foresight, "out": tmp_path / "q.npy"}
        words = [word for name, value in options.items() for word in (f"--{name}", value)]
        result = invoke("teleop", tmp_path / "kinova.grr", *words)
        assert result.exit_code == 0, result.output
        arm = Teleoperator(kinova_roadmap, max_step=0.04, foresight=foresight)
        led[foresight] = np.stack([arm.step(target).configuration.numpy() for target in targets])
        replayed = np.load(tmp_path / "q.npy", allow_pickle=False)
        assert np.allclose(replayed[: len(targets)], led[foresight], atol=1e-9)
    assert np.abs(led[2.0] - led[0.0]).max() > 0.1


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("MAP --path none.csv", "none.csv: does not exist"),
        ("MAP --path circel", "unknown path 'circel'. Did you mean 'circle'?"),
        ("MAP --path empty.csv", "empty.csv: holds no points"),
        ("MAP --path head.csv", "head.csv: holds no points"),
        ("MAP --path nan.csv", "nan.csv: row 2 holds NaN"),
        ("MAP --path wide.csv", "wide.csv: has 3 columns; valid: 2"),
        ("MAP --path ragged.csv", "ragged.csv: is not a table of numbers"),
        ("MAP --path words.npy", "words.npy: holds an array of shape"),
        ("MAP --path pickle.npy", "pickle.npy: is not a table of numbers"),
        ("MAP --path .", "got .; valid: a file that ends in"),
        ("MAP --path circle --out q.txt", "--out: got q.txt; valid: a file that ends in .csv, .npy, .npz, .parquet"),
        ("MAP --path circle --record q.txt", "--record: got q.txt; valid: a file that ends in .rrd"),
        ("MAP --path circle --host 0.0.0.0", "--host: got 0.0.0.0; valid: none with --path"),
        ("MAP --path circle --port 0", "--port: got 0; valid: none with --path"),
        ("MAP --path circle --out no/q.csv", "folder 'no' does not exist"),
        ("MAP --path circle --record .", "it is a folder"),
        ("MAP --path nan.csv --out nan.csv", "another file than those that are read"),
        ("MAP --path circle --record x.csv --out x.csv", "--out: got x.csv; valid: another file than that of --record"),
        ("MAP --path circle --rate 0", "rate: got 0.0"),
        ("MAP --path circle --rate nan", "rate: got nan"),
        ("MAP --path circle --rate 1e300", "rate: got 1e+300"),
        ("MAP --path circle --foresight -1", "foresight: got -1.0"),
        ("MAP --path circle --foresight nan", "foresight: got nan"),
        ("MAP --path circle --max-step -1", "max_step: got -1.0"),
        ("MAP --port 70000", "Invalid value for '--port'"),
        ("none.grr --path circle", "none.grr: does not exist"),
        ("wide.csv --path circle", "truncated or not a roadmap"),
    ],
)
def test_a_mistake_is_one_clear_line_and_nothing_is_written(file, tmp_path, monkeypatch, words, complaint):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.csv").touch()
    (tmp_path / "head.csv").write_text("x,y\n")
    (tmp_path / "nan.csv").write_text("0.1,0.2\n0.1,nan\n")
    (tmp_path / "wide.csv").write_text("0.1,0.2,0.3\n")
    (tmp_path / "ragged.csv").write_text("0.1,0.2\n0.1\n")
    np.save(tmp_path / "words.npy", np.array([["a", "b"]]))
    np.save(tmp_path / "pickle.npy", np.array([[{}, {}]], dtype=object), allow_pickle=True)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    result = invoke("teleop", *(file if word == "MAP" else word for word in words.split()))
    assert result.exit_code == 2, result.output
    assert complaint in result.stderr
    assert "Traceback" not in result.output
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_port_in_use_is_a_clear_error(file):
    pytest.importorskip("viser", reason="viser is not installed")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        result = invoke("teleop", file, "--port", taken.getsockname()[1])
    assert result.exit_code == 2
    assert "in use" in result.stderr


def test_without_viser_the_message_names_the_extra(planar_roadmap, file, monkeypatch):
    from grr_torch.interactive.page import Page

    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingPackageError, match=r"grr-torch\[interactive\]"):
        Page(Session(Teleoperator(planar_roadmap)), port=0)
    result = invoke("teleop", file)
    assert result.exit_code == 2
    assert "grr-torch[interactive]" in result.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_live_session_ends_cleanly_and_leaves_its_files(file, tmp_path, number):
    pytest.importorskip("viser", reason="viser is not installed")
    words = ["teleop", file, "--port", "0", "--record", "live.rrd", "--out", "live.csv"]
    process = subprocess.Popen(
        [*PROGRAM, *map(str, words)],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # a shell's background jobs ignore the signal, and so would their children
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    line = process.stderr.readline()
    url = line.split(" at ")[1].split(";")[0]
    assert url.startswith("http://127.0.0.1:")
    assert b"<html" in urllib.request.urlopen(url, timeout=20).read().lower()
    assert not list(tmp_path.glob("live.*"))
    time.sleep(1.0)
    process.send_signal(number)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    assert "Traceback" not in errors
    assert "viser" not in output
    assert "tracking" in output
    assert "/space/tool" in entities(tmp_path / "live.rrd")
    table = np.genfromtxt(tmp_path / "live.csv", delimiter=",", names=True)
    assert len(table) > 5
    assert sorted(path.name for path in tmp_path.iterdir()) == ["live.csv", "live.rrd"]
