"""Batches on all cores: the same whatever their number, and nothing is lost or left behind."""

from __future__ import annotations

import fcntl
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import grr_torch
from grr_torch import processes
from grr_torch.pieces import cores, one_thread
from grr_torch.processes import at_once

CPU = torch.device("cpu")
forks = pytest.mark.skipif(sys.platform != "linux", reason="no fork that torch bears")


@pytest.fixture
def threads():
    """Sets torch's threads, and sets them back."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def _process(_):
    return (torch.tensor(os.getpid()),)


@pytest.mark.parametrize("count", [1, 2, 3, 7])
@pytest.mark.parametrize("items", [0, 1, 2, 5])
def test_results_come_in_order(threads, count, items):
    threads(count)
    found = list(at_once(lambda k: (torch.full((k, 2), float(k)), torch.arange(k) > 1), range(items), CPU))
    assert len(found) == items
    for k, (values, flags) in enumerate(found):
        assert torch.equal(values, torch.full((k, 2), float(k)))
        assert torch.equal(flags, torch.arange(k) > 1)


@forks
def test_there_is_a_process_for_each_of_the_threads_or_items(threads):
    for count, items, expected in ((1, 5, {os.getpid()}), (2, 5, 2), (3, 2, 2), (2, 1, {os.getpid()})):
        threads(count)
        found = {int(number) for (number,) in at_once(_process, range(items), CPU)}
        assert found == expected if isinstance(expected, set) else len(found - {os.getpid()}) == expected


@forks
def test_operators_on_one_thread_leave_the_others_to_processes(threads):
    threads(2)
    with one_thread(), one_thread():
        assert torch.get_num_threads() == 1
        assert cores() == 2
        assert os.getpid() not in {int(number) for (number,) in at_once(_process, range(4), CPU)}
    assert cores() == torch.get_num_threads() == 2


@forks
@pytest.mark.parametrize("fatal", [0, 1, 2, 3, 6])
@pytest.mark.parametrize("size", [2, 100_000])
def test_what_a_lost_process_was_to_do_is_done_here(threads, fatal, size):
    threads(2)
    here = os.getpid()

    def work(k):
        if k == fatal and os.getpid() != here:
            os.kill(os.getpid(), signal.SIGKILL)
        return (torch.tensor([k, os.getpid()]).repeat(size, 1),)

    found = torch.stack([rows[0] for (rows,) in at_once(work, range(7), CPU)])
    assert found[:, 0].tolist() == list(range(7))
    # every other item is that of the process that was lost, from the fatal one on
    assert (found[:, 1] == here).tolist() == [k >= fatal and k % 2 == fatal % 2 for k in range(7)]
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize("count", [1, 2])
def test_an_error_is_raised_as_it_is(threads, count):
    threads(count)

    def failing(k):
        if k == 3:
            raise grr_torch.errors.ParameterError("k", k, "another")
        return (torch.tensor(k),)

    results = at_once(failing, range(5), CPU)
    assert [int(next(results)[0]) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(grr_torch.errors.ParameterError, match="k: got 3"):
        next(results)
    assert multiprocessing.active_children() == []


@forks
def test_gradients_are_asked_for_as_before(threads):
    parent = os.getpid()
    for count in (1, 2):
        threads(count)
        for fatal in (None, 1):

            def work(k, fatal=fatal):
                if k == fatal and os.getpid() != parent:
                    os._exit(1)
                return (torch.tensor(torch.is_grad_enabled()),)

            for (enabled,) in at_once(work, range(4), CPU):
                assert not bool(enabled)
                assert torch.is_grad_enabled()


@forks
def test_no_process_is_left_when_results_are_not_waited_for(threads):
    threads(2)

    def slow(k):
        if k:
            time.sleep(600.0)
        return (torch.tensor(k),)

    results = at_once(slow, range(4), CPU)
    next(results)
    assert len(multiprocessing.active_children()) == 2
    results.close()
    assert multiprocessing.active_children() == []


SCRIPT = """
import fcntl, os, sys, time, torch
from grr_torch.processes import at_once
torch.set_num_threads(2)
lock = open(sys.argv[1], "w")
fcntl.flock(lock, fcntl.LOCK_EX)
def slow(k):
    os.write(1, f"{os.getpid()}\\n".encode())  # at once, whatever the other process writes
    time.sleep(2.0 if k < 2 else 600.0)
    return (torch.zeros(100_000),)
for found in at_once(slow, range(600), torch.device("cpu")):
    time.sleep(600.0)
"""


def _runs(number):
    try:
        return Path(f"/proc/{number}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False


def _is_locked(path):
    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


@forks
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGKILL])
def test_processes_end_with_the_one_that_forked_them(sent, tmp_path):
    lock = tmp_path / "lock"
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(lock)],
        stdout=subprocess.PIPE,
        stderr=(tmp_path / "told").open("w"),
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    children: set[int] = set()
    while len(children) < 2:
        children.add(int(process.stdout.readline()))
    assert process.pid not in children
    assert _is_locked(lock)
    if sent == signal.SIGINT:
        os.killpg(process.pid, sent)  # as a terminal does: all of them get it
    else:
        process.kill()
    process.wait(60)
    # while they end, they keep nobody out
    assert not _is_locked(lock)
    # one traceback, of the process that was started, or none
    assert (tmp_path / "told").read_text().count("KeyboardInterrupt") == (1 if sent == signal.SIGINT else 0)
    until = time.monotonic() + 60.0
    while any(map(_runs, children)) and time.monotonic() < until:
        time.sleep(0.1)
    assert not any(map(_runs, children))


@forks
@pytest.mark.parametrize("failing", ["os.fork", "os.pipe"])
def test_what_cannot_be_forked_is_done_here(monkeypatch, threads, failing):
    threads(3)
    calls = iter([None, OSError("no more"), None])
    real = os.fork if failing == "os.fork" else os.pipe

    def sometimes(*args):
        error = next(calls, None)
        if error is not None:
            raise error
        return real(*args)

    monkeypatch.setattr(failing, sometimes)
    found = [int(number) for (number,) in at_once(_process, range(6), CPU)]
    assert os.getpid() in found
    assert len(set(found)) > 1


def _multiples(k):
    return [int(found) for (found,) in at_once(lambda i: (torch.tensor(i * k),), range(9), CPU)]


@forks
def test_no_process_is_forked_in_one_of_a_pool_or_beside_ray(monkeypatch, threads):
    threads(2)
    with multiprocessing.get_context("fork").Pool(1) as pool:
        inside, found = pool.apply(_asked_in_a_pool)
    assert found == {inside}
    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(is_initialized=lambda: True))
    assert {int(number) for (number,) in at_once(_process, range(4), CPU)} == {os.getpid()}


def _asked_in_a_pool():
    return os.getpid(), {int(number) for (number,) in at_once(_process, range(4), CPU)}


@forks
def test_several_threads_may_ask_at_once(threads):
    threads(2)
    with ThreadPoolExecutor(3) as pool:
        found = list(
            pool.map(lambda k: [int(x) for (x,) in at_once(lambda i: (torch.tensor(i * k),), range(9), CPU)], range(3))
        )
    assert found == [[i * k for i in range(9)] for k in range(3)]


@pytest.mark.parametrize("seeds", [None, "auto"])
def test_roadmaps_are_the_same_on_any_number_of_cores(monkeypatch, threads, planar_5, seeds):
    for module, name in (("edges", "EDGES_AT_ONCE"), ("cells", "CELLS_AT_ONCE"), ("certify", "CELLS_AT_ONCE")):
        monkeypatch.setattr(f"grr_torch.resolution.{module}.{name}", 97)
    monkeypatch.setattr("grr_torch.resolution.hops._TOGETHER", 50)
    forked, real = [], processes._fork

    def fork(function, items):
        forked.append(len(items))
        return real(function, items)

    monkeypatch.setattr(processes, "_fork", fork)
    found = []
    for count in (1, 2, 3):
        threads(count)
        forked.clear()
        found.append(grr_torch.build(planar_5, "position", points=300, seeds=seeds))
        assert bool(forked) == (count > 1 and sys.platform == "linux")
    for other in found[1:]:
        assert torch.equal(other.connected, found[0].connected)
        assert torch.equal(other.configurations[other.resolved], found[0].configurations[found[0].resolved])
        assert torch.equal(other.triangles().spread, found[0].triangles().spread)
