"""Roadmap files: one safetensors file with the tensors and, as metadata, everything needed to use them."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

import torch
from safetensors.torch import save_file
from torch import Tensor

from grr_torch.errors import FileFormatError, GrrError
from grr_torch.output import atomic_write
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.quality import Quality
from grr_torch.resolution.report import check_refinement
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.robots.load import make_robot
from grr_torch.robots.presets import load_preset, robot_names
from grr_torch.robots.read_urdf import parse_urdf
from grr_torch.robots.robot import Robot
from grr_torch.robots.spheres import SphereModel
from grr_torch.spaces.task import task_from_json
from grr_torch.tensor_file import read_tensor_file
from grr_torch.version import __version__

FORMAT = "grr-torch roadmap"
FORMAT_VERSION = 2

_DTYPES = {
    "points": torch.float64,
    "configurations": torch.float64,
    "resolved": torch.bool,
    "edges": torch.int64,
    "connected": torch.bool,
    "wave": torch.int32,
    "reachable": torch.bool,
}
_REQUIRED = tuple(name for name in _DTYPES if name != "reachable")


def save_roadmap(roadmap: Roadmap, path: str | os.PathLike[str]) -> None:
    """Writes a roadmap; see `Roadmap.save`."""
    tensors = _tensors(roadmap)
    metadata = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "package_version": __version__,
        "robot": _robot_to_json(roadmap.robot),
        "task": roadmap.task.to_json(),
        "parameters": dict(roadmap.parameters),
        "seed": roadmap.parameters.get("seed"),
        "build_seconds": roadmap.build_seconds,
        "quality": roadmap.quality().to_dict(),
        "tensors_sha256": tensors_hash(tensors),
    }
    metadata["metadata_sha256"] = metadata_hash(metadata)
    with atomic_write(path) as temporary:
        save_file(tensors, temporary, metadata={key: json.dumps(value) for key, value in metadata.items()})


def roadmap_hash(roadmap: Roadmap) -> str:
    """The `tensors_sha256` that a roadmap's file has, by which others name the roadmap that they are made from."""
    return tensors_hash(_tensors(roadmap))


def load_roadmap(path: str | os.PathLike[str]) -> Roadmap:
    """Reads a roadmap; see `Roadmap.load`."""
    metadata, tensors = read_file(path)
    _check_tensors(path, tensors)
    try:
        missing = {field.name for field in fields(Quality)} - set(metadata["quality"])
        if missing:
            raise FileFormatError(path, f"lacks the quality figures {', '.join(sorted(missing))}")
        for name, hint in get_type_hints(Quality).items():
            if not isinstance(metadata["quality"][name], hint):
                raise FileFormatError(path, f"has a quality figure '{name}' that is no such number")
        robot = _robot_from_json(metadata["robot"])
        task = task_from_json(metadata["task"])
        parameters, seconds = dict(metadata["parameters"]), float(metadata["build_seconds"])
        Tolerances(**parameters["tolerances"])
        check_refinement(parameters)
    except FileFormatError:
        raise
    except KeyError as error:
        raise FileFormatError(path, f"has metadata without {error}") from error
    except (TypeError, ValueError, AttributeError, GrrError) as error:
        raise FileFormatError(path, f"has metadata that cannot be used: {error}") from error
    widths = tensors["points"].shape[1], tensors["configurations"].shape[1]
    if widths != (task.width, robot.n):
        raise FileFormatError(path, f"has rows of {widths} entries; its task and robot want {(task.width, robot.n)}")
    return Roadmap(
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


def read_file(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Metadata and tensors of a roadmap file.

    Raises:
        FileFormatError: It is missing, truncated, of another version, or not a roadmap.
    """
    return read_tensor_file(path, FORMAT, FORMAT_VERSION, "a roadmap")


def tensors_hash(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 over names, shapes and bytes of all tensors."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].contiguous()
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes() if tensor.numel() else b"")
    return digest.hexdigest()


def metadata_hash(metadata: Mapping[str, Any]) -> str:
    """SHA-256 over everything in the metadata but this hash itself."""
    others = {name: value for name, value in metadata.items() if name != "metadata_sha256"}
    return hashlib.sha256(json.dumps(others, sort_keys=True).encode()).hexdigest()


def _tensors(roadmap: Roadmap) -> dict[str, Tensor]:
    return {
        name: getattr(roadmap, name).detach().cpu().contiguous().to(dtype)
        for name, dtype in _DTYPES.items()
        if getattr(roadmap, name) is not None
    }


def _robot_to_json(robot: Robot) -> dict[str, Any]:
    return {
        "name": robot.name,
        "bundled": robot.preset is not None,
        "urdf": robot.urdf.text,
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


def _robot_from_json(data: dict[str, Any]) -> Robot:
    directory = data["urdf_directory"]
    if data["bundled"] and data["name"] in robot_names():
        directory = load_preset(data["name"]).urdf.parent
    urdf = parse_urdf(
        data["urdf"].encode(),
        source=data["name"],
        directory=None if directory is None else Path(directory),
        package_dirs=data["package_dirs"],
    )
    spheres = data["spheres"]
    return make_robot(
        urdf,
        name=data["name"],
        base=data["base"],
        tool=data["tool"],
        held_joints=data["held_joints"],
        spheres=None if spheres is None else SphereModel.parse(spheres, urdf.links, source=data["name"]),
        margin=float(data["margin"]),
        device=torch.device("cpu"),
        dtype=torch.float32 if data["dtype"] == "float32" else torch.float64,
    )


def _check_tensors(path: str | os.PathLike[str], tensors: Mapping[str, Tensor]) -> None:
    """Names, types, shapes, and what must agree between them.

    Raises:
        FileFormatError: Something does not.
    """

    def demand(holds: bool, reason: str) -> None:
        if not holds:
            raise FileFormatError(path, reason)

    missing = [name for name in _REQUIRED if name not in tensors]
    demand(not missing, f"lacks the tensors {', '.join(missing)}")
    for name, tensor in tensors.items():
        demand(name in _DTYPES, f"has an unknown tensor '{name}'")
        demand(tensor.dtype == _DTYPES[name], f"tensor '{name}' is {tensor.dtype}, not {_DTYPES[name]}")
    for name, tensor in tensors.items():
        axes = 2 if name in ("points", "configurations", "edges") else 1
        demand(tensor.ndim == axes, f"tensor '{name}' has {tensor.ndim} axes, not {axes}")
    vertices, count = len(tensors["points"]), len(tensors["edges"])
    lengths = {"configurations": vertices, "resolved": vertices, "wave": vertices, "connected": count}
    lengths |= {"reachable": vertices} if "reachable" in tensors else {}
    for name, length in lengths.items():
        demand(len(tensors[name]) == length, f"tensor '{name}' has {len(tensors[name])} rows, not {length}")
    edges, resolved = tensors["edges"], tensors["resolved"]
    inside = bool(((edges >= 0) & (edges < vertices)).all()) and edges.shape[1] == 2
    demand(inside, "has edges to vertices that do not exist")
    demand(bool(tensors["points"].isfinite().all()), "has points that are not finite")
    finite = tensors["configurations"].isfinite().all(1)
    demand(bool((finite == resolved).all()), "has resolved vertices without a finite configuration, or the reverse")
    demand(bool((tensors["wave"] < vertices).all()), "has waves later than there are vertices")
    demand(bool((tensors["wave"] >= 0).eq(resolved).all()), "has waves that do not fit what is resolved")
    demand(not bool((resolved & ~tensors.get("reachable", resolved)).any()), "has resolved vertices not reachable")
    demand(bool(resolved[edges[tensors["connected"]]].all()), "has connected edges to unresolved vertices")
