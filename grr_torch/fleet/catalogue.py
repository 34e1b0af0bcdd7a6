"""The catalogue of a fleet: a table of its roadmaps, their quality and cost, always made from the files themselves."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from grr_torch.errors import FileFormatError, GrrWarning, UnknownNameError
from grr_torch.fleet.order import Order
from grr_torch.fleet.work import describe
from grr_torch.output import atomic_write
from grr_torch.resolution.quality import Quality
from grr_torch.resolution.roadmap_file import read_file

CATALOGUE = "catalogue.parquet"
_FAILED = ".failed.json"
# figures of which more is better
_MORE = {
    "resolved_vertices",
    "reachable_vertices",
    "coverage",
    "connected_edges",
    "reachable_edges",
    "resolved_edges",
    "connectivity",
    "connectivity_resolved",
    "triangles_certified",
    "squares_certified",
    "min_self_collision_distance",
}
_COSTS = ("build_seconds", "seconds", "peak_memory_mib")
_FIGURES = (*(field.name for field in fields(Quality)), *_COSTS)

Row = dict[str, Any]


def is_there(order: Order, folder: Path) -> bool:
    """Whether the roadmap of an order is there, whole."""
    try:
        return order.path(folder).is_file() and _done(order.path(folder)) is not None
    except FileFormatError as error:
        warnings.warn(f"{error}; it is built again", GrrWarning, stacklevel=2)
        return False


def record_failure(order: Order, folder: Path, error: str) -> None:
    """Writes down that an order failed, until it succeeds."""
    with atomic_write(folder / f"{order.hash}{_FAILED}") as temporary:
        text = json.dumps({**describe(order), "error": error}, indent=2, ensure_ascii=False)
        temporary.write_text(text, encoding="utf-8")


def forget_failure(order: Order, folder: Path) -> None:
    """Takes back that an order failed."""
    (folder / f"{order.hash}{_FAILED}").unlink(missing_ok=True)


def read_catalogue(folder: Path) -> list[Row]:
    """A row for each roadmap of a fleet, and for each that failed.

    A row has the hash, robot, task and orientation; every parameter of the build; status ("done" or "failed") and
    error; the figures of `Quality`; build_seconds (the algorithm alone), seconds (all), peak_memory_mib; and the file.

    Raises:
        FileFormatError: It is no folder.
    """
    if not folder.is_dir():
        raise FileFormatError(folder, "is not a folder")
    rows: list[Row] = []
    for path in sorted(folder.glob("[!.]*.grr")):
        try:
            row = _done(path)
        except FileFormatError as error:
            warnings.warn(f"left out of the catalogue: {error}", GrrWarning, stacklevel=2)
            continue
        if row is not None:
            rows.append(row)
    done = {row["hash"] for row in rows}
    failed = [_failed(path) for path in sorted(folder.glob(f"[!.]*{_FAILED}"))]
    return rows + [row for row in failed if row is not None and row["hash"] not in done]


def write_catalogue(folder: Path) -> list[Row]:
    """Writes the catalogue of a folder, catalogue.parquet, and gives its rows.

    Raises:
        FileFormatError: It is no folder.
        OutputError: The file cannot be written.
    """
    import pyarrow
    from pyarrow import parquet

    rows = read_catalogue(folder)
    names = list(dict.fromkeys(name for row in rows for name in row))
    columns = {name: _column([row.get(name) for row in rows]) for name in names}
    with atomic_write(folder / CATALOGUE) as temporary:
        parquet.write_table(pyarrow.table(columns), temporary)
    return rows


def best(rows: Sequence[Row], figure: str, per: Sequence[str] = ()) -> list[Row]:
    """The best roadmap by a figure: of all, or of each combination of the values of some columns.

    Args:
        rows: Rows of a catalogue; those without a roadmap or the figure do not count.
        figure: A figure of `Quality`, or a cost.
        per: Columns.

    Raises:
        UnknownNameError: No such figure or column.
    """
    if figure not in _FIGURES:
        raise UnknownNameError("figure", figure, _FIGURES)
    columns = tuple(dict.fromkeys(name for row in rows for name in row))
    for name in per:
        if name not in columns:
            raise UnknownNameError("column", name, columns)
    sign = -1.0 if figure in _MORE else 1.0
    found: dict[str, Row] = {}
    for row in sorted(rows, key=lambda row: str(row["hash"])):
        key = json.dumps([row.get(name) for name in per])
        if row.get(figure) is None:
            continue
        if key not in found or sign * row[figure] < sign * found[key][figure]:
            found[key] = row
    return list(found.values())


def _done(path: Path) -> Row | None:
    """The row of a roadmap's file; None if it is none of a fleet's."""
    metadata = read_file(path)[0]
    try:
        told = metadata["parameters"].get("fleet")
        if told is None:
            return None
        if told["hash"] != path.stem:
            raise FileFormatError(path, f"holds the roadmap {told['hash']}")
        costs = {"build_seconds": metadata["build_seconds"], **{name: told[name] for name in _COSTS[1:]}}
        return {
            **_order_columns(told),
            "status": "done",
            "error": None,
            **metadata["quality"],
            **costs,
            "file": path.name,
        }
    except (KeyError, TypeError, AttributeError) as error:
        raise FileFormatError(path, f"has metadata that cannot be used: {error}") from error


def _failed(path: Path) -> Row | None:
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        blank = dict.fromkeys(_FIGURES)
        return {**_order_columns(told), "status": "failed", "error": told["error"], **blank, "file": None}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        warnings.warn(f"left out of the catalogue: {path}: cannot be used: {error}", GrrWarning, stacklevel=3)
        return None


def _order_columns(told: Mapping[str, Any]) -> Row:
    parameters = {name: value for name, value in told["parameters"].items() if name not in ("robot", "task")}
    return {**{name: told[name] for name in ("hash", "robot", "task", "orientation")}, **parameters}


def _column(values: Sequence[Any]) -> list[Any]:
    """Values of one type as they are, others as JSON."""
    kinds = {float if isinstance(value, int) and not isinstance(value, bool) else type(value) for value in values}
    kinds.discard(type(None))
    if len(kinds) <= 1 and kinds <= {bool, float, str}:
        return list(values)
    return [None if value is None else json.dumps(value) for value in values]
