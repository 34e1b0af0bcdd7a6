"""The paths of the teleoperation experiment (Section V-D of the paper): drawn from a seed, or read from a file."""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from grr_torch.errors import FileFormatError, ParameterError, UnknownNameError, check_seed
from grr_torch.projection.project import DEFAULT_TOLERANCES, project_columns
from grr_torch.resolution.roadmap import Roadmap

KINDS = ("line_random", "line_self", "circle_random", "circle_out")
# kinds whose paths end where they began
CLOSED = ("circle_random", "circle_out")

# the largest radius of a circle, as a share of the shortest side of the roadmap's bounds
_RADIUS = 0.1
# points of a circle at which it is looked whether it can be reached
_LOOKED = 24
# points drawn at once, random starts for each that tell whether it is reachable, and draws before it is given up
_DRAWN = {"line": 2048, "circle": 256}
_STARTS = {"line": 1, "circle": 6}
_MOST_DRAWS = 200


def draw_paths(roadmap: Roadmap, kind: str, paths: int, *, waypoints: int = 200, seed: int = 0) -> Tensor:
    """Random paths (paths, waypoints, width) [m].

    Points are drawn uniformly within the roadmap's bounds, and reachable ones kept: those that a projection from
    one of a few random starts reaches free of self-collision.

    - line_random: between two reachable points.
    - line_self: from a reachable point to its mirror image in the robot's base, if that is reachable too.
    - circle_random: round a reachable point, of a random radius, in a random plane; all of it reachable.
    - circle_out: the same with a part that is not reachable; it begins on the part that is.

    Args:
        roadmap: Whose robot, task space and bounds are meant.
        kind: Of `KINDS`.
        paths: How many.
        waypoints: Points of each, ends included.
        seed: Of the draw.

    Raises:
        UnknownNameError: No such kind.
        ParameterError: A number is too small, or no such path was found.
    """
    if kind not in KINDS:
        raise UnknownNameError("kind of path", kind, KINDS)
    if paths < 1 or waypoints < 2:
        raise ParameterError("paths and waypoints", (paths, waypoints), "1 or more paths of 2 or more waypoints")
    # no seed of one kind gives the draws of another one; a generator takes 64 bits
    generator = torch.Generator().manual_seed((check_seed(seed) * len(KINDS) + KINDS.index(kind)) % (1 << 64))
    found: list[Tensor] = []
    for _ in range(_MOST_DRAWS):
        if kind in CLOSED:
            found.append(_circles(roadmap, kind, waypoints, generator))
        else:
            found.append(_line(*_ends(roadmap, kind, generator), waypoints))
        if sum(map(len, found)) >= paths:
            return torch.cat(found)[:paths]
    raise ParameterError("kind of path", kind, f"one of which {paths} can be drawn for this roadmap")


def read_paths(path: str | os.PathLike[str], width: int) -> dict[str, Tensor]:
    """Paths by kind from an npz file that has one array (paths, waypoints, width) for each.

    Raises:
        FileFormatError: It is missing, no such file, or an array is of another shape or not finite.
        UnknownNameError: An array is of no known kind.
    """
    if not Path(path).is_file():
        raise FileFormatError(path, "is not a regular file" if Path(path).exists() else "does not exist")
    try:
        with np.load(path, allow_pickle=False) as file:
            if not isinstance(file, Mapping) or not len(file):
                raise FileFormatError(path, "is no npz file with arrays in it")
            arrays = {name: np.asarray(file[name], dtype=np.float64) for name in file}
    except (OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
        reason = "it is none, or has objects in it" if "pickle" in str(error) else error
        raise FileFormatError(path, f"cannot be read as npz: {reason}") from error
    for name, array in arrays.items():
        if name not in KINDS:
            raise UnknownNameError("kind of path", name, KINDS)
        if array.ndim != 3 or array.shape[2] != width or array.shape[0] < 1 or array.shape[1] < 2:
            raise FileFormatError(
                path, f"'{name}' is of shape {array.shape}, not (paths, 2 or more waypoints, {width})"
            )
        if not np.isfinite(array).all():
            raise FileFormatError(path, f"'{name}' has values that are not finite")
    return {kind: torch.from_numpy(arrays[kind].copy()) for kind in KINDS if kind in arrays}


def _reachable_points(roadmap: Roadmap, shape: str, generator: torch.Generator) -> Tensor:
    """Random points (K, width) within the bounds that are reachable."""
    low, high = roadmap.points.amin(0), roadmap.points.amax(0)
    drawn = low + (high - low) * torch.rand(_DRAWN[shape], len(low), dtype=torch.float64, generator=generator)
    return drawn[_reachable(roadmap, drawn, shape, generator)]


def _ends(roadmap: Roadmap, kind: str, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Starts and ends (K, width) of lines."""
    start = _reachable_points(roadmap, "line", generator)
    if kind == "line_random":
        half = len(start) // 2
        return start[:half], start[half : 2 * half]
    kept = _reachable(roadmap, -start, "line", generator)
    return start[kept], -start[kept]


def _circles(roadmap: Roadmap, kind: str, waypoints: int, generator: torch.Generator) -> Tensor:
    """Circles (K, waypoints, width) round reachable points, in random planes."""
    centre = _reachable_points(roadmap, "circle", generator)
    count, d = centre.shape
    largest = _RADIUS * float((roadmap.points.amax(0) - roadmap.points.amin(0)).min())
    radius = largest * torch.rand(count, 1, dtype=torch.float64, generator=generator)
    first = _directions(count, d, generator)
    if d == 2:
        second = torch.stack([-first[:, 1], first[:, 0]], dim=1)
    else:
        normal = torch.linalg.cross(first, _directions(count, d, generator))
        second = torch.linalg.cross(normal / normal.norm(dim=1, keepdim=True).clamp_min(1e-12), first)

    def at(angles: Tensor) -> Tensor:
        """Points (K, A, width) at angles (K, A) or (1, A)."""
        around = angles.cos()[..., None] * first[:, None] + angles.sin()[..., None] * second[:, None]
        return centre[:, None] + radius[:, None] * around

    turn = 2.0 * math.pi * torch.arange(_LOOKED, dtype=torch.float64)[None] / _LOOKED
    looked = at(turn).reshape(-1, d)
    inside = _reachable(roadmap, looked, "circle", generator).reshape(count, _LOOKED)
    kept = inside.all(1) if kind == "circle_random" else inside.any(1) & ~inside.all(1)
    begin = turn[0, inside.double().argmax(1)][:, None]
    return at(begin + 2.0 * math.pi * torch.linspace(0.0, 1.0, waypoints, dtype=torch.float64))[kept]


def _reachable(roadmap: Roadmap, points: Tensor, shape: str, generator: torch.Generator) -> Tensor:
    """(K,) points that a projection from one of a few random starts reaches."""
    robot, starts = roadmap.robot, _STARTS[shape]
    targets = points.repeat_interleave(starts, dim=0).to(robot.lower).T.contiguous()
    guesses = robot.sample(len(points) * starts, generator).T.contiguous()
    valid = project_columns(robot, roadmap.task, targets, guesses, DEFAULT_TOLERANCES)[1]
    return valid.reshape(-1, starts).any(1).cpu()


def _directions(count: int, d: int, generator: torch.Generator) -> Tensor:
    """Random unit vectors (count, d)."""
    drawn = torch.randn(count, d, dtype=torch.float64, generator=generator)
    return drawn / drawn.norm(dim=1, keepdim=True)


def _line(start: Tensor, end: Tensor, waypoints: int) -> Tensor:
    fractions = torch.linspace(0.0, 1.0, waypoints, dtype=torch.float64)
    return start[:, None] + fractions[:, None] * (end - start)[:, None]
