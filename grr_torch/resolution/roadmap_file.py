"""Roadmap files: one safetensors file with the tensors and, as metadata, everything needed to use them."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, get_type_hints

import torch
from torch import Tensor

from grr_torch.errors import FileFormatError, GrrError
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.quality import Quality
from grr_torch.resolution.report import check_refinement
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.resolution.slopes import check_slope_bound
from grr_torch.robots.load import find_device, make_robot
from grr_torch.robots.presets import load_preset, robot_names
from grr_torch.robots.robot import Robot
from grr_torch.robots.spheres import SphereModel
from grr_torch.robots.urdf_json import urdf_from_json, urdf_to_json
from grr_torch.spaces.task import task_from_json
from grr_torch.tensor_file import read_tensor_file, tensor_hash, tensors_hash, write_tensors
from grr_torch.version import __version__

FORMAT = "grr-torch roadmap"
FORMAT_VERSION = 4

_DTYPES = {
    "points": torch.float64,
    "configurations": torch.float64,
    "resolved": torch.bool,
    "edges": torch.int64,
    "connected": torch.bool,
    "wave": torch.int32,
    "reachable": torch.bool,
}
# what `Roadmap.solve` needs beside them, and what would take long to find again
_TABLES = {
    "neighbour_starts": torch.int64,
    "neighbour_ends": torch.int32,
    "uncertified_triangles": torch.int64,
    "uncertified_squares": torch.int64,
}
_REQUIRED = tuple(name for name in (*_DTYPES, *_TABLES) if name != "reachable")
_TWO_AXES = ("points", "configurations", "edges", "uncertified_triangles", "uncertified_squares")


def save_roadmap(roadmap: Roadmap, path: str | os.PathLike[str]) -> None:
    """Writes a roadmap; see `Roadmap.save`."""
    tensors = _tensors(roadmap)
    metadata = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "package_version": __version__,
        "robot": robot_to_json(roadmap.robot),
        "task": roadmap.task.to_json(),
        "parameters": dict(roadmap.parameters),
        "seed": roadmap.parameters.get("seed"),
        "build_seconds": roadmap.build_seconds,
        "longest_edge": roadmap.longest_edge,
        "quality": roadmap.quality().to_dict(),
        "tensors_sha256": {name: tensor_hash(tensor) for name, tensor in tensors.items()},
    }
    metadata["metadata_sha256"] = metadata_hash(metadata)
    write_tensors(path, tensors, {key: json.dumps(value) for key, value in metadata.items()})


def roadmap_hash(roadmap: Roadmap) -> str:
    """SHA-256 over the tensors of a roadmap's file, by which others name the roadmap that they are made from.

    Which vertices are reachable, which a build only looks for if asked to, does not count.
    """
    return tensors_hash({name: tensor for name, tensor in _tensors(roadmap).items() if name != "reachable"})


def solving_tables(roadmap: Roadmap) -> dict[str, Tensor]:
    """What a file holds so that it need not be computed before the first point is solved."""
    return dict(zip(_TABLES, (*roadmap.neighbours, *roadmap.uncertified), strict=True))


def load_roadmap(
    path: str | os.PathLike[str], robot: Robot | None = None, *, device: torch.device | str | None = None
) -> Roadmap:
    """Reads a roadmap; see `Roadmap.load`.

    A `robot` may be given in place of the file's, as which it was checked; then it is on its own device.
    """
    on = find_device(device) if robot is None else robot.device
    metadata, tensors = read_file(path)
    _check_tensors(path, tensors)
    _check_indices(path, tensors)
    try:
        missing = {field.name for field in fields(Quality)} - set(metadata["quality"])
        if missing:
            raise FileFormatError(path, f"lacks the quality figures {', '.join(sorted(missing))}")
        for name, hint in get_type_hints(Quality).items():
            if not isinstance(metadata["quality"][name], hint):
                raise FileFormatError(path, f"has a quality figure '{name}' that is no such number")
        robot = robot or _robot_from_json(metadata["robot"], on)
        task = task_from_json(metadata["task"])
        parameters, seconds = dict(metadata["parameters"]), float(metadata["build_seconds"])
        longest = float(metadata["longest_edge"])
        Tolerances(**parameters["tolerances"])
        check_refinement(parameters)
        check_slope_bound(parameters)
    except FileFormatError:
        raise
    except KeyError as error:
        raise FileFormatError(path, f"has metadata without {error}") from error
    except (TypeError, ValueError, AttributeError, GrrError) as error:
        raise FileFormatError(path, f"has metadata that cannot be used: {error}") from error
    stored = Quality(**{field.name: metadata["quality"][field.name] for field in fields(Quality)})
    widths = tensors["points"].shape[1], tensors["configurations"].shape[1]
    if widths != (task.width, robot.n):
        raise FileFormatError(path, f"has rows of {widths} entries; its task and robot want {(task.width, robot.n)}")
    roadmap = Roadmap(
        robot=robot,
        task=task,
        points=tensors["points"],
        configurations=tensors["configurations"],
        resolved=tensors["resolved"],
        edges=tensors["edges"],
        connected=tensors["connected"],
        wave=tensors["wave"],
        reachable=tensors.get("reachable"),
        parameters=parameters,
        build_seconds=seconds,
    )
    # what the roadmap would compute when it is first asked for
    starts, ends, triangles, squares = (tensors[name] for name in _TABLES)
    vars(roadmap).update(neighbours=(starts, ends), uncertified=(triangles, squares), longest_edge=longest)
    roadmap.remember(stored)
    return roadmap


def read_file(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Metadata and tensors of a roadmap file.

    Raises:
        FileFormatError: It is missing, truncated, of another version, or not a roadmap.
    """
    return read_tensor_file(path, FORMAT, FORMAT_VERSION, "a roadmap")


def metadata_hash(metadata: Mapping[str, Any]) -> str:
    """SHA-256 over everything in the metadata but this hash itself."""
    others = {name: value for name, value in metadata.items() if name != "metadata_sha256"}
    return hashlib.sha256(json.dumps(others, sort_keys=True).encode()).hexdigest()


def _tensors(roadmap: Roadmap) -> dict[str, Tensor]:
    tensors = {
        name: getattr(roadmap, name).detach().cpu().contiguous().to(dtype)
        for name, dtype in _DTYPES.items()
        if getattr(roadmap, name) is not None
    }
    return tensors | solving_tables(roadmap)


def robot_to_json(robot: Robot) -> dict[str, Any]:
    """All that makes a robot."""
    return {
        "name": robot.name,
        "bundled": robot.preset is not None,
        "urdf": robot.urdf.text,
        "parsed": urdf_to_json(robot.urdf),
        "urdf_sha256": hashlib.sha256(robot.urdf.text.encode()).hexdigest(),
        "urdf_directory": None if robot.preset or not robot.urdf.directory else str(robot.urdf.directory),
        "package_dirs": [str(folder.resolve()) for folder in robot.urdf.package_dirs],
        "base": robot.base,
        "tool": robot.tool,
        "held_joints": dict(robot.held_joints),
        "spheres": robot.spheres.to_yaml() if robot.spheres else None,
        "margin": robot.margin,
        "dtype": str(robot.dtype).removeprefix("torch."),
    }


def _robot_from_json(data: dict[str, Any], device: torch.device) -> Robot:
    directory, preset = data["urdf_directory"], None
    if data["bundled"] and data["name"] in robot_names():
        preset = load_preset(data["name"])
        directory = preset.urdf.parent
    urdf = urdf_from_json(
        data["parsed"],
        text=data["urdf"],
        directory=None if directory is None else Path(directory),
        package_dirs=data["package_dirs"],
    )
    spheres = data["spheres"]
    robot = make_robot(
        urdf,
        name=data["name"],
        base=data["base"],
        tool=data["tool"],
        held_joints=data["held_joints"],
        spheres=None if spheres is None else SphereModel.parse(spheres, urdf.links, source=data["name"]),
        margin=float(data["margin"]),
        device=device,
        dtype=torch.float32 if data["dtype"] == "float32" else torch.float64,
    )
    return replace(robot, preset=preset)


def _check_tensors(path: str | os.PathLike[str], tensors: Mapping[str, Tensor]) -> None:
    """Names, types and shapes; what the tensors hold is not read.

    Raises:
        FileFormatError: Something does not fit.
    """

    def demand(holds: bool, reason: str) -> None:
        if not holds:
            raise FileFormatError(path, reason)

    missing = [name for name in _REQUIRED if name not in tensors]
    demand(not missing, f"lacks the tensors {', '.join(missing)}")
    dtypes = _DTYPES | _TABLES
    for name, tensor in tensors.items():
        demand(name in dtypes, f"has an unknown tensor '{name}'")
        demand(tensor.dtype == dtypes[name], f"tensor '{name}' is {tensor.dtype}, not {dtypes[name]}")
        axes = 2 if name in _TWO_AXES else 1
        demand(tensor.ndim == axes, f"tensor '{name}' has {tensor.ndim} axes, not {axes}")
    vertices, count = len(tensors["points"]), len(tensors["edges"])
    lengths = {"configurations": vertices, "resolved": vertices, "wave": vertices, "connected": count}
    lengths |= {"reachable": vertices} if "reachable" in tensors else {}
    for name, length in {**lengths, "neighbour_starts": vertices + 1}.items():
        demand(len(tensors[name]) == length, f"tensor '{name}' has {len(tensors[name])} rows, not {length}")
    for name, width in {"edges": 2, "uncertified_triangles": 3, "uncertified_squares": 4}.items():
        demand(tensors[name].shape[1] == width, f"tensor '{name}' has rows of {tensors[name].shape[1]}, not {width}")


def _check_indices(path: str | os.PathLike[str], tensors: Mapping[str, Tensor]) -> None:
    """That what names vertices names some that are there.

    Raises:
        FileFormatError: It does not.
    """
    count, ends = len(tensors["points"]), len(tensors["neighbour_ends"])
    most = dict.fromkeys(("edges", "neighbour_ends", "uncertified_triangles", "uncertified_squares"), count)
    for name, limit in {**most, "neighbour_starts": ends + 1}.items():
        if tensors[name].numel():
            low, high = (int(value) for value in torch.aminmax(tensors[name]))
            if low < 0 or high >= limit:
                reason = f"is corrupt: tensor '{name}' has entries from {low} to {high}; valid: 0 to {limit - 1}"
                raise FileFormatError(path, reason)
