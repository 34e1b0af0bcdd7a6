"""The engine ray, with real clusters on this machine: workers and drivers that are killed, builds that fail."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
import torch
from command_line import PROGRAM
from test_sweep import FLEET, SMALL, orders_of, stamps

import grr_torch
from grr_torch.errors import GrrWarning, ParameterError
from grr_torch.experiments.cluster import measure_cluster
from grr_torch.fleet import cluster as cluster_module
from grr_torch.fleet import edges
from grr_torch.fleet.catalogue import read_catalogue
from grr_torch.fleet.order import Needs
from grr_torch.fleet.ray_engine import RayEngine
from grr_torch.fleet.run import LocalEngine, run_sweep
from grr_torch.fleet.sweep import read_sweep
from grr_torch.fleet.work import make_roadmap

if importlib.util.find_spec("ray") is None:  # not imported: clusters that are started here must do that
    pytest.skip("ray is not installed (extra cluster)", allow_module_level=True)


@pytest.fixture(scope="module", autouse=True)
def elsewhere(tmp_path_factory):
    """Ray's workers import from the working directory, in which the sources lie without their commands."""
    with contextlib.chdir(tmp_path_factory.mktemp("elsewhere")):
        yield


@pytest.fixture(scope="module")
def ray(elsewhere):
    with cluster_module.cluster(cpus=2) as connected:
        yield connected


def test_what_a_cluster_costs_is_measured():
    cost = measure_cluster("planar_3", points=900, workers=1, repeats=1)
    assert list(cost.cluster_seconds) == [1]
    assert 0 < cost.checked <= cost.edges
    assert min(cost.check_seconds, cost.refinement_seconds, *cost.cluster_seconds.values()) > 0.0
    # points and configurations as float64, resolved, wave; two vertices, connected
    assert (cost.bytes_vertex, cost.bytes_edge) == ((2 + 3) * 8 + 1 + 4, 2 * 8 + 1)


def killed(marks: Path, victim: str, times: int):
    """Work that kills its own process the first `times` times it is asked for one order; notes each time."""

    def work(order, folder, progress):
        mark = marks / f"{order.hash} {time.time_ns()}"
        mark.touch()
        if order.hash == victim and len(list(marks.glob(f"{victim} *"))) <= times:
            os.kill(os.getpid(), signal.SIGKILL)
        make_roadmap(order, folder, progress)

    return work


def count(marks, order):
    return len(list(marks.glob(f"{order.hash} *")))


@pytest.fixture
def marks(tmp_path):
    folder = tmp_path / "marks"
    folder.mkdir()
    return folder


def test_the_cluster_listens_to_this_machine_alone(ray):
    assert ray.util.get_node_ip_address() == "127.0.0.1"
    (top,) = (process for process in psutil.process_iter() if process.pid == os.getpid())
    listening = [
        connection.laddr.ip
        for process in top.children(recursive=True)
        for connection in process.net_connections()
        if connection.status == psutil.CONN_LISTEN
    ]
    assert listening
    assert set(listening) <= {"127.0.0.1", "::1", "::ffff:127.0.0.1"}


def test_a_worker_killed_in_the_middle_is_begun_again(ray, tmp_path, marks):
    orders = orders_of(tmp_path, SMALL + "grid: {seed: [0, 1, 2]}")
    with pytest.warns(GrrWarning, match="its worker died; begun again"):
        rows = run_sweep(orders, tmp_path / "out", RayEngine(work=killed(marks, orders[1].hash, 1)))
    assert [row["status"] for row in rows] == ["done"] * 3
    assert [count(marks, order) for order in orders] == [1, 2, 1]
    alone = grr_torch.build(grr_torch.load_robot("planar_5"), points=60, refine=False, seed=1)
    found = grr_torch.Roadmap.load(orders[1].path(tmp_path / "out"))
    torch.testing.assert_close(found.configurations, alone.configurations, rtol=0, atol=0, equal_nan=True)


def test_what_always_fails_is_reported_and_the_rest_goes_on(ray, tmp_path, marks):
    orders = orders_of(tmp_path, FLEET)
    huge = replace(orders[3], needs=Needs(cpus=1000.0))
    with pytest.warns(GrrWarning, match="begun again"):
        rows = run_sweep([*orders[:3], huge], tmp_path / "out", RayEngine(work=killed(marks, orders[1].hash, 99)))
    by_hash = {row["hash"]: row for row in rows}
    found = [by_hash[order.hash] for order in orders]
    assert [row["status"] for row in found] == ["done", "failed", "failed", "failed"]
    assert found[1]["error"] == "its worker died, 3 times"
    assert "no point within reach" in found[2]["error"]
    assert "no machine of the cluster has 1000 cores" in found[3]["error"]
    assert [count(marks, order) for order in orders] == [1, 3, 1, 0]


def test_the_driver_killed_and_started_again_does_only_the_rest(tmp_path):
    (tmp_path / "s.yaml").write_text(SMALL + f"grid: {{seed: {list(range(80))}}}")
    words = [*PROGRAM, "sweep", "s.yaml", "--engine", "ray", "--out", "out"]
    process = subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    folder = tmp_path / "out"
    try:
        while len(stamps(folder)) < 3:
            assert process.poll() is None
            time.sleep(0.02)
        others = psutil.Process(process.pid).children(recursive=True)
        used = {part for other in others for word in other.cmdline() for part in re.findall(r"/tmp/grr-ray-\w+", word)}
    finally:
        process.kill()
    process.wait()
    assert any("raylet" in other.name() for other in others if other.is_running())
    # Ray's two agents take a minute to find out, as they first report to what is no longer there
    working = [other for other in others if other.is_running() and not other.name().endswith("Agent")]
    _, alive = psutil.wait_procs(working, timeout=60)
    for other in others:
        if other.is_running():
            other.kill()
    for folder_of_ray in used:
        shutil.rmtree(folder_of_ray, ignore_errors=True)
    assert not alive
    orders = read_sweep(tmp_path / "s.yaml")
    before = stamps(folder)
    assert 3 <= len(before) < len(orders)
    done = []
    rows = run_sweep(orders, folder, LocalEngine(), told=lambda order, error: done.append((order.hash, error)))
    assert {(f"{name}.grr", error) for name, error in done} == {(f"{order.hash}.grr", None) for order in orders} - {
        (name, None) for name in before
    }
    after = stamps(folder)
    assert {name: after[name] for name in before} == before
    assert {row["status"] for row in rows} == {"done"}
    assert len(read_catalogue(folder)) == len(orders)
    assert not list(folder.glob(".*partial*"))


@pytest.mark.parametrize("refine", [False, True])
def test_a_build_whose_edges_are_checked_by_workers_gives_equal_tensors(ray, planar_5, monkeypatch, refine):
    monkeypatch.setattr(edges, "_BATCH", 16)
    options = {"task": "position", "points": 200, "refine": refine}
    alone = grr_torch.build(planar_5, **options)
    spread = grr_torch.build(planar_5, **options, check=edges.SpreadCheck(ray))
    for name in ("points", "configurations", "resolved", "edges", "connected", "wave"):
        torch.testing.assert_close(getattr(spread, name), getattr(alone, name), rtol=0, atol=0, equal_nan=True)


def test_workers_check_whole_batches(planar_5, generator, monkeypatch):
    class Here:
        """Ray, but in this process."""

        available_resources = staticmethod(lambda: {"CPU": 3.0})
        put = get = staticmethod(lambda given: given)

        def remote(self, **options):
            def remote_class(kind):
                def make(robot):
                    worker = kind(robot)
                    return SimpleNamespace(check=SimpleNamespace(remote=worker.check))

                return SimpleNamespace(remote=make)

            return remote_class

    seen = []

    def check(robot, task, points, *others, tolerances):
        seen.append(len(points))
        return torch.ones(len(points), dtype=torch.bool)

    monkeypatch.setattr(edges, "_BATCH", 16)
    monkeypatch.setattr(edges, "is_continuous", check)
    ends = [torch.zeros(90, 2), torch.zeros(90, 2), torch.zeros(90, 5), torch.zeros(90, 5)]
    assert len(edges.SpreadCheck(Here())(planar_5, grr_torch.Position(2), *ends)) == 90
    assert seen == [16, 16, 16, 16, 16, 10]


def test_workers_judge_edges_as_this_process_does_even_if_one_is_killed(ray, planar_5, generator, monkeypatch):
    monkeypatch.setattr(edges, "_BATCH", 16)
    task = grr_torch.Position(2)
    q = [planar_5.sample(301, generator)]
    q.append(q[0] + torch.linspace(0.0, 1.0, 301, dtype=torch.float64)[:, None])
    p = [planar_5.forward_kinematics(part)[0][..., :2] for part in q]
    check = edges.SpreadCheck(ray)
    expected = grr_torch.is_continuous(planar_5, task, *p, *q)
    assert torch.equal(check(planar_5, task, *p, *q), expected)
    assert 0 < int(expected.sum()) < len(expected)
    others = psutil.Process(os.getpid()).children(recursive=True)
    workers = [other for other in others if other.name().startswith("ray::_Worker")]
    assert workers
    workers[0].kill()
    assert torch.equal(check(planar_5, task, *p, *q), expected)


def test_a_cluster_that_answers_is_joined(ray, tmp_path):
    (tmp_path / "s.yaml").write_text(SMALL + "grid: {seed: [0, 1]}")
    address = ray.get_runtime_context().gcs_address
    words = [
        sys.executable,
        "-P",
        "-m",
        "grr_torch.cli.main",
        "sweep",
        "s.yaml",
        "--engine",
        "ray",
        "--address",
        address,
    ]
    result = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert "2 of 2 roadmaps, 2 of them built now" in result.stdout
    assert len(ray.nodes()) == 1


@pytest.mark.parametrize("address", ["nonsense", "ray://127.0.0.1:1", "127.0.0.1:0", "127.0.0.1:99999", ":6379"])
def test_what_is_no_address_is_refused(address):
    with pytest.raises(ParameterError, match="host:port of a Ray cluster, or auto"):
        cluster_module.check_answers(address)


def test_an_address_that_does_not_answer_is_given_up(monkeypatch):
    monkeypatch.setattr(cluster_module, "_ANSWER", 3.0)
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(ParameterError, match="nothing answers there"):
            cluster_module.check_answers(address)
        server.listen()
        with pytest.raises(ParameterError, match="does not answer as one within 3 s"):
            cluster_module.check_answers(address)


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(grr_torch.GrrError, match=r"pip install 'grr-torch\[cluster\]'"), cluster_module.cluster():
        pass
