"""Timing fairly: what is compared runs by turns, so that a busy machine slows all of it."""

from __future__ import annotations

import gc
import multiprocessing
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import torch

from grr_torch.resolution.memory import peak_memory
from grr_torch.version import __version__

# shorter calls are repeated until so much time has passed [s]
_SHORTEST = 0.1


def median_seconds(calls: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Median time of each call [s]. They run by turns; each ran once before."""
    for call in calls.values():
        call()
    loops = {name: _loops(call) for name, call in calls.items()}
    times: dict[str, list[float]] = {name: [] for name in calls}
    gc.collect()
    gc.disable()
    try:
        for _ in range(repeats):
            for name, call in calls.items():
                begin = time.perf_counter()
                for _ in range(loops[name]):
                    call()
                times[name].append((time.perf_counter() - begin) / loops[name])
    finally:
        gc.enable()
    return {name: statistics.median(values) for name, values in times.items()}


def _loops(call: Callable[[], Any]) -> int:
    begin = time.perf_counter()
    call()
    return max(1, int(_SHORTEST / max(time.perf_counter() - begin, 1e-9)))


def median_process_seconds(commands: Mapping[str, Sequence[str]], repeats: int) -> dict[str, float]:
    """Median time of whole Python processes [s], each given by its arguments. They run by turns."""
    times: dict[str, list[float]] = {name: [] for name in commands}
    environment = {**os.environ, "OMP_NUM_THREADS": str(torch.get_num_threads())}
    for turn in range(repeats + 1):
        for name, arguments in commands.items():
            begin = time.perf_counter()
            subprocess.run([sys.executable, *arguments], check=True, capture_output=True, env=environment)
            # the first turn fills the file cache
            if turn:
                times[name].append(time.perf_counter() - begin)
    return {name: statistics.median(values) for name, values in times.items()}


def in_fresh_process(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """What a function returns in a process of its own, and the most memory that process held [MiB]."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_with_memory, function, torch.get_num_threads(), arguments).result()


def _with_memory(function: Callable[..., Any], threads: int, arguments: tuple[Any, ...]) -> tuple[Any, float]:
    torch.set_num_threads(threads)
    return function(*arguments), peak_memory()


def machine() -> dict[str, str]:
    """Processor, threads and versions, for the head of a table."""
    names = {
        line.split(":")[1].strip()
        for line in (Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else [])
        if line.startswith("model name")
    }
    found = {
        "processor": ", ".join(sorted(names)) or platform.processor() or platform.machine(),
        "cores": str(multiprocessing.cpu_count()),
        "threads": str(torch.get_num_threads()),
        "Python": platform.python_version(),
        "torch": torch.__version__,
        "grr-torch": __version__,
    }
    if torch.cuda.is_available():
        found["GPU"] = torch.cuda.get_device_name()
    return found
