"""Sweeps: files that say which roadmaps a fleet is to have.

A sweep is YAML: `grid` gives lists of values of which every combination is built, `builds` a list of builds, `defaults`
what holds for all of them, and `needs` what each needs of a machine (cpus, memory in GiB, gpus). The names are those of
the arguments of `load_robot`, `make_task` and `build`; paths are relative to the file:

    defaults: {robot: planar_5, points: 300}
    needs: {memory: 0.5}
    grid:
      task: [position, fixed-rotation]
      seed: [0, 1]
    builds:
      - {task: fixed-rotation, rotation: [0, 0, 1.5708]}
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from grr_torch.errors import FileFormatError, GrrError, UnknownNameError
from grr_torch.fleet.options import known_options
from grr_torch.fleet.order import Needs, Order, Planner
from grr_torch.strict_yaml import parse_yaml

_PARTS = ("defaults", "grid", "builds", "needs")
_MOST = 100_000


def read_sweep(path: str | os.PathLike[str]) -> tuple[Order, ...]:
    """The orders of a sweep, in the file's order: those of the grid, then those of the list.

    Raises:
        FileFormatError: It cannot be read, a name is not known, a value is of no type that the option takes, a robot
            or file that it names cannot be read, or two of its builds are one roadmap.
    """
    path = Path(path)
    data = _read_yaml(path)
    _check_parts(path, data)
    planner = Planner(path.resolve().parent)
    needs, defaults = data.get("needs") or {}, data.get("defaults") or {}
    orders: dict[str, tuple[str, Order]] = {}
    for where, entry in _entries(path, data):
        try:
            said = {**defaults, **entry}
            own = said.pop("needs", {})
            wanted = Needs.of({**needs, **own} if isinstance(own, dict) else own)
            order = planner.order(said, wanted)
        except GrrError as error:
            raise FileFormatError(path, f"{where}: {error}") from error
        if order.hash in orders:
            raise FileFormatError(path, _repeated(where, order, *orders[order.hash]))
        orders[order.hash] = where, order
    return tuple(order for _, order in orders.values())


def _read_yaml(path: Path) -> Any:
    if not path.is_file():
        raise FileFormatError(path, "is not a regular file" if path.exists() else "does not exist")
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise FileFormatError(path, f"is not text: {error}") from error
    except OSError as error:
        raise FileFormatError(path, f"cannot be read: {error.strerror or error}") from error
    return parse_yaml(text, path)


def _check_parts(path: Path, data: Any) -> None:
    """Checks the shape of a sweep, and that nothing in it contradicts the rest.

    Raises:
        FileFormatError: It has another shape.
    """

    def demand(holds: bool, reason: str) -> None:
        if not holds:
            raise FileFormatError(path, reason)

    demand(isinstance(data, dict), f"is not a sweep; valid: a mapping with {', '.join(_PARTS)}")
    for name in data:
        demand(name in _PARTS, str(UnknownNameError("part of a sweep", name, _PARTS)))
    for name in ("defaults", "grid", "needs"):
        demand(isinstance(data.get(name) or {}, dict), f"{name}: got {data.get(name)!r}; valid: names with values")
    builds, grid = data.get("builds") or [], data.get("grid") or {}
    listed = isinstance(builds, list) and all(isinstance(entry, dict) for entry in builds)
    demand(listed, f"builds: got {builds!r}; valid: a list of mappings")
    known = (*known_options(), "needs")
    for where, names in (("defaults", data.get("defaults") or {}), ("grid", grid)):
        for name in names:
            demand(name in known, f"{where}: {UnknownNameError('option of a build', name, known)}")
    for name, values in grid.items():
        demand(isinstance(values, list) and bool(values), f"grid: {name}: got {values!r}; valid: a list of values")
        demand(name not in (data.get("defaults") or {}), f"'{name}' is in defaults and in grid; valid: one of them")
    count = len(builds) + (math.prod(map(len, grid.values())) if grid else 0)
    demand(0 < count <= _MOST, f"asks for {count:,} builds; valid: 1 to {_MOST:,}, from a grid, a list or both")


def _entries(path: Path, data: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Where each build is in the file, and what it says."""
    grid = data.get("grid") or {}
    for values in itertools.product(*grid.values()) if grid else ():
        entry = dict(zip(grid, values, strict=True))
        yield f"grid ({', '.join(f'{name}: {value}' for name, value in entry.items())})", entry
    for number, entry in enumerate(data.get("builds") or [], start=1):
        yield f"build {number}", entry


def _repeated(where: str, order: Order, before: str, first: Order) -> str:
    """What is wrong with two builds that are one roadmap."""
    if order.needs == first.needs:
        return f"{where} and {before} are the same roadmap; valid: one of them"
    return (
        f"{where} and {before} contradict each other: the same roadmap with the needs {asdict(order.needs)} "
        f"and {asdict(first.needs)}; valid: one of them"
    )
