"""Tables of numbers in files."""

from __future__ import annotations

import os
from pathlib import Path
from tokenize import TokenError
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from torch import Tensor

from grr_torch.errors import FileFormatError


def read_table(path: str | os.PathLike[str], row: str, *, header: bool = False) -> Tensor:
    """Reads a table: one row a line, commas or blanks between values (.csv, .txt), or .npy.

    Args:
        path: The file.
        row: What a row is, for messages.
        header: Whether the first line may be names.

    Returns:
        (rows, columns), at least one of each; values need not be finite.

    Raises:
        FileFormatError: It is missing or does not hold a table of numbers.
    """
    path = Path(path)
    try:
        table = np.load(path, allow_pickle=False) if path.suffix == ".npy" else _read_text(path, header)
    except OSError as error:
        raise FileFormatError(path, f"cannot be read: {error.strerror or error}") from error
    except (ValueError, EOFError, MemoryError, TokenError, BadZipFile) as error:
        reason = f"is not a table of numbers with rows of one length{'' if header else ', and no header'}"
        raise FileFormatError(path, reason) from error
    if not isinstance(table, np.ndarray) or table.ndim != 2 or table.size == 0 or table.dtype.kind not in "fi":
        raise FileFormatError(path, f"is not a table of numbers with one {row} a row")
    return torch.from_numpy(table.astype(np.float64))


def _read_text(path: Path, header: bool) -> np.ndarray[Any, np.dtype[np.float64]]:
    lines = [line.split("#")[0].strip() for line in path.read_text(encoding="utf-8-sig").splitlines()]
    rows = [line.split(",") if "," in line else line.split() for line in lines if line]
    if header and rows and not any(map(_is_number, rows[0])):
        rows = rows[1:]
    return np.array([[float(value) for value in row] for row in rows], dtype=np.float64)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
