"""Safetensors files: read whole with all that may be wrong with them, or written row by row in bounded memory."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError, safe_open
from torch import Tensor

from grr_torch.errors import FileFormatError

Array = npt.NDArray[Any]

_DTYPES = {"float64": "F64", "float32": "F32", "int64": "I64", "uint8": "U8", "bool": "BOOL"}


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
    if not Path(path).is_file():
        raise FileFormatError(path, "is not a file")
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            if header.get("format") != json.dumps(kind):
                raise FileFormatError(path, f"is not {name} of grr-torch")
            found = json.loads(header.get("format_version", "null"))
            if found != version:
                raise FileFormatError(path, f"is of format version {found}; this version reads {version}")
            metadata = {key: json.loads(value) for key, value in header.items()}
            names = list(file.keys())
            return metadata, {name: file.get_tensor(name) for name in names}
    except SafetensorError as error:
        raise FileFormatError(path, f"is truncated or not {name}: {error}") from error
    except (json.JSONDecodeError, OSError) as error:
        raise FileFormatError(path, f"cannot be read: {error}") from error


@contextmanager
def stream_tensors(path: Path, count: int, metadata: Mapping[str, str]) -> Iterator[Callable[[dict[str, Array]], None]]:
    """Gives a function that appends rows to the tensors of a safetensors file.

    The format is a header's length in 8 bytes, the header in JSON, and the tensors one after the other; as the number
    of rows is known, so is each tensor's place.

    Args:
        path: The file.
        count: How many rows there will be.
        metadata: Of the file.
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

        yield write


def _lay_out(count: int, metadata: Mapping[str, str], arrays: Mapping[str, Array]) -> tuple[bytes, dict[str, int]]:
    """The bytes before the tensors, and where each tensor begins."""
    header: dict[str, Any] = {"__metadata__": dict(metadata)}
    # the widest first, so that each lies at a multiple of its size
    names = sorted(arrays, key=lambda name: (-arrays[name].itemsize, name))
    end = 0
    for name in names:
        start, end = end, end + count * arrays[name][:1].nbytes
        shape = [count, *arrays[name].shape[1:]]
        header[name] = {"dtype": _DTYPES[str(arrays[name].dtype)], "shape": shape, "data_offsets": [start, end]}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    before = len(text).to_bytes(8, "little") + text
    return before, {name: len(before) + header[name]["data_offsets"][0] for name in names}
