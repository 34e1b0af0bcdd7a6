"""Batches that need nothing of each other, on all cores of the CPU.

Threads would not do: what the calls of torch's short operators take of Python is nearly half of the time, and Python
does one thing at a time. So the process forks, as torch's own `DataLoader` does: nothing has to be sent to its copies.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import TypeVar

import torch
from torch import Tensor

from grr_torch.pieces import Array, cores

Item = TypeVar("Item")
Results = tuple[Tensor, ...]

# two threads that fork at once would give their processes ends of each other's pipes
_forking = threading.Lock()


def at_once(function: Callable[[Item], Results], items: Sequence[Item], device: torch.device) -> Iterator[Results]:
    """Applies a function to items; on the CPU, to as many at a time as torch has threads, each in a process of its own.

    What comes out is the same however many there are. What a process that is lost, or was never there, was to do is
    done in this one.

    Args:
        function: Takes an item and gives tensors without gradients; what it changes, draws or warns of may be lost.
        items: What it is applied to.
        device: Where it works.

    Yields:
        What the function gives, in the order of the items.
    """
    count = min(cores(), len(items)) if device.type == "cpu" and _may_fork() else 1
    if count < 2:
        yield from map(torch.no_grad()(function), items)
        return
    workers: list[tuple[BaseProcess, Connection] | None] = []
    try:
        for k in range(count):
            workers.append(_fork(function, items[k::count]))
        for number, item in enumerate(items):
            k = number % count
            found = _receive(workers[k])
            if found is None:
                _end([workers[k]])
                workers[k] = None
                yield torch.no_grad()(function)(item)
            else:
                yield tuple(map(torch.from_numpy, found))
    finally:
        _end(workers)


def _may_fork() -> bool:
    """Not where a fork is not safe for torch, in a process that is itself of a pool, or beside the threads of Ray."""
    ray = sys.modules.get("ray")
    return (
        sys.platform == "linux"
        and not multiprocessing.current_process().daemon
        and not (ray is not None and ray.is_initialized())
    )


def _fork(function: Callable[[Item], Results], items: Sequence[Item]) -> tuple[BaseProcess, Connection] | None:
    """A copy of the process at work on items, and where its results can be read; None if the system has no more."""
    fork = multiprocessing.get_context("fork")
    with _forking:
        try:
            reader, writer = fork.Pipe(duplex=False)
        except OSError:
            return None
        worker = fork.Process(target=_work, args=(function, items, writer), daemon=True)
        # interrupts are for this process, which ends the other one
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            worker.start()
        except OSError:
            reader.close()
            return None
        finally:
            # the one end that is left is that of the process: where it is lost, so is what would be read
            writer.close()
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return worker, reader


def _receive(worker: tuple[BaseProcess, Connection] | None) -> tuple[Array, ...] | None:
    """The next results of a process; None if it is lost."""
    if worker is None:
        return None
    try:
        found: tuple[Array, ...] = worker[1].recv()
    except (EOFError, OSError):
        return None
    return found


def _end(workers: Sequence[tuple[BaseProcess, Connection] | None]) -> None:
    """Ends processes, whatever they are at."""
    known = [worker for worker in workers if worker is not None]
    for process, _ in known:
        process.kill()
    for process, reader in known:
        process.join()
        reader.close()


def _work(function: Callable[[Item], Results], items: Sequence[Item], writer: Connection) -> None:
    """What a copy of the process does. It ends without a word: whoever waits for it takes over, and may fail aloud."""
    code = 1
    with contextlib.suppress(BaseException):
        parent = os.getppid()
        # what the other process has open is its own: locks and pipes that outlived it would keep others out
        for number in map(int, os.listdir("/dev/fd")):
            if number > 2 and number != writer.fileno():
                with contextlib.suppress(OSError):  # the one that listed them
                    os.close(number)
        # the threads that torch had are not there any more
        torch.set_num_threads(1)
        with torch.no_grad():
            for item in items:
                writer.send(tuple(part.numpy() for part in function(item)))
                if os.getppid() != parent:
                    break
        code = 0
    # nothing of what was copied is to be flushed twice
    os._exit(code)
