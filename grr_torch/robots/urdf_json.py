"""What a URDF says, as JSON: a file that holds it is opened without the libraries that parse XML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from grr_torch.robots.urdf import Joint, Shape, Urdf


def urdf_to_json(urdf: Urdf) -> dict[str, Any]:
    """Root, links, joints and shapes of a URDF, without its text and folders."""
    return {
        "name": urdf.name,
        "root": urdf.root,
        "links": list(urdf.links),
        "joints": [
            {**asdict(joint), "origin": joint.origin.tolist(), "axis": joint.axis.tolist(), "mimic": _list(joint.mimic)}
            for joint in urdf.joints.values()
        ],
        "collisions": {link: list(map(_shape_to_json, shapes)) for link, shapes in urdf.collisions.items()},
        "visuals": {link: list(map(_shape_to_json, shapes)) for link, shapes in urdf.visuals.items()},
    }


def urdf_from_json(data: Mapping[str, Any], *, text: str, directory: Path | None, package_dirs: Sequence[str]) -> Urdf:
    """The URDF of which `urdf_to_json` gave `data`, and whose XML was `text`.

    Raises:
        KeyError: An entry is missing.
        TypeError: One is not what it should be.
        ValueError: One is not what it should be.
    """
    joints = [_joint(joint) for joint in data["joints"]]
    return Urdf(
        name=data["name"],
        text=text,
        directory=directory,
        package_dirs=tuple(Path(folder).resolve() for folder in package_dirs),
        root=data["root"],
        links=tuple(data["links"]),
        joints={joint.name: joint for joint in joints},
        collisions={link: tuple(map(_shape, shapes)) for link, shapes in data["collisions"].items()},
        visuals={link: tuple(map(_shape, shapes)) for link, shapes in data["visuals"].items()},
    )


def _joint(data: Mapping[str, Any]) -> Joint:
    mimic = data["mimic"]
    arrays = {name: np.array(data[name], dtype=np.float64) for name in ("origin", "axis")}
    return Joint(**{**data, **arrays, "mimic": None if mimic is None else (mimic[0], mimic[1], mimic[2])})


def _shape_to_json(shape: Shape) -> dict[str, Any]:
    return {**asdict(shape), "origin": shape.origin.tolist(), "size": list(shape.size)}


def _shape(data: Mapping[str, Any]) -> Shape:
    return Shape(**{**data, "origin": np.array(data["origin"], dtype=np.float64), "size": tuple(data["size"])})


def _list(values: Sequence[Any] | None) -> list[Any] | None:
    return None if values is None else list(values)
