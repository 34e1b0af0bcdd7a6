"""Tables in files: .csv, .npy, .npz and .parquet, read and written in pieces, so that memory stays bounded."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from csv import reader as csv_rows
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from grr_torch.errors import FileFormatError, ParameterError
from grr_torch.output import atomic_write

# rows of a piece
PIECE = 1 << 14
AXES = ("x", "y", "z")
_READS = (".csv", ".npy", ".parquet")
_WRITES = (".csv", ".npy", ".npz", ".parquet")
_DELIMITERS = (",", ";", "\t")

Array = npt.NDArray[Any]
# names of a table's columns by the array that they make up
Columns = Mapping[str, Sequence[str]]


def check_suffix(name: str, path: Path, *, read: bool = False) -> None:
    """Finds out whether a file's kind is known.

    Raises:
        ParameterError: It is not.
    """
    known = _READS if read else _WRITES
    if path.suffix.lower() not in known:
        raise ParameterError(name, path, f"a file that ends in {', '.join(known)}")


def read_points(path: Path, width: int, axes: Sequence[str] = AXES) -> Iterator[Array]:
    """Points of a file in pieces (N, width), finite, float64.

    A .csv may have a header. Columns named like the coordinates are taken where there are such; else there must be as
    many columns as coordinates.

    Args:
        path: The file.
        width: How many coordinates a point has.
        axes: Their names.

    Raises:
        ParameterError: The suffix is not known.
        FileFormatError: It cannot be read, is not a table of numbers, has the wrong columns, holds NaN, or no point.
    """
    check_suffix("points", path, read=True)
    if not path.is_file():
        raise FileFormatError(path, "is not a regular file" if path.exists() else "is not a file")
    reader = {".csv": _read_csv, ".npy": _read_npy, ".parquet": _read_parquet}[path.suffix.lower()]
    rows = 0
    try:
        for piece in reader(path, axes[:width]):
            bad = np.flatnonzero(~np.isfinite(piece).all(1))
            if len(bad):
                raise FileFormatError(path, f"row {rows + int(bad[0]) + 1} holds NaN, infinite or missing values")
            rows += len(piece)
            yield piece
    except OSError as error:
        raise FileFormatError(path, f"cannot be read: {error.strerror or error}") from error
    except (ValueError, EOFError, MemoryError) as error:
        raise FileFormatError(path, f"is not a table of numbers: {str(error).splitlines()[0]}") from error
    if rows == 0:
        raise FileFormatError(path, "holds no points")


@contextmanager
def table_writer(
    path: Path,
    columns: Columns,
    count: int,
    constants: Mapping[str, Array] | None = None,
    *,
    metadata: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
) -> Iterator[Callable[[dict[str, Array]], None]]:
    """Gives a function that appends rows to a table, which appears when all are written, or not at all.

    A .npy holds a structured array with the columns as fields, a .npz one array for each key of `columns`.

    Args:
        path: The file.
        columns: Names of the columns by array.
        count: How many rows there will be.
        constants: Further arrays, for an .npz.
        metadata: Texts for the schema of a .parquet.
        units: Units of columns, for the fields of a .parquet.

    Raises:
        ParameterError: The suffix is not known.
        OutputError: It cannot be written.
    """
    check_suffix("output", path)
    with ExitStack() as stack:
        temporary = stack.enter_context(atomic_write(path))
        suffix = path.suffix.lower()
        if suffix == ".npy":
            yield stack.enter_context(_write_npy(temporary, columns, count))
        elif suffix == ".npz":
            yield stack.enter_context(_write_npz(temporary, count, constants or {}))
        else:
            yield stack.enter_context(_write_arrow(temporary, columns, suffix, metadata, units or {}))


def unique_names(joints: Sequence[str], taken: Iterable[str]) -> list[str]:
    """Names for joint columns: the joints' own, with a prefix if one of them is taken."""
    return [f"joint {name}" for name in joints] if set(joints) & set(taken) else list(joints)


def _wanted(path: Path, names: Sequence[str], axes: Sequence[str]) -> list[str]:
    """The columns that are a point's coordinates."""
    if set(axes) <= set(names):
        return list(axes)
    if len(names) != len(axes):
        raise FileFormatError(path, f"has {len(names)} columns; valid: {len(axes)}, or columns named {', '.join(axes)}")
    return list(names)


def _read_csv(path: Path, axes: Sequence[str]) -> Iterator[Array]:
    from pyarrow import csv, float64

    with path.open(encoding="utf-8-sig") as file:
        above, first = next(((k, line.strip()) for k, line in enumerate(file) if line.strip()), (0, ""))
    if not first:
        return
    delimiter = next((mark for mark in _DELIMITERS if mark in first), ",")
    cells = [cell.strip() for cell in next(csv_rows([first], delimiter=delimiter))]
    header = not all(map(_is_number, cells))
    names = cells if header else [str(k) for k in range(len(cells))]
    wanted = _wanted(path, names, axes)
    reader = csv.open_csv(
        path,
        # a header is skipped, so that names are those that were found here
        read_options=csv.ReadOptions(column_names=names, skip_rows=above + 1 if header else 0, block_size=1 << 20),
        parse_options=csv.ParseOptions(delimiter=delimiter),
        convert_options=csv.ConvertOptions(include_columns=wanted, column_types=dict.fromkeys(wanted, float64())),
    )
    for batch in reader:
        yield np.column_stack([column.to_numpy(zero_copy_only=False) for column in batch.columns])


def _read_parquet(path: Path, axes: Sequence[str]) -> Iterator[Array]:
    from pyarrow import parquet, types

    file = parquet.ParquetFile(path)
    wanted = _wanted(path, file.schema_arrow.names, axes)
    for name in wanted:
        kind = file.schema_arrow.field(name).type
        if not (types.is_floating(kind) or types.is_integer(kind)):
            raise FileFormatError(path, f"column '{name}' holds {kind}; valid: numbers")
    for batch in file.iter_batches(PIECE, columns=wanted):
        columns = [batch.column(name).to_numpy(zero_copy_only=False) for name in wanted]
        yield np.column_stack(columns).astype(np.float64)


def _read_npy(path: Path, axes: Sequence[str]) -> Iterator[Array]:
    table = np.load(path, mmap_mode="r", allow_pickle=False)
    names = table.dtype.names
    wanted = None
    if names is not None and table.ndim == 1:
        wanted = _wanted(path, names, axes)
    elif table.dtype.kind not in "fiu" or table.ndim != 2 or table.shape[1] != len(axes):
        kind = f"shape {table.shape} of {table.dtype}"
        raise FileFormatError(path, f"holds an array of {kind}; valid: (N, {len(axes)}), numbers")
    for start in range(0, len(table), PIECE):
        piece = table[start : start + PIECE]
        columns = piece if wanted is None else np.column_stack([piece[name] for name in wanted])
        yield np.array(columns, dtype=np.float64)


@contextmanager
def _write_arrow(
    path: Path, columns: Columns, suffix: str, metadata: Mapping[str, str] | None, units: Mapping[str, str]
) -> Iterator[Callable[[dict[str, Array]], None]]:
    import pyarrow
    from pyarrow import csv, parquet

    names = [name for group in columns.values() for name in group]
    writer: Any = None
    try:

        def write(arrays: dict[str, Array]) -> None:
            nonlocal writer
            values = [part for group in columns for part in _parts(arrays[group])]
            parts = [pyarrow.array(np.ascontiguousarray(part)) for part in values]
            fields = [pyarrow.field(name, part.type) for name, part in zip(names, parts, strict=True)]
            fields = [part.with_metadata({"unit": units[part.name]}) if part.name in units else part for part in fields]
            table = pyarrow.table(parts, schema=pyarrow.schema(fields, metadata=metadata))
            if writer is None:
                quotes = "needed" if set(',"\r\n') & set("".join(names)) else "none"
                plain = csv.WriteOptions(quoting_style=quotes, quoting_header=quotes)
                writer = (
                    csv.CSVWriter(path, table.schema, write_options=plain)
                    if suffix == ".csv"
                    else parquet.ParquetWriter(path, table.schema)
                )
            writer.write_table(table)

        yield write
    finally:
        if writer is not None:
            writer.close()


@contextmanager
def _write_npy(path: Path, columns: Columns, count: int) -> Iterator[Callable[[dict[str, Array]], None]]:
    table: Any = None
    done = 0

    def write(arrays: dict[str, Array]) -> None:
        nonlocal table, done
        parts = [part for group in columns for part in _parts(arrays[group])]
        names = [name for group in columns.values() for name in group]
        if table is None:
            kind = np.dtype([(name, _stored(part)) for name, part in zip(names, parts, strict=True)])
            table = np.lib.format.open_memmap(path, mode="w+", dtype=kind, shape=(count,))
        for name, part in zip(names, parts, strict=True):
            table[name][done : done + len(part)] = part
        done += len(parts[0])

    yield write
    if table is not None:
        table.flush()


@contextmanager
def _write_npz(path: Path, count: int, constants: Mapping[str, Array]) -> Iterator[Callable[[dict[str, Array]], None]]:
    """Arrays grow on the disk beside the file, and are put into it at the end."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f"{path.name}.") as folder, ExitStack() as stack:
        files: dict[str, Any] = {}
        kinds: dict[str, Any] = {}

        def write(arrays: dict[str, Array]) -> None:
            for group, part in arrays.items():
                if group not in files:
                    kinds[group] = _stored(part)
                    files[group] = stack.enter_context((Path(folder) / f"{group}.npy").open("wb"))
                    descr = np.lib.format.dtype_to_descr(kinds[group])
                    about = {"descr": descr, "fortran_order": False, "shape": (count, *part.shape[1:])}
                    np.lib.format.write_array_header_1_0(files[group], about)
                files[group].write(np.ascontiguousarray(part, dtype=kinds[group]).tobytes())

        yield write
        for group, array in constants.items():
            np.save(Path(folder) / f"{group}.npy", array, allow_pickle=False)
        stack.close()
        with zipfile.ZipFile(path, "w") as file:
            for place in sorted(Path(folder).iterdir()):
                file.write(place, place.name)


def _parts(array: Array) -> list[Array]:
    return [array] if array.ndim == 1 else list(array.T)


def _stored(array: Array) -> np.dtype[Any]:
    """The type that holds later pieces too: texts may be longer there."""
    return np.dtype("<U16") if array.dtype.kind == "U" else array.dtype


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return text == ""
    return True
