"""Tables in files: .csv, .npy, .npz and .parquet, read and written in pieces, so that memory stays bounded."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from csv import Error as CsvError
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
import numpy.typing as npt

from grr_torch.errors import FileFormatError, ParameterError, check_whole
from grr_torch.output import atomic_write
from grr_torch.table_readers import read_npy, read_parquet, read_text

# rows of a piece
PIECE = 1 << 14
_READS = (".csv", ".npy", ".parquet")
_WRITES = (".csv", ".npy", ".npz", ".parquet")

Array = npt.NDArray[Any]
Write = Callable[[dict[str, Array]], None]
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


def read_points(path: Path, axes: Sequence[str]) -> Iterator[Array]:
    """Points of a file in pieces (N, width); see `read_rows`.

    Args:
        path: The file.
        axes: Names of a point's coordinates.

    Raises:
        ParameterError: The suffix is not known.
        FileFormatError: As `read_rows` has it.
    """
    check_suffix("points", path, read=True)
    yield from read_rows(path, axes, "points")


def read_rows(path: Path, names: Sequence[str] | None, what: str) -> Iterator[Array]:
    """Rows of a .npy, a .parquet, or else a text file, in pieces (N, width), finite, float64.

    In a text file, commas, semicolons, tabs or blanks part the values; what follows a # is a comment, and a header may
    say what the columns are. Of columns that have names, in a header or otherwise, those with the given ones are taken,
    in whatever order and case; where none is so named, all are, of which there must be as many.

    Args:
        path: The file.
        names: Names of the columns that are wanted; None: any number of columns, which have no names.
        what: What a row is called in errors, in the plural.

    Raises:
        FileFormatError: It cannot be read, is not a table of numbers, has the wrong columns, holds NaN, or no row.
    """
    if not path.is_file():
        raise FileFormatError(path, "is not a regular file" if path.exists() else "does not exist")
    reader = {".npy": read_npy, ".parquet": read_parquet}.get(path.suffix.lower(), read_text)
    rows = 0
    try:
        for piece in reader(path, names):
            bad = np.flatnonzero(~np.isfinite(piece).all(1))
            if len(bad):
                raise FileFormatError(path, f"row {rows + int(bad[0]) + 1} holds NaN, infinite or missing values")
            rows += len(piece)
            yield piece
    except OSError as error:
        raise FileFormatError(path, f"cannot be read: {error.strerror or error}") from error
    except (ValueError, EOFError, MemoryError, CsvError, TokenError, zipfile.BadZipFile) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise FileFormatError(path, f"is not a table of numbers: {reason}") from error
    if rows == 0:
        raise FileFormatError(path, f"holds no {what}")


@contextmanager
def table_writer(
    path: Path,
    columns: Columns,
    count: int,
    constants: Mapping[str, Array] | None = None,
    *,
    metadata: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
) -> Iterator[Write]:
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
        ParameterError: The suffix is not known, there are to be no rows, or `count` is not how many were written.
        OutputError: It cannot be written.
    """
    check_suffix("output", path)
    count = check_whole("rows of a table", count, 1)
    with ExitStack() as stack:
        temporary = stack.enter_context(atomic_write(path))
        suffix = path.suffix.lower()
        if suffix == ".npy":
            write = stack.enter_context(_write_npy(temporary, columns, count))
        elif suffix == ".npz":
            write = stack.enter_context(_write_npz(temporary, count, constants or {}))
        else:
            write = stack.enter_context(_write_arrow(temporary, columns, suffix, metadata, units or {}))
        yield stack.enter_context(counted(write, count))


@contextmanager
def counted(write: Write, count: int) -> Iterator[Write]:
    """Gives a function that writes as `write` does, so many rows in all.

    Raises:
        ParameterError: There are more, or fewer when the block is left, or not equally many in each array.
    """
    done = 0

    def write_some(arrays: dict[str, Array]) -> None:
        nonlocal done
        lengths = {len(part) for part in arrays.values()}
        if len(lengths) != 1:
            raise ParameterError("rows of arrays", sorted(lengths), "equally many in each")
        rows = lengths.pop()
        if done + rows > count:
            raise ParameterError("rows of a table", f"{done + rows:,} or more", f"{count:,}")
        write(arrays)
        done += rows

    yield write_some
    if done != count:
        raise ParameterError("rows of a table", f"{done:,}", f"{count:,}")


def unique_names(joints: Sequence[str], taken: Iterable[str]) -> list[str]:
    """Names for joint columns: the joints' own, with a prefix if one of them is taken."""
    return [f"joint {name}" for name in joints] if set(joints) & set(taken) else list(joints)


@contextmanager
def _write_arrow(
    path: Path, columns: Columns, suffix: str, metadata: Mapping[str, str] | None, units: Mapping[str, str]
) -> Iterator[Write]:
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
                quotes = "needed" if set(',"\r\n#') & set("".join(names)) else "none"
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
def _write_npy(path: Path, columns: Columns, count: int) -> Iterator[Write]:
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
def _write_npz(path: Path, count: int, constants: Mapping[str, Array]) -> Iterator[Write]:
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
