"""Long batches in pieces that stay in the cache, each on one thread."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

# what a few columns are worked on in
Array: TypeAlias = NDArray[Any]
Mask: TypeAlias = NDArray[np.bool_]

# configurations worked on together: few enough for the cache, enough that a torch call costs less than its arithmetic
_ON_CPU = 6000
_ON_GPU = 1 << 18
# so many times as much work keeps a GPU's processors busy as the CPU's
_TIMES_ON_GPU = 16
# of x, y, z the next one and the one before, for cross products: those of numpy take three times as long for a few
NEXT, LAST = np.array([1, 2, 0]), np.array([2, 0, 1])
# up to so many, on the CPU, the number of calls is the cost, not the arithmetic
FEW = 300
# of fewer numbers, einsum takes longer to begin than to sum
_FEW_ENTRIES = 300
# torch's threads, where operators run on one of them; 0 where they run on all
_threads: ContextVar[int] = ContextVar("threads", default=0)


def piece(device: torch.device) -> int:
    """How many columns are worked on together."""
    return _ON_CPU if device.type == "cpu" else _ON_GPU


def together(count: int, device: torch.device) -> int:
    """How much is worked on together where the CPU works on `count`."""
    return count if device.type == "cpu" else _TIMES_ON_GPU * count


def slices(count: int, device: torch.device) -> list[slice]:
    """As few equal pieces of `count` columns as keep to the size; one if there are none."""
    pieces = -(-count // piece(device)) or 1
    width = max(1, -(-count // pieces))
    return [slice(start, start + width) for start in range(0, max(count, 1), width)]


def are_few(columns: Tensor) -> bool:
    """Whether there are so few columns (…, N), on the CPU, that calls of numpy are faster than those of torch."""
    return columns.shape[-1] <= FEW and columns.device.type == "cpu"


def in_pieces(function: Callable[..., tuple[Tensor, ...]], *columns: Tensor) -> tuple[Tensor, ...]:
    """Applies a function to pieces of tensors (…, N) and joins what it returns, along the last axis.

    Args:
        function: Takes as many tensors as are given, and gives tensors (…, M) for pieces (…, M).
        columns: Tensors with equal last axes.
    """
    count = columns[0].shape[-1]
    first, *others = slices(count, columns[0].device)
    with one_thread():
        results = function(*(tensor[..., first] for tensor in columns))
        if not others:
            return results
        # pieces are copied to their place at once: to keep them all and join them would take the memory twice
        joined = tuple(result.new_empty(*result.shape[:-1], count) for result in results)
        for part in (first, *others):
            if part is not first:
                results = function(*(tensor[..., part] for tensor in columns))
            for whole, result in zip(joined, results, strict=True):
                whole[..., part] = result
        return joined


@contextmanager
def one_thread() -> Iterator[None]:
    """Runs torch's operators on one thread, and gives the caller's threads back.

    At these sizes it takes longer to wake a second thread than to do its half of an operator's work.
    """
    threads = torch.get_num_threads()
    outside = _threads.set(cores())
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        _threads.reset(outside)


def cores() -> int:
    """How many threads torch may use here, those included that `one_thread` leaves idle."""
    return _threads.get() or torch.get_num_threads()


def some(mask: Mask) -> bool:
    """Whether any is true; a third of the time that `mask.any()` takes, which is written in Python."""
    return np.count_nonzero(mask) != 0


def norms(motion: Array) -> Array:
    """Norms (…,) over the last axis; a fifth of the time that numpy.linalg's function takes."""
    if motion.size < _FEW_ENTRIES:
        return np.sqrt((motion * motion).sum(-1))
    return np.sqrt(np.einsum("...k,...k->...", motion, motion))
