"""Batches that need nothing of each other, on all cores of the CPU.

Threads would not do: what the calls of torch's short operators take of Python is nearly half of the time, and Python
does one thing at a time. So the process forks, as torch's own `DataLoader` does: nothing has to be sent to its copies.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import TypeVar

import torch
from torch import Tensor

from grr_torch.pieces import Array, cores

Item = TypeVar("Item")
Results = tuple[Tensor, ...]


def at_once(function: Callable[[Item], Results], items: Sequence[Item], device: torch.device) -> Iterator[Results]:
    """Applies a function to items; on the CPU, to as many at a time as torch has threads, each in a process of its own.

    What comes out is the same however many there are. What a process that is lost was to do is done in this one.

    Args:
        function: Takes an item and gives tensors; what else it changes is lost.
        items: What it is applied to.
        device: Where it works.

    Yields:
        What the function gives, in the order of the items.
    """
    count = min(cores(), len(items))
    # copies of a process cannot use its GPU; and what is itself of a pool may have none
    alone = count < 2 or device.type != "cpu" or multiprocessing.current_process().daemon
    if alone or "fork" not in multiprocessing.get_all_start_methods():
        yield from map(function, items)
        return
    fork = multiprocessing.get_context("fork")
    workers: list[BaseProcess] = []
    readers: list[Connection] = []
    lost = [False] * count
    try:
        for k in range(count):
            reader, writer = fork.Pipe(duplex=False)
            readers.append(reader)
            workers.append(fork.Process(target=_work, args=(function, items[k::count], writer, readers), daemon=True))
            workers[k].start()
            # the one end that is left is that of the process: where it is lost, so is what would be read
            writer.close()
        for number, item in enumerate(items):
            k = number % count
            found = None if lost[k] else _receive(readers[k])
            lost[k] = found is None
            yield function(item) if found is None else tuple(map(torch.from_numpy, found))
    finally:
        for worker in workers:
            if worker.pid is not None:
                worker.kill()
                worker.join()
        for reader in readers:
            reader.close()


def _receive(reader: Connection) -> tuple[Array, ...] | None:
    """The next results of a process; None if it is lost."""
    try:
        found: tuple[Array, ...] = reader.recv()
    except (EOFError, OSError):
        return None
    return found


def _work(
    function: Callable[[Item], Results], items: Sequence[Item], writer: Connection, readers: Sequence[Connection]
) -> None:
    """What a copy of the process does. It ends without a word: whoever waits for it takes over, and may fail aloud."""
    # interrupts are for the process that was forked, which ends this one
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # the threads that torch had are not there any more
    torch.set_num_threads(1)
    parent = os.getppid()
    code = 1
    try:
        # copies of what the other process reads from: with them, nobody would know that it is gone
        for reader in readers:
            reader.close()
        for item in items:
            with torch.no_grad():
                writer.send(tuple(part.numpy() for part in function(item)))
            if os.getppid() != parent:
                break
        code = 0
    finally:
        # nothing of what the other process has open is to be closed or flushed here
        os._exit(code)
