"""Paths that suit a roadmap: a middle to start from, and a circle and a line round it."""

from __future__ import annotations

import math
from functools import partial

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from grr_torch.applications.retime import usual_speeds
from grr_torch.applications.teleoperate import FASTEST
from grr_torch.errors import ParameterError, UnknownNameError
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.resolution.slices import fullest_slice
from grr_torch.spaces.configuration import difference

KINDS = ("circle", "line")

# metres a second along a path
_SPEED = 0.15
# points at which a candidate is tried, sizes that are tried, and middles
_POINTS, _SIZES, _MIDDLES = 96, 16, 5
# of the largest size that fits, so that the path is not on the edge of reach; and of the joints' velocity limits
_SHARE = 0.8
# two configurations farther apart than this are not neighbours on a path [rad]
_APART = 0.4


def middles(roadmap: Roadmap, count: int = 1) -> Tensor:
    """The resolved vertices (count, width) that are deepest inside the roadmap, the deepest first.

    Deep is what is far from unresolved vertices, from uncertified cells and from the roadmap's bounds. Of equally
    deep ones, the first is nearest to the mean of all. Where rotation varies, all are of one rotation, that in which
    most vertices are resolved.

    Raises:
        ParameterError: No vertex is resolved.
    """
    roadmap = fullest_slice(roadmap)
    points = roadmap.positions
    doubtful = ~roadmap.resolved
    for corners in roadmap.uncertified:
        doubtful[corners] = True
    good = points[~doubtful] if not bool(doubtful.all()) else points[roadmap.resolved]
    if len(good) == 0:
        raise ParameterError("roadmap", "one without a resolved vertex", "one to move on")
    depth = torch.minimum(good - points.amin(0), points.amax(0) - good).amin(1)
    if bool(doubtful.any()):
        depth = depth.minimum(torch.from_numpy(cKDTree(points[doubtful].numpy()).query(good.numpy())[0]))
    away = (good - good.mean(0)).norm(dim=1)
    chosen = good[(1e-3 * away - depth).argsort()[:count]]
    rotation = roadmap.points[:1, roadmap.task.dimension :]
    return torch.cat([chosen, rotation.expand(len(chosen), -1)], dim=1)


def example_path(roadmap: Roadmap, kind: str, rate: float = 50.0) -> Tensor:
    """A large circle or line (N, width) on which the roadmap is continuous, one waypoint for each control step [m].

    A circle is horizontal and ends where it began, and so does a line: it goes there and back. The tool moves at
    0.15 m/s, or as fast as 0.8 of the joints' velocity limits allow, and its rotation stays. Circles round the base's
    axis are tried too.

    Args:
        roadmap: The roadmap.
        kind: Of `KINDS`.
        rate: Control steps in a second [Hz].

    Raises:
        UnknownNameError: No such kind.
        ParameterError: No such path fits into the roadmap, or the rate is out of its range.
    """
    if kind not in KINDS:
        raise UnknownNameError("path", kind, KINDS)
    if not 0.0 < rate <= FASTEST:
        raise ParameterError("rate", rate, f"above 0 and up to {FASTEST:,.0f} Hz")
    centres = middles(roadmap, _MIDDLES)
    axis = centres[:1].clone()
    axis[:, :2] = 0.0
    centres = torch.cat([centres, axis])
    d, resolved = roadmap.task.dimension, roadmap.positions[roadmap.resolved]
    half = 0.5 * float((resolved.amax(0) - resolved.amin(0)).max())
    sizes = half * torch.arange(_SIZES, 0, -1, dtype=torch.float64) / _SIZES
    largest = None
    for size in sizes.tolist():
        if largest is not None and size > _SHARE * largest:
            continue
        draw = partial(_circles, centres, size) if kind == "circle" else partial(_lines, centres, d, size)
        fits = _passable(roadmap, draw(_POINTS)).nonzero()[:, 0]
        if largest is None and len(fits) and size > sizes[-1]:
            largest = size
        elif len(fits):
            length = 2.0 * math.pi * size if kind == "circle" else 4.0 * size
            count = max(8, round(length / _SPEED * rate)) + 1
            busiest = _busiest(roadmap, draw(count)[fits[0]]) * rate
            return draw(round(count * max(1.0, busiest / _SHARE)))[fits[0]]
    valid = "one that leads through certified cells only; that takes a roadmap of more points, or a file of waypoints"
    raise ParameterError("path", kind, valid)


def _busiest(roadmap: Roadmap, path: Tensor) -> float:
    """The longest step of a joint along a path (N, width), by how far it gets in a second."""
    q = roadmap.solve(path).configurations
    steps = difference(q[:-1], q[1:], roadmap.robot.continuous).abs() / usual_speeds(roadmap.robot.velocity_limits)
    return float(steps.max())


def _circles(centres: Tensor, radius: float, count: int) -> Tensor:
    """Horizontal circles (C, count, width) round centres (C, width)."""
    angles = torch.linspace(0.0, 2.0 * math.pi, count, dtype=torch.float64)
    offsets = centres.new_zeros(count, centres.shape[1])
    offsets[:, 0], offsets[:, 1] = radius * angles.cos(), radius * angles.sin()
    return centres[:, None] + offsets


def _lines(centres: Tensor, d: int, half: float, count: int) -> Tensor:
    """Lines (C · K, count, width) through centres (C, width) in K directions, from one end to the other and back."""
    grid = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)] * d)
    # of each pair of opposite ones, the one that comes later in the order
    directions = torch.nn.functional.normalize(grid[len(grid) // 2 + 1 :], dim=1)
    there = torch.linspace(-1.0, 1.0, (count + 1) // 2, dtype=torch.float64)
    fractions = torch.cat([there, there.flip(0)[count % 2 :]])
    offsets = half * fractions[:, None] * directions[:, None]
    offsets = torch.nn.functional.pad(offsets, (0, centres.shape[1] - d))
    return (centres[:, None, None] + offsets).flatten(0, 1)


def _passable(roadmap: Roadmap, paths: Tensor) -> Tensor:
    """(C,) paths (C, M, width) on which the map has certified configurations everywhere, neighbours near each other."""
    q = roadmap.solve(paths)
    good = torch.from_numpy((q.status == "solved").all(1))
    steps = difference(q.configurations[:, :-1], q.configurations[:, 1:], roadmap.robot.continuous)
    return good & (steps.norm(dim=2) < _APART).all(1).cpu()
