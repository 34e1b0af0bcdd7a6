"""A device that is not there: what a GPU is asked to do, done on the CPU, and every transfer counted.

Its tensors say that they lie on "gpu:0". They compute as those on the CPU do, but an operation that mixes both fails as
it would on a GPU. So code can be shown to keep its tensors where they belong, and to move few of them, without a GPU.

Torch knows of it from import on, and until the process ends. It is for one thread, and not for beside a real GPU. It
needs a part of torch that is not of its stable interface. `AVAILABLE` says whether it is there.
"""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import grr_torch
from grr_torch.spaces import lattice

try:
    from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

    AVAILABLE = not torch.cuda.is_available()
except ImportError:
    AVAILABLE = False

NAME = "gpu"
_aten = torch.ops.aten
# indices may lie on the CPU; they are transferred
_INDEXED = (_aten.index, _aten.index_put, _aten.index_put_, _aten._index_put_impl_)
_PACKAGE = os.path.join(os.path.dirname(grr_torch.__file__), "")
# besides those, these take numbers that are tensors of no dimension from the CPU, as pointwise operations do
_TAKE_NUMBERS = (*_INDEXED, _aten.fill_, _aten.masked_fill, _aten.masked_fill_)


class Moved(Tensor):
    """A tensor on the device that is not there; `held` is the one on the CPU that has its values."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> Moved:
        layout = {"strides": held.stride(), "storage_offset": held.storage_offset(), "dtype": held.dtype}
        return Tensor._make_wrapper_subclass(cls, held.shape, device=f"{NAME}:0", **layout)

    def __init__(self, held: Tensor):
        self.held = held

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        return _computed(function, args, kwargs or {})

    def tolist(self):
        return self.cpu().tolist()

    def __repr__(self) -> str:
        return f"Moved({self.held})"


class Transfers:
    """What was moved between the device and the CPU.

    Attributes:
        moved: How often, by "to" or "from" the device and the place in the package that asked for it, "file.py:line".
    """

    def __init__(self) -> None:
        self.moved: Counter[tuple[str, str]] = Counter()

    def count(self, way: str) -> None:
        """Counts a transfer "to" or "from" the device."""
        self.moved[way, _place()] += 1

    def within(self, *files: str) -> dict[tuple[str, str], int]:
        """Of `moved`, what these files of the package asked for."""
        return {key: count for key, count in self.moved.items() if key[1].split(":")[0] in files}

    def outside(self, *files: str) -> int:
        """How often anything was moved that these files did not ask for."""
        return self.moved.total() - sum(self.within(*files).values())


_transfers = Transfers()


def _place() -> str:
    frame = sys._getframe(1)
    while frame is not None:
        if frame.f_code.co_filename.startswith(_PACKAGE):
            return f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}"
        frame = frame.f_back
    return "elsewhere"


def _held(value):
    return value.held if isinstance(value, Moved) else value


def _is_there(device) -> bool:
    return device is not None and torch.device(device).type == NAME


def _computed(function, args, kwargs):
    name = function.overloadpacket
    if name is _aten._to_copy:
        return _copied(*args, **kwargs)
    if name is _aten.copy_:
        target, source = args[:2]
        if isinstance(target, Moved) != isinstance(source, Moved):
            _transfers.count("to" if isinstance(target, Moved) else "from")
        _held(target).copy_(_held(source))
        return target
    given: list[Tensor] = []
    held = [_mapped(lambda value: given.append(value) or _held(value), part) for part in (args, *kwargs.values())]
    ours = [value for value in given if isinstance(value, Moved)]
    takes_numbers = torch.Tag.pointwise in function.tags or name in _TAKE_NUMBERS
    indices = [id(index) for index in args[1]] if name in _INDEXED and isinstance(args[0], Moved) else ()
    for value in given if ours else ():
        if isinstance(value, Moved) or (value.ndim == 0 and takes_numbers):
            continue
        if id(value) not in indices:
            shapes = [tuple(one.shape) for one in ours]
            raise RuntimeError(f"{function}: of its tensors, {shapes} are on {NAME}, {tuple(value.shape)} is not")
        _transfers.count("to")
    device = kwargs.get("device")
    named = dict(zip(kwargs, held[1:], strict=True))
    out = function(*held[0], **({**named, "device": "cpu"} if device else named))
    if not (_is_there(device) if device else ours):
        return out
    # what was changed in place stays the tensor that it is
    same = {id(value.held): value for value in ours}
    return _mapped(lambda value: same[id(value)] if id(value) in same else Moved(value), out)


def _mapped(change, value):
    """A value, or a list or tuple of them, with its tensors changed."""
    if isinstance(value, list | tuple):
        return type(value)([_mapped(change, part) for part in value])
    return change(value) if isinstance(value, Tensor) else value


def _copied(source: Tensor, *, device=None, pin_memory=None, **kwargs) -> Tensor:
    out = _aten._to_copy(_held(source), **kwargs, device="cpu")
    there = isinstance(source, Moved) if device is None else _is_there(device)
    if there != isinstance(source, Moved):
        _transfers.count("to" if there else "from")
    return Moved(out) if there else out


class _NewTensors(TorchDispatchMode):
    """Tensors that are made of nothing are made on the device, if they are asked for there."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        return _computed(function, args, kwargs or {})


def _from_lists(library: torch.library.Library) -> None:
    """Lists of numbers are copied to the device by calls that no mode sees."""

    def empty_strided(size, stride, dtype=None, layout=None, device=None, pin_memory=None):
        return Moved(torch.empty_strided(size, stride, dtype=dtype))

    def copy_from(source, target, non_blocking=False):
        _transfers.count("to")
        target.held.copy_(source)
        return target

    library.impl("empty_strided", empty_strided, "PrivateUse1")
    library.impl("_copy_from", copy_from, "PrivateUse1")


# before the first tensor is differentiated: from then on, torch's engine knows no more devices
if AVAILABLE:
    _setup_privateuseone_for_python_backend(NAME)
    _library = torch.library.Library("aten", "IMPL")
    _from_lists(_library)


@contextmanager
def stand_in() -> Iterator[Transfers]:
    """Within it there is a device `NAME`; tells what is moved."""
    global _transfers
    _transfers = Transfers()
    # what goes to a device once would count in one test and not in the next
    lattice._stencil.cache_clear()
    with _NewTensors():
        yield _transfers
