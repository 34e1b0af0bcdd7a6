"""Sessions, replays and their command: laws of the steps, what is written, and mistakes."""

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
import torch
from grr_torch.cli.main import app
from typer.testing import CliRunner

import grr_torch
from grr_torch.applications.example_paths import KINDS, example_path, middles
from grr_torch.applications.replay import read_waypoints, replay
from grr_torch.applications.teleoperation_log import TeleoperationLog
from grr_torch.errors import FileFormatError, MissingPackageError, ParameterError, UnknownNameError
from grr_torch.interactive.drive import drive
from grr_torch.interactive.session import Session
from grr_torch.recording.teleoperation import record_teleoperation


@pytest.fixture(scope="module")
def kinova_roadmap(kinova):
    return grr_torch.build(kinova, "fixed-rotation")


@pytest.fixture(scope="module", params=["planar_5", "kinova"])
def roadmap(request, planar_roadmap, kinova_roadmap):
    return planar_roadmap if request.param == "planar_5" else kinova_roadmap


@pytest.fixture
def session(roadmap):
    return Session(roadmap)


@pytest.fixture(scope="module")
def file(planar_roadmap, tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "map.grr"
    planar_roadmap.save(path)
    return path


def follow(session, ticks=400):
    """Ticks until the arm has arrived."""
    for _ in range(ticks):
        session.tick()
        if np.linalg.norm(np.subtract(session.tool, session.target)) < 1e-3:
            return
    raise AssertionError(f"the arm stands at {session.tool}, its target at {session.target}")


def entities(path):
    from rerun.chunk import RrdReader

    return {column.entity_path for column in RrdReader(path).store().schema().component_columns()}


def test_a_session_starts_where_its_target_is_and_holds_still(session):
    first = session.configuration
    step = session.tick()
    assert step.status == "tracking"
    assert step.target == session.target == tuple(session.home.tolist())
    assert float((step.configuration - first).abs().max()) < 1e-3
    assert np.linalg.norm(np.subtract(session.tool, session.target)) < 1e-3


def test_an_arm_follows_its_target_within_the_velocity_limits(session):
    session.nudge(0, 0.05)
    session.nudge(1, -0.03)
    follow(session)
    expected = session.home.clone()
    expected[:2] += torch.tensor([0.05, -0.03], dtype=torch.float64)
    assert session.target == pytest.approx(expected.tolist())
    steps = session.log.configurations.diff(dim=0).abs()
    assert bool((steps <= session.roadmap.robot.velocity_limits / session.rate + 1e-12).all())
    position, _ = session.roadmap.robot.forward_kinematics(session.configuration)
    assert position[: len(expected)].tolist() == pytest.approx(list(session.tool), abs=1e-12)


def test_a_clutch_that_is_let_go_holds_the_arm_and_its_target_comes_back(session):
    session.tick()
    still = session.configuration
    session.let_go()
    session.nudge(0, 0.1)
    for _ in range(5):
        step = session.tick()
        assert step.status == "holding"
        assert torch.equal(step.configuration, still)
    assert session.target[0] == pytest.approx(float(session.home[0]) + 0.1)
    session.engage()
    assert session.target == session.tool
    assert float((session.tick().configuration - still).abs().max()) < 2e-3
    session.nudge(0, 0.03)
    follow(session)


def test_a_reset_stops_the_arm_and_home_brings_it_back(session):
    session.nudge(1, 0.1)
    for _ in range(4):
        session.tick()
    session.reset()
    where = session.tool
    for _ in range(3):
        session.tick()
    assert session.target == where
    assert np.linalg.norm(np.subtract(session.tool, where)) < 2e-3
    session.go_home()
    follow(session)


def test_targets_stay_within_bounds_and_are_finite(session):
    width = len(session.low)
    session.move([9.0] * width)
    assert session.target == tuple(session.high.tolist())
    session.nudge(0, -99.0)
    assert session.target[0] == float(session.low[0])
    for wrong in ([float("nan")] * width, [float("inf")] * width, [0.1] * (width + 1)):
        with pytest.raises(ParameterError, match="finite numbers"):
            session.move(wrong)
    assert session.target[0] == float(session.low[0])


def test_the_loop_ends_when_it_is_told_to(planar_roadmap):
    from threading import Event

    session, stop, shown = Session(planar_roadmap, rate=200.0), Event(), []

    def show(step):
        shown.append(step)
        if len(shown) == 12:
            stop.set()

    drive(session, show, stop)
    assert len(session.log) == 12
    times = session.log.times
    assert bool((times.diff() > 0.0).all())
    # never faster than the rate
    assert float(times[-1]) >= 11 / 200.0 - 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_example_paths_are_followed_all_the_way(roadmap, kind):
    path = example_path(roadmap, kind)
    assert path.shape[1] == roadmap.task.width
    assert path[-1].tolist() == pytest.approx(path[0].tolist(), abs=1e-9)
    steps = path.diff(dim=0).norm(dim=1)
    assert float(steps.max()) * 50.0 == pytest.approx(0.15, rel=0.15)
    assert bool(roadmap.solve(path).valid.all())
    log = replay(roadmap, path[:: max(1, len(path) // 150)], rate=10.0)
    summary = log.summary()
    assert summary.shares["holding"] == summary.shares["unreachable"] == 0.0
    assert summary.final_deviation <= 1e-3
    assert summary.joint_step <= float(roadmap.robot.velocity_limits.max()) / 10.0 + 1e-12
    # unwrapped
    assert float(log.configurations.diff(dim=0).abs().max()) < torch.pi


def test_the_middle_is_resolved(roadmap):
    places = middles(roadmap, 4)
    assert places.shape == (4, roadmap.task.width)
    apart = (roadmap.points[None] - places[:, None]).norm(dim=2)
    assert bool(roadmap.resolved[apart.argmin(1)].all())
    assert float(apart.amin(1).max()) == 0.0


def test_no_such_example_path(planar_roadmap):
    with pytest.raises(UnknownNameError, match="circle"):
        example_path(planar_roadmap, "circel")


def test_a_replay_of_one_waypoint_and_of_an_unreachable_one(roadmap):
    home = middles(roadmap)
    assert replay(roadmap, home).summary().steps == 1
    away = torch.cat([home, home + 5.0])
    log = replay(roadmap, away)
    summary = log.summary()
    assert summary.steps == 102
    assert summary.shares["tracking"] < 0.1
    assert log.status[-1] in ("unreachable", "holding")
    for wrong in (home[:0], home[0], home[:, :1], home * torch.nan):
        with pytest.raises(ParameterError, match="waypoints"):
            replay(roadmap, wrong)


def test_a_log_says_what_its_steps_were(planar_roadmap):
    log = replay(planar_roadmap, example_path(planar_roadmap, "line")[:60])
    summary = log.summary()
    position, _ = planar_roadmap.robot.forward_kinematics(log.configurations)
    away = (position[:, :2] - log.targets).norm(dim=1)
    assert torch.equal(log.tools, position)
    assert summary.deviation == pytest.approx(float(away.mean()))
    assert summary.largest_deviation == pytest.approx(float(away.max()))
    assert sum(summary.shares.values()) == pytest.approx(1.0)
    assert summary.clearance is None
    assert bool(log.clearances.isinf().all())
    assert log.times.tolist() == pytest.approx([k / 50.0 for k in range(len(log))])
    with pytest.raises(ParameterError, match="no step"):
        TeleoperationLog(planar_roadmap, 50.0).summary()


def test_trajectories_are_written_in_three_formats(kinova_roadmap, tmp_path):
    log = replay(kinova_roadmap, example_path(kinova_roadmap, "circle")[:40])
    for suffix in ("csv", "npy", "npz"):
        log.save_trajectory(tmp_path / f"q.{suffix}")
    q = log.configurations.numpy()
    table = np.genfromtxt(tmp_path / "q.csv", delimiter=",", names=True)
    assert table.dtype.names == ("time", *kinova_roadmap.robot.joint_names)
    assert np.allclose(np.array(table.tolist())[:, 1:], q, atol=1e-8)
    assert np.array_equal(np.load(tmp_path / "q.npy", allow_pickle=False), q)
    with np.load(tmp_path / "q.npz", allow_pickle=False) as data:
        assert np.array_equal(data["configurations"], q)
        assert np.array_equal(data["targets"], log.targets.numpy())
        assert data["status"].tolist() == log.status.tolist()
        assert data["joint_names"].tolist() == list(kinova_roadmap.robot.joint_names)
    with pytest.raises(ParameterError, match=r"\.csv, \.npy, \.npz"):
        log.save_trajectory(tmp_path / "q.txt")


def test_a_recording_has_all_its_parts(roadmap, tmp_path):
    path = example_path(roadmap, "line")
    out = torch.cat([path[:40], path[:40] + 3.0])
    record_teleoperation(replay(roadmap, out), tmp_path / "t.rrd")
    found = entities(tmp_path / "t.rrd")
    wanted = {"target", "tool", "trace", "whole", "asked", "between", "roadmap/vertices"}
    assert {f"/space/{name}" for name in wanted} <= found
    assert {"/status", "/distance", *(f"/joints/{name}" for name in roadmap.robot.joint_names)} <= found
    assert ("/clearance" in found) == (roadmap.robot.spheres is not None)
    assert any("visual_geometries" in entity for entity in found)
    with pytest.raises(ParameterError, match="no step"):
        record_teleoperation(TeleoperationLog(roadmap, 50.0), tmp_path / "none.rrd")
    assert not (tmp_path / "none.rrd").exists()


def test_an_arm_that_never_moves_is_recorded(planar_roadmap, tmp_path):
    record_teleoperation(replay(planar_roadmap, middles(planar_roadmap)), tmp_path / "still.rrd")
    assert "/space/tool" in entities(tmp_path / "still.rrd")


def test_waypoints_are_read_from_tables(tmp_path):
    table = np.array([[0.1, 0.2], [0.3, 0.4], [0.3, 0.4]])
    (tmp_path / "a.csv").write_text("x,y\n0.1,0.2\n0.3,0.4\n\n0.3,0.4\n")
    (tmp_path / "b.txt").write_text("# metres\n0.1 0.2\n0.3 0.4\n0.3 0.4\n")
    np.save(tmp_path / "c.npy", table)
    for name in ("a.csv", "b.txt", "c.npy"):
        assert np.array_equal(read_waypoints(tmp_path / name, 2).numpy(), table)
    with pytest.raises(FileFormatError, match="has 2 columns; valid: 3"):
        read_waypoints(tmp_path / "a.csv", 3)


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


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("MAP --path none.csv", "none.csv: cannot be read"),
        ("MAP --path circel", "unknown path 'circel'. Did you mean 'circle'?"),
        ("MAP --path empty.csv", "empty.csv: is not a table of numbers"),
        ("MAP --path head.csv", "head.csv: is not a table of numbers"),
        ("MAP --path nan.csv", "nan.csv: has values that are not finite: row 2"),
        ("MAP --path wide.csv", "wide.csv: has 3 columns; valid: 2"),
        ("MAP --path ragged.csv", "ragged.csv: is not a table of numbers"),
        ("MAP --path words.npy", "words.npy: is not a table of numbers"),
        ("MAP --path pickle.npy", "pickle.npy: is not a table of numbers"),
        ("MAP --path .", ".: cannot be read"),
        ("MAP --path circle --out q.txt", "a name that ends in .csv, .npy, .npz"),
        ("MAP --path circle --out no/q.csv", "folder 'no' does not exist"),
        ("MAP --path circle --record .", "it is a folder"),
        ("MAP --path nan.csv --out nan.csv", "other files than those that are read"),
        ("MAP --path circle --record x.csv --out x.csv", "another file than the recording's"),
        ("MAP --path circle --rate 0", "rate: got 0.0"),
        ("MAP --path circle --rate nan", "rate: got nan"),
        ("MAP --path circle --rate 1e300", "rate: got 1e+300"),
        ("MAP --path wide.csv --rate nan", "has 3 columns"),
        ("MAP --path circle --max-step -1", "max_step: got -1.0"),
        ("MAP --port 70000", "Invalid value for '--port'"),
        ("none.grr --path circle", "none.grr: is not a file"),
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
        Page(Session(planar_roadmap), port=0)
    result = invoke("teleop", file)
    assert result.exit_code == 2
    assert "grr-torch[interactive]" in result.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_live_session_ends_cleanly_and_leaves_its_files(file, tmp_path, number):
    pytest.importorskip("viser", reason="viser is not installed")
    words = ["teleop", file, "--port", "0", "--record", "live.rrd", "--out", "live.csv"]
    process = subprocess.Popen(
        [sys.executable, "-m", "grr_torch.cli.main", *map(str, words)],
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
