"""Safetensors files: mapped with all that may be wrong with them, written in pieces, or row by row."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from grr_torch.errors import FileFormatError
from grr_torch.output import atomic_write
from grr_torch.tables import Array, Write, counted

_NAMES = {
    torch.float64: "F64",
    torch.float32: "F32",
    torch.int64: "I64",
    torch.int32: "I32",
    torch.uint8: "U8",
    torch.bool: "BOOL",
}
# bytes that are written or hashed at once
_AT_ONCE = 1 << 24


def read_tensor_file(
    path: str | os.PathLike[str], kind: str, version: int, name: str
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Metadata, each value of it JSON, and tensors of a safetensors file that grr-torch wrote.

    Args:
        path: The file.
        kind: What its metadata must have as `format`.
        version: What its metadata must have as `format_version`.
        name: What such a file is called in messages, with an article.

    Raises:
        FileFormatError: It is missing, truncated, of another version, or no such file.
    """
    header, tensors = read_tensors(path, name)
    if header.get("format") != json.dumps(kind):
        raise FileFormatError(path, f"is not {name} of grr-torch")
    try:
        found = json.loads(header.get("format_version", "null"))
        if found != version:
            raise FileFormatError(path, f"is of format version {found}; this version reads {version}")
        return {key: json.loads(value) for key, value in header.items()}, tensors
    except json.JSONDecodeError as error:
        raise FileFormatError(path, f"cannot be read: {error}") from error


def write_tensors(
    path: str | os.PathLike[str], tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None
) -> None:
    """Writes tensors on the CPU to one file, by an atomic rename; no copy of them is made.

    The library's own writer holds all of them a second time, as bytes.

    Raises:
        OutputError: It cannot be written.
    """
    # as the library does it: the widest numbers first, so that each is aligned
    names = sorted(tensors, key=lambda name: (-tensors[name].element_size(), name))
    header: dict[str, object] = {"__metadata__": dict(metadata or {})}
    end = 0
    for name in names:
        tensor = tensors[name]
        begin, end = end, end + tensor.numel() * tensor.element_size()
        header[name] = {"dtype": _NAMES[tensor.dtype], "shape": list(tensor.shape), "data_offsets": [begin, end]}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(len(text).to_bytes(8, "little"))
        file.write(text)
        for name in names:
            for piece in _pieces(tensors[name]):
                file.write(piece)


def read_tensors(path: str | os.PathLike[str], what: str) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Metadata and tensors of a file. The tensors are mapped: of the file, only what is used is read.

    Args:
        path: The file.
        what: What it should be, for errors.

    Raises:
        FileFormatError: It is missing, truncated or no such file.
    """
    if not Path(path).is_file():
        raise FileFormatError(path, "is not a regular file" if Path(path).exists() else "does not exist")
    try:
        with safe_open(path, framework="pt") as file:
            names = list(file.keys())
            return dict(file.metadata() or {}), {name: file.get_tensor(name) for name in names}
    except SafetensorError as error:
        raise FileFormatError(path, f"is truncated or not {what}: {error}") from error
    except OSError as error:
        raise FileFormatError(path, f"cannot be read: {error}") from error


def tensor_hash(tensor: Tensor) -> str:
    """SHA-256 over shape, type and bytes of a tensor."""
    digest = hashlib.sha256(f"{tuple(tensor.shape)} {tensor.dtype}".encode())
    for piece in _pieces(tensor):
        digest.update(piece)
    return digest.hexdigest()


def tensors_hash(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 over names, shapes, types and bytes of all tensors."""
    hashes = {name: tensor_hash(tensors[name]) for name in sorted(tensors)}
    return hashlib.sha256(json.dumps(hashes).encode()).hexdigest()


def _pieces(tensor: Tensor) -> Iterator[memoryview]:
    """A tensor's bytes, a piece at a time."""
    if tensor.numel() == 0:
        return
    # a tensor whose memory is laid out otherwise would be written wrongly
    flat = tensor.detach().contiguous().reshape(-1).view(torch.uint8)
    for start in range(0, len(flat), _AT_ONCE):
        yield flat[start : start + _AT_ONCE].numpy().data


@contextmanager
def stream_tensors(path: Path, count: int, metadata: Mapping[str, str]) -> Iterator[Write]:
    """Gives a function that appends rows to the tensors of a safetensors file.

    The format is a header's length in 8 bytes, the header in JSON, and the tensors one after the other; as the number
    of rows is known, so is each tensor's place.

    Args:
        path: The file.
        count: How many rows there will be.
        metadata: Of the file.

    Raises:
        ParameterError: `count` is not how many were written.
    """
    starts: dict[str, int] = {}
    done = 0
    with path.open("wb") as file:

        def write(arrays: dict[str, Array]) -> None:
            nonlocal done
            if not starts:
                header, offsets = _lay_out(count, metadata, arrays)
                file.write(header)
                starts.update(offsets)
            for name, rows in arrays.items():
                file.seek(starts[name] + done * (rows[:1].nbytes))
                file.write(np.ascontiguousarray(rows).data)
            done += len(next(iter(arrays.values())))

        with counted(write, count) as write_counted:
            yield write_counted


def _lay_out(count: int, metadata: Mapping[str, str], arrays: Mapping[str, Array]) -> tuple[bytes, dict[str, int]]:
    """The bytes before the tensors, and where each tensor begins."""
    header: dict[str, Any] = {"__metadata__": dict(metadata)}
    # the widest first, so that each lies at a multiple of its size
    names = sorted(arrays, key=lambda name: (-arrays[name].itemsize, name))
    end = 0
    for name in names:
        start, end = end, end + count * arrays[name][:1].nbytes
        shape = [count, *arrays[name].shape[1:]]
        header[name] = {
            "dtype": _NAMES[torch.from_numpy(arrays[name][:0]).dtype],
            "shape": shape,
            "data_offsets": [start, end],
        }
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    before = len(text).to_bytes(8, "little") + text
    return before, {name: len(before) + header[name]["data_offsets"][0] for name in names}
