"""Readers of tables, one for each kind of file: the columns that are wanted, in pieces, as float64."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from csv import reader as csv_rows
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from grr_torch.errors import FileFormatError

# rows of a piece, and characters of a text
_ROWS, _CHARACTERS = 1 << 14, 1 << 20
_DELIMITERS = (",", ";", "\t")

Array = npt.NDArray[Any]


def read_text(path: Path, names: Sequence[str] | None) -> Iterator[Array]:
    """Rows of text; blanks part values where there is no other delimiter, and what follows a # is a comment."""
    from pyarrow import csv, float64

    with path.open(encoding="utf-8-sig") as file:
        first = next(filter(None, map(_content, file)), "")
        if not first:
            return
        delimiter = next((mark for mark in _DELIMITERS if mark in first), ",")
        cells = [cell.strip() for cell in next(csv_rows([_parted(first, delimiter)], delimiter=delimiter))]
        header = _is_header(path, cells, names)
        if not header:
            _check_width(path, len(cells), names)
        # columns that are not wanted may share a name
        labels = [str(k) for k in range(len(cells))]
        wanted = [labels[k] for k in _wanted(path, cells, names)] if header else labels
        options = (
            # with threads of its own, it aborts a process that ends soon after, once in fifty times
            csv.ReadOptions(column_names=labels, use_threads=False),
            csv.ParseOptions(delimiter=delimiter),
            csv.ConvertOptions(include_columns=wanted, column_types=dict.fromkeys(wanted, float64())),
        )
        before = "" if header else first + "\n"
        while text := before + file.read(_CHARACTERS) + file.readline():
            before = ""
            if "#" in text or " " in text or ("\t" in text and delimiter != "\t"):
                text = "\n".join(_parted(_content(line), delimiter) for line in text.split("\n"))
            if text.strip():
                table = csv.read_csv(BytesIO(text.encode()), *options)
                yield np.column_stack([column.to_numpy() for column in table.columns])


def read_parquet(path: Path, names: Sequence[str] | None) -> Iterator[Array]:
    """Columns of a .parquet."""
    from pyarrow import parquet, types

    file = parquet.ParquetFile(path)
    found = file.schema_arrow.names
    wanted = [found[k] for k in _wanted(path, found, names)]
    if any(found.count(name) > 1 for name in wanted):
        raise FileFormatError(path, f"has columns named {', '.join(found)}; valid: names that differ")
    for name in wanted:
        kind = file.schema_arrow.field(name).type
        if not (types.is_floating(kind) or types.is_integer(kind)):
            raise FileFormatError(path, f"column '{name}' holds {kind}; valid: numbers")
    for batch in file.iter_batches(_ROWS, columns=wanted, use_threads=False):
        columns = [batch.column(name).to_numpy(zero_copy_only=False) for name in wanted]
        yield np.column_stack(columns).astype(np.float64)


def read_npy(path: Path, names: Sequence[str] | None) -> Iterator[Array]:
    """Rows of a table, or fields of an array of structures, in a .npy."""
    table = np.load(path, mmap_mode="r", allow_pickle=False)
    if not isinstance(table, np.ndarray):
        raise FileFormatError(path, "holds several arrays; valid: one")
    found = table.dtype.names
    wanted = None
    width = None if names is None else len(names)
    if found is not None and table.ndim == 1:
        wanted = [found[k] for k in _wanted(path, found, names)]
    elif table.dtype.kind not in "fiu" or table.ndim != 2 or table.shape[1] != (width or table.shape[1]):
        kind = f"shape {table.shape} of {table.dtype}"
        raise FileFormatError(path, f"holds an array of {kind}; valid: (N, {width or 'n'}), numbers")
    for start in range(0, len(table), _ROWS):
        piece = table[start : start + _ROWS]
        columns = piece if wanted is None else np.column_stack([piece[name] for name in wanted])
        yield np.array(columns, dtype=np.float64)


def _wanted(path: Path, found: Sequence[str], names: Sequence[str] | None) -> list[int]:
    """Places, among the columns found, of those that are wanted, in the order of `names`."""
    if names is None:
        raise FileFormatError(path, f"has columns named {', '.join(found)}; valid: rows of numbers, without a header")
    places = [[k for k, other in enumerate(found) if other == name] for name in names]
    if any(len(same) != 1 for same in places):
        places = [[k for k, other in enumerate(found) if other.casefold() == name.casefold()] for name in names]
    chosen = [k for same in places for k in same]
    if not chosen:
        _check_width(path, len(found), names)
        return list(range(len(found)))
    if any(len(same) != 1 for same in places) or len(set(chosen)) < len(names):
        valid = f"each of {', '.join(names)} once, or none of them and {len(names)} columns"
        raise FileFormatError(path, f"has columns named {', '.join(found)}; valid: {valid}")
    return chosen


def _is_header(path: Path, cells: Sequence[str], names: Sequence[str] | None) -> bool:
    """Whether the first line says what the columns are: it has a wanted name, or no number."""
    wanted = {name.casefold() for name in names or ()}
    texts = [cell for cell in cells if not _is_number(cell)]
    if not texts or wanted & {cell.casefold() for cell in cells}:
        return bool(texts)
    if any(map(_is_number, filter(None, cells))):
        raise FileFormatError(
            path, f"row 1 holds {', '.join(map(repr, texts))}; valid: numbers, or a header without any"
        )
    return True


def _check_width(path: Path, width: int, names: Sequence[str] | None) -> None:
    if names is not None and width != len(names):
        raise FileFormatError(path, f"has {width} columns; valid: {len(names)}, or columns named {', '.join(names)}")


def _content(line: str) -> str:
    """A line without its comment; after a quote there is none."""
    before = line.partition("#")[0]
    return (line if '"' in before else before).strip()


def _parted(line: str, delimiter: str) -> str:
    """A line whose values a delimiter parts."""
    return line if delimiter in line or '"' in line else delimiter.join(line.split())


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return text == ""
    return True
