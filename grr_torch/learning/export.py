"""Data sets in files, for other programs to learn from."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from grr_torch.errors import GrrWarning, ParameterError
from grr_torch.learning.sample import check_learnable, draw_samples
from grr_torch.learning.split import SPLITS, Split
from grr_torch.output import atomic_write, check_writable
from grr_torch.progress import Progress, silent
from grr_torch.resolution.roadmap_file import roadmap_hash
from grr_torch.tables import Array, table_writer, unique_names
from grr_torch.tensor_file import stream_tensors
from grr_torch.version import __version__

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap

SUFFIXES = (".parquet", ".safetensors", ".npz")
# rows of a Jacobian
_TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")


def check_dataset_path(name: str, path: Path) -> None:
    """Finds out before the work starts whether a data set could be written.

    Raises:
        ParameterError: The suffix is not known.
        OutputError: It cannot be written.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ParameterError(name, path, f"a file that ends in {', '.join(SUFFIXES)}")
    check_writable(path)


def export_dataset(
    roadmap: Roadmap,
    out: str | os.PathLike[str],
    samples: int,
    *,
    split: Split | None = None,
    jacobians: bool = False,
    seed: int = 0,
    progress: Progress = silent,
) -> dict[str, int]:
    """Draws points in a roadmap's certified cells, solves them, and writes a row for each.

    There are as many rows as are asked for. A point that the map does not solve has `valid` false and NaN joints and
    Jacobian. Memory does not grow with the number of rows, and the file appears when all of them are written.

    - .parquet: a column for each coordinate and joint, `valid`, `split` as text, and with Jacobians a column for each
      entry, named "vx/joint", …, "wz/joint". Units stand in the fields' metadata and the schema's.
    - .safetensors, .npz: arrays points (N, d), configurations (N, n), valid (N,), split (N,), jacobians (N, 6, n);
      split is a number in .safetensors, an index into `split_names` of the metadata.

    All have one JSON text `grr_torch` in their metadata (an array in .npz): column names, units, robot, task, split,
    seeds and the roadmap's hash.

    Args:
        roadmap: The roadmap.
        out: The file.
        samples: Rows.
        split: Training, validation and test; by default by region.
        jacobians: Also write geometric Jacobians (6, n) of the tool in the base frame, linear rows first.
        seed: Of the points.
        progress: Told how many are solved.

    Returns:
        How many samples are of each part, and how many are not valid.

    Raises:
        ParameterError: The suffix is not known, the number is not valid, or there are no certified cells.
        OutputError: It cannot be written.
    """
    out = Path(out)
    check_dataset_path("out", out)
    check_learnable(roadmap)
    split = split or Split(seed=seed)
    columns = _columns(roadmap, jacobians)
    units = _units(roadmap, columns)
    about = {
        "version": __version__,
        "columns": {name: list(group) for name, group in columns.items()},
        "units": units,
        "robot": roadmap.robot.name,
        "task": roadmap.task.to_json(),
        "roadmap_sha256": roadmap_hash(roadmap),
        "samples": samples,
        "seed": seed,
        "split": {**split.to_dict(), "block": split.of(roadmap).block},
        "split_names": list(SPLITS),
    }
    counts = dict.fromkeys((*SPLITS, "not valid"), 0)
    pieces = draw_samples(roadmap, samples, split, seed=seed, progress=progress)
    with _writer(out, columns, units, samples, {"grr_torch": json.dumps(about)}) as write:
        for piece in pieces:
            arrays = {
                "points": piece.points.numpy(),
                "configurations": piece.configurations.numpy(),
                "valid": piece.valid.numpy(),
                "split": piece.split.numpy(),
            }
            if jacobians:
                # invalid configurations are NaN, and so are their Jacobians
                arrays["jacobians"] = roadmap.robot.jacobian(piece.configurations).cpu().numpy()
            write(arrays)
            for part, number in zip(SPLITS, np.bincount(arrays["split"], minlength=len(SPLITS)), strict=True):
                counts[part] += int(number)
            counts["not valid"] += int((~piece.valid).sum())
    empty = [part for part in ("validation", "test") if counts[part] == 0 and getattr(split, part) > 0.0]
    if empty:
        told = f"none of {samples:,} samples is for {' or '.join(empty)}: take more, or smaller blocks"
        warnings.warn(told, GrrWarning, stacklevel=2)
    return counts


def _columns(roadmap: Roadmap, jacobians: bool) -> dict[str, list[str]]:
    """Names of the columns by array."""
    axes = list(roadmap.task.coordinates)
    joints = unique_names(roadmap.robot.joint_names, (*axes, "valid", "split"))
    columns = {"points": axes, "configurations": joints, "valid": ["valid"], "split": ["split"]}
    if jacobians:
        columns["jacobians"] = [f"{row}/{joint}" for row in _TWIST for joint in joints]
    return columns


def _units(roadmap: Roadmap, columns: Mapping[str, list[str]]) -> dict[str, str]:
    """The unit of each column that has one."""
    slides = [roadmap.robot.urdf.joints[name].kind == "prismatic" for name in roadmap.robot.joint_names]
    joints = ["m" if sliding else "rad" for sliding in slides]
    units = dict.fromkeys(columns["points"], "m")
    units |= dict(zip(columns["configurations"], joints, strict=True))
    for name in columns.get("jacobians", []):
        row, _, joint = name.partition("/")
        units[name] = f"{'m' if row.startswith('v') else 'rad'}/{units[joint]}"
    return units


@contextmanager
def _writer(
    out: Path, columns: Mapping[str, list[str]], units: Mapping[str, str], count: int, metadata: dict[str, str]
) -> Iterator[Callable[[dict[str, Array]], None]]:
    """Appends arrays to a file of any kind."""
    suffix = out.suffix.lower()
    if suffix == ".safetensors":
        with atomic_write(out) as temporary, stream_tensors(temporary, count, metadata) as write:
            yield write
        return
    constants: dict[str, Array] = {name: np.array(text) for name, text in metadata.items()}
    with table_writer(out, columns, count, constants, metadata=metadata, units=units) as write_table:

        def write_named(arrays: dict[str, Array]) -> None:
            named: dict[str, Any] = {**arrays, "split": np.array(SPLITS)[arrays["split"]]}
            if "jacobians" in named and suffix == ".parquet":
                named["jacobians"] = named["jacobians"].reshape(len(named["split"]), -1)
            write_table(named)

        yield write_named
