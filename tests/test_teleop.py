"""Sessions and replays: laws of the steps, and what is written of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from pyarrow import parquet

from grr_torch import Axis, Pose, Position, Yaw
from grr_torch.applications.example_paths import KINDS, example_path, middles
from grr_torch.applications.replay import read_waypoints, replay
from grr_torch.applications.teleoperate import Teleoperator
from grr_torch.applications.teleoperation_log import TeleoperationLog
from grr_torch.errors import FileFormatError, ParameterError, UnknownNameError
from grr_torch.interactive import drive as driving
from grr_torch.interactive.drive import drive
from grr_torch.interactive.session import Session
from grr_torch.recording.teleoperation import record_teleoperation


@pytest.fixture(scope="module", params=["planar_5", "kinova"])
def roadmap(request, planar_roadmap, kinova_roadmap):
    return planar_roadmap if request.param == "planar_5" else kinova_roadmap


@pytest.fixture
def session(roadmap):
    return Session(Teleoperator(roadmap))


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

    session, stop, shown = Session(Teleoperator(planar_roadmap, rate=200.0)), Event(), []

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


def test_a_step_that_comes_late_is_not_made_up_for(planar_roadmap, monkeypatch):
    session, late = Session(Teleoperator(planar_roadmap, rate=50.0)), iter([0.0, 0.03, 0.0, 0.015, 0.0, 0.0])

    class Clock:
        now = 0.0

        def perf_counter(self):
            self.now += 1e-4
            return self.now

        def is_set(self):
            return len(shown) == 6

        def wait(self, seconds):
            self.now += seconds + next(late)

    clock, shown = Clock(), []
    monkeypatch.setattr(driving, "time", clock)
    drive(session, shown.append, clock)
    apart = session.log.times.diff()
    assert float(apart.min()) >= 0.02
    assert float(apart.max()) >= 0.05


def test_an_arm_with_slow_joints_gets_a_slower_path(kinova_roadmap):
    """So that its tool stays at its target: by its usual speed it would fall behind."""
    robot = kinova_roadmap.robot
    usual = example_path(kinova_roadmap, "circle")
    slow = replace(kinova_roadmap, robot=replace(robot, velocity_limits=robot.velocity_limits / 10.0))
    path = example_path(slow, "circle")
    assert len(path) > 1.5 * len(usual)
    assert replay(Teleoperator(slow), path).summary().largest_deviation < 2e-3


@pytest.mark.parametrize("kind", KINDS)
def test_example_paths_are_followed_all_the_way(roadmap, kind):
    path = example_path(roadmap, kind)
    assert path.shape[1] == roadmap.task.width
    assert path[-1].tolist() == pytest.approx(path[0].tolist(), abs=1e-9)
    steps = path.diff(dim=0).norm(dim=1)
    assert float(steps.max()) * 50.0 == pytest.approx(0.15, rel=0.15)
    assert bool(roadmap.solve(path).valid.all())
    log = replay(Teleoperator(roadmap, rate=10.0), path[:: max(1, len(path) // 150)])
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
    assert replay(Teleoperator(roadmap), home).summary().steps == 1
    away = torch.cat([home, home + 5.0])
    log = replay(Teleoperator(roadmap), away)
    summary = log.summary()
    assert summary.steps == 102
    assert summary.shares["tracking"] < 0.1
    assert log.status[-1] != "tracking"
    for wrong in (home[:0], home[0], home[:, :1], home * torch.nan):
        with pytest.raises(ParameterError, match="waypoints"):
            replay(Teleoperator(roadmap), wrong)


def test_a_log_says_what_its_steps_were(planar_roadmap):
    log = replay(Teleoperator(planar_roadmap), example_path(planar_roadmap, "line")[:60])
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


def test_trajectories_are_written_in_four_formats(kinova_roadmap, tmp_path):
    log = replay(Teleoperator(kinova_roadmap), example_path(kinova_roadmap, "circle")[:40])
    for suffix in ("csv", "npy", "npz", "parquet", "NPY"):
        log.save_trajectory(tmp_path / f"q.{suffix}")
    q = log.configurations.numpy()
    table = np.genfromtxt(tmp_path / "q.csv", delimiter=",", names=True)
    assert table.dtype.names == ("time", *kinova_roadmap.robot.joint_names)
    assert np.array_equal(np.array(table.tolist())[:, 1:], q)
    for name in ("q.npy", "q.NPY"):
        assert np.array_equal(np.load(tmp_path / name, allow_pickle=False), q)
    columns = parquet.read_table(tmp_path / "q.parquet")
    assert columns.column_names == list(table.dtype.names)
    assert np.array_equal(np.column_stack([column.to_numpy() for column in columns.columns[1:]]), q)
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
    record_teleoperation(replay(Teleoperator(roadmap), out), tmp_path / "t.rrd")
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
    record_teleoperation(replay(Teleoperator(planar_roadmap), middles(planar_roadmap)), tmp_path / "still.rrd")
    assert "/space/tool" in entities(tmp_path / "still.rrd")


def test_waypoints_are_read_from_tables(tmp_path):
    table = np.array([[0.1, 0.2], [0.3, 0.4], [0.3, 0.4]])
    (tmp_path / "a.csv").write_text("x,y\n0.1,0.2\n0.3,0.4\n\n0.3,0.4\n")
    np.save(tmp_path / "c.npy", table)
    for name in ("a.csv", "c.npy"):
        assert np.array_equal(read_waypoints(tmp_path / name, Position(2)).numpy(), table)
    with pytest.raises(FileFormatError, match="has columns named x, y; valid: each of x, y, z once"):
        read_waypoints(tmp_path / "a.csv", Position(3))


@pytest.mark.parametrize("task", [Pose(2), Pose(3), Yaw(3), Axis(3)], ids=lambda task: f"{task.kind} {task.width}")
def test_waypoints_of_turning_tools_are_read_from_tables(tmp_path, task):
    table = np.arange(1.0, 1.0 + 3 * task.width).reshape(3, task.width)
    names = list(task.coordinates)
    np.savetxt(tmp_path / "named.csv", table[:, ::-1], delimiter=",", header=",".join(reversed(names)), comments="")
    np.savetxt(tmp_path / "plain.csv", table, delimiter=",")
    np.save(tmp_path / "p.npy", table)
    for name in ("named.csv", "plain.csv", "p.npy"):
        assert np.array_equal(read_waypoints(tmp_path / name, task).numpy(), table)
    assert len(set(names)) == task.width


@pytest.mark.parametrize("stop", [Session.let_go, Session.reset, Session.engage])
def test_an_arm_that_is_stopped_brakes(roadmap, stop):
    session = Session(Teleoperator(roadmap, acceleration_limits=2.0))
    session.nudge(0, 0.2)
    q = [session.tick().configuration for _ in range(20)]
    stop(session)
    q += [session.tick().configuration for _ in range(60)]
    moved = torch.stack(q).diff(dim=0)
    assert float(moved[15].abs().max()) > 1e-3
    assert float(moved[-1].abs().max()) < 1e-3
    assert float(moved.diff(dim=0).abs().max()) * session.rate**2 <= 2.0 * (1.0 + 1e-6)
