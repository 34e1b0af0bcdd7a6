"""The bundled robots and their presets: a folder each under `urdf/`."""

from __future__ import annotations

import importlib.resources
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from grr_torch.errors import UnknownNameError


@dataclass(frozen=True)
class Problem:
    """A task of a preset, as the paper poses it.

    Attributes:
        points: How many vertices the staggered grid is asked for.
        bounds: (low, high) of each axis [m].
        seeds: Configurations the expansion starts from.
        rotation: Fixed-axis roll, pitch, yaw of the tool [rad], for `fixed-rotation`, and for `yaw` at yaw 0.
        rotations: How many rotations the grid has, where rotation varies.
        max_slope: D_q / D_p above which edges of this very grid are left out [rad/m]; None: no bound.
        connectivity: Share of the edges for which refinement raises that bound, if fewer keep it; None: for none.
    """

    points: int
    bounds: tuple[tuple[float, float], ...]
    seeds: tuple[tuple[float, ...], ...]
    rotation: tuple[float, float, float] | None
    rotations: int | None = None
    max_slope: float | None = None
    connectivity: float | None = None


@dataclass(frozen=True)
class Preset:
    """What a bundled robot is used with unless told otherwise.

    Attributes:
        name: The robot's name.
        description: One line.
        urdf: Path of its URDF.
        tool: Tool frame.
        base: Base frame.
        spheres: Path of its sphere file, or None: self-intersection is allowed.
        margin: Distance [m] below which two links count as in collision.
        default_task: The problem that `build` takes when none is named.
        problems: Problems by task kind.
    """

    name: str
    description: str
    urdf: Path
    tool: str
    base: str
    spheres: Path | None
    margin: float
    default_task: str
    problems: Mapping[str, Problem]


def robot_names() -> list[str]:
    """Names of the bundled robots."""
    return sorted(folder.name for folder in _folder().iterdir() if (folder / "preset.yaml").is_file())


def load_preset(name: str) -> Preset:
    """The preset of a bundled robot.

    Raises:
        UnknownNameError: There is no such robot.
    """
    import yaml

    if name not in robot_names():
        raise UnknownNameError("robot", name, robot_names(), " A URDF is given by its path.")
    folder = _folder() / name
    data = yaml.safe_load((folder / "preset.yaml").read_text(encoding="utf-8"))
    return Preset(
        name=name,
        description=data["description"],
        urdf=folder / data["urdf"],
        tool=data["tool"],
        base=data["base"],
        spheres=folder / data["spheres"] if "spheres" in data else None,
        margin=data.get("margin", 0.0),
        default_task=data["default_task"],
        problems={kind: _problem(entry) for kind, entry in data["problems"].items()},
    )


def _problem(entry: Mapping[str, Any]) -> Problem:
    rotation = entry.get("rotation")
    return Problem(
        points=entry["points"],
        bounds=tuple((float(low), float(high)) for low, high in entry["bounds"]),
        seeds=tuple(tuple(map(float, seed)) for seed in entry["seeds"]),
        rotation=None if rotation is None else (float(rotation[0]), float(rotation[1]), float(rotation[2])),
        rotations=entry.get("rotations"),
        max_slope=entry.get("max_slope"),
        connectivity=entry.get("connectivity"),
    )


def _folder() -> Path:
    return Path(str(importlib.resources.files("grr_torch.urdf")))
