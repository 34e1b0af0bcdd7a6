"""Tensors in a safetensors file: written in pieces, mapped when they are read."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from grr_torch.errors import FileFormatError
from grr_torch.output import atomic_write

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
        raise FileFormatError(path, "is not a file")
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


def _pieces(tensor: Tensor) -> Iterator[memoryview]:
    """A tensor's bytes, a piece at a time."""
    if tensor.numel() == 0:
        return
    # a tensor whose memory is laid out otherwise would be written wrongly
    flat = tensor.detach().contiguous().reshape(-1).view(torch.uint8)
    for start in range(0, len(flat), _AT_ONCE):
        yield flat[start : start + _AT_ONCE].numpy().data
