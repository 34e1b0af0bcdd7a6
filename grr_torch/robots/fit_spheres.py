"""Fitting spheres to the collision geometry of a URDF.

A sphere around an inside point c whose distance to the surface is d sticks out of the solid by at most τ if its
radius is d + τ: the ball of radius d lies inside. So for a tolerance τ, covering the solid is a set cover over
such spheres, and for a number of spheres it is a search for the smallest τ.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial.distance import cdist

from grr_torch.errors import ParameterError, UrdfError, check_seed
from grr_torch.progress import Progress, silent
from grr_torch.robots.geometry import Mask, Points, Solid, link_meshes, surface_points
from grr_torch.robots.spheres import Sphere
from grr_torch.robots.tighten_spheres import tighten, unit_sphere
from grr_torch.robots.urdf import Urdf

if TYPE_CHECKING:
    from trimesh import Trimesh

# spheres a link, unless told otherwise
DEFAULT_COUNT = 16
# added to every radius [m], for what lies between the sampled points
_SPARE = 5e-5
# spheres are written with this many decimals [m]; radii are rounded up
_DECIMALS = 5


@dataclass(frozen=True)
class LinkFit:
    """How well the spheres of one link fit.

    Attributes:
        spheres: The spheres.
        mean_excess: Area-weighted mean distance [m] of the spheres' outer surface from the geometry.
        max_excess: Largest distance [m] of the spheres' outer surface from the geometry.
        uncovered: How far [m] the point that sticks out most lies outside all spheres; 0 if none does.
    """

    spheres: tuple[Sphere, ...]
    mean_excess: float
    max_excess: float
    uncovered: float


def fit_spheres(
    urdf: Urdf,
    *,
    count: int | None = None,
    tolerance: float | None = None,
    starts: int = 3,
    seed: int = 0,
    progress: Progress = silent,
) -> dict[str, LinkFit]:
    """Fits spheres to each link that has collision geometry, so that every point of it is inside one.

    Args:
        urdf: The robot.
        count: At most this many spheres a link, with the least excess found (16 if neither is given).
        tolerance: As few spheres as found whose surface lies at most this far [m] from the geometry.
        starts: With `count`, descents from different starts, of which the best is kept; 0: the set cover as it is.
        seed: For the sampled surface points.
        progress: Told how many links are fitted.

    Returns:
        The fit of each link.

    Raises:
        ParameterError: Both or an invalid one of `count` and `tolerance` is given.
        UrdfError: No link has collision geometry, or a mesh cannot be read.
        MeshNotFoundError: A mesh is missing.
    """
    if count is not None and tolerance is not None:
        raise ParameterError("spheres and tolerance", (count, tolerance), "one of the two")
    if count is not None and not 1 <= count <= 1000:
        raise ParameterError("spheres", count, "1 to 1000 a link")
    if tolerance is not None and not 1e-4 <= tolerance < np.inf:
        raise ParameterError("tolerance", tolerance, "0.0001 m or more")
    seed = check_seed(seed)
    if not 0 <= starts <= 100:
        raise ParameterError("starts", starts, "0 to 100")
    links = [link for link, shapes in urdf.collisions.items() if shapes]
    if not links:
        raise UrdfError(urdf.name, "no link has collision geometry to fit spheres to")
    meshes = {link: link_meshes(urdf, link) for link in links}  # what is missing or broken is said before the work
    fits: dict[str, LinkFit] = {}
    for done, link in enumerate(links):
        progress("fitting spheres", done, len(links))
        fits[link] = _fit_link(
            meshes[link], DEFAULT_COUNT if tolerance is None and count is None else count, tolerance, starts, seed
        )
    progress("fitting spheres", len(links), len(links))
    return fits


def _fit_link(meshes: list[Trimesh], count: int | None, tolerance: float | None, starts: int, seed: int) -> LinkFit:
    size = float(np.linalg.norm(np.ptp(np.vstack([mesh.bounds for mesh in meshes]), axis=0)))
    if not 1e-5 < size < 1e4:
        raise ParameterError("collision geometry", f"a part {size:g} m large", "1e-5 to 1e4 m")
    solid = Solid.sampled(meshes, _spacing(size), seed)
    candidates, depths = _candidates(solid, size)
    inner = candidates[:: max(1, len(candidates) // 1000)]
    targets = np.vstack([solid.boundary[_thinned(solid.boundary, 4000)], inner])
    distances = cdist(candidates, targets)
    if count is None:
        tolerance, starts = tolerance or 0.0, 0
        chosen = _cover(distances, depths + tolerance, len(targets))
        if chosen is None:
            least = float((distances - depths[:, None]).min(0).max())
            raise ParameterError("tolerance", tolerance, f"{1.05 * least:.4f} m or more for a part of this size")
    else:
        chosen, tolerance = _least_tolerance(distances, depths, count, size)
        while len(chosen) < min(count, len(candidates)):  # spheres the cover had no need of, put where there is room
            chosen.append(int(cdist(candidates, candidates[chosen]).min(1).argmax()))
    dense = [surface_points(meshes, _spacing(size) / 2.0, seed + k) for k in (1, 2, 3, 4)]
    covers = [(candidates[chosen], depths[chosen] + tolerance)]
    rng = np.random.default_rng(seed)
    for start in range(starts):
        # descent ends in a local minimum, so it is begun from more than one place
        centres, radii = covers[0]
        moved = centres + rng.normal(scale=0.008 * size * start, size=centres.shape)
        covers.append(tighten(moved, radii, solid, inner, size, seed + start))
    fits = [measure(_closed(*cover, targets, dense[:2], dense[2]), solid, dense[3]) for cover in covers]
    return min(fits, key=lambda fit: fit.mean_excess + 0.1 * fit.max_excess)


def _closed(
    centres: Points, radii: Points, targets: Points, surfaces: list[Points], check: Points
) -> tuple[Sphere, ...]:
    """Spheres resized until no point of the geometry is outside, and rounded."""
    centres = np.round(centres, _DECIMALS)
    radii = _shrunk(centres, radii, targets)
    for surface in surfaces:
        radii = _grown(centres, radii, surface)
    # what another sample finds outside tells what lies between the points
    radii = radii + _outside(check, centres, radii) + _SPARE
    radii = np.ceil(radii * 10**_DECIMALS) / 10**_DECIMALS
    # a sphere inside another one adds nothing; of equal ones the first stays
    hidden = cdist(centres, centres) + radii[:, None] <= radii
    hidden &= ~(hidden.T & np.triu(np.ones_like(hidden)))
    kept = np.flatnonzero(~hidden.any(1))
    return tuple(
        Sphere((float(x), float(y), float(z)), float(r))
        for (x, y, z), r in zip(centres[kept], radii[kept], strict=True)
    )


def _spacing(size: float) -> float:
    """How densely a link's surface is sampled [m]: a hundredth of the link, at most 2 mm."""
    return min(size / 100.0, 0.002)


def measure(spheres: tuple[Sphere, ...], solid: Solid, surface: Points) -> LinkFit:
    """Measures how tightly spheres cover a solid, and whether they cover points on its surface."""
    centres = np.array([sphere.center for sphere in spheres])
    radii = np.array([sphere.radius for sphere in spheres])
    shell = np.vstack([centre + radius * unit_sphere(500) for centre, radius in zip(centres, radii, strict=True)])
    area = np.repeat(radii**2, 500)
    # the outer surface: what neither another sphere nor the geometry covers
    outer = ((cdist(shell, centres) - radii).min(1) > -1e-9) & ~solid.inside(shell)
    excess = solid.distance(shell[outer])
    return LinkFit(
        spheres,
        mean_excess=float(np.average(excess, weights=area[outer])) if outer.any() else 0.0,
        max_excess=float(excess.max()) if outer.any() else 0.0,
        uncovered=_outside(surface, centres, radii),
    )


def _outside(points: Points, centres: Points, radii: Points) -> float:
    """How far [m] the points stick out of the spheres at most."""
    parts = np.array_split(points, 1 + len(points) // 100_000)
    return max(0.0, *(float((cdist(part, centres) - radii).min(1).max()) for part in parts))


def _candidates(solid: Solid, size: float) -> tuple[Points, Points]:
    """Inside points (C, 3) on a grid, and their distances to the surface (C,)."""
    corners = np.vstack([mesh.bounds for mesh in solid.meshes])
    low, high = corners.min(0), corners.max(0)
    step = max(float(np.prod(high - low) / 6000.0) ** (1.0 / 3.0), size / 400.0)
    axes = [np.linspace(a, b, max(3, round((b - a) / step) + 1)) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = grid[solid.inside(grid)]
    # thin parts that the grid misses are covered from their own surface
    centres = np.vstack([grid, solid.boundary[_thinned(solid.boundary, 500)]])
    return centres, solid.distance(centres)


def _least_tolerance(distances: Points, depths: Points, count: int, size: float) -> tuple[list[int], float]:
    """The smallest tolerance, to a fiftieth, at which `count` spheres cover all targets."""
    low, high = 0.0, size
    best = _cover(distances, depths + high, count)
    while best is None:
        low, high = high, 2.0 * high
        best = _cover(distances, depths + high, count)
    while high - low > 0.02 * high:
        middle = 0.5 * (low + high)
        cover = _cover(distances, depths + middle, count)
        if cover is None:
            low = middle
        else:
            best, high = cover, middle
    return best, high


def _cover(distances: Points, radii: Points, count: int) -> list[int] | None:
    """Greedy set cover: rows of `distances` (C, T) whose balls reach all columns; None if over `count`."""
    reached: Mask = distances <= radii[:, None]
    gains = reached.sum(1)
    chosen: list[int] = []
    left = np.ones(distances.shape[1], dtype=bool)
    while left.any():
        best = int(gains.argmax())
        if len(chosen) == count or gains[best] == 0:
            return None
        chosen.append(best)
        new = reached[best] & left
        gains = gains - reached[:, new].sum(1)
        left &= ~new
    return chosen


def _shrunk(centres: Points, radii: Points, targets: Points) -> Points:
    """Radii no larger than the targets need: each target is left to the sphere in which it lies deepest."""
    distances = cdist(targets, centres)
    owner = (distances - radii).argmin(1)
    return np.array([distances[owner == k, k].max(initial=0.0) for k in range(len(centres))])


def _grown(centres: Points, radii: Points, points: Points) -> Points:
    """Radii large enough that no point is left outside: the nearest sphere takes it in."""
    for part in np.array_split(points, 1 + len(points) // 100_000):
        distances = cdist(part, centres)
        owner = (distances - radii).argmin(1)
        radii = np.array([max(radii[k], distances[owner == k, k].max(initial=0.0)) for k in range(len(centres))])
    return radii


def _thinned(points: Points, count: int) -> npt.NDArray[np.intp]:
    """Indices of about `count` points that are spread evenly."""
    if len(points) <= count:
        return np.arange(len(points))
    low, high = points.min(0), points.max(0)
    cell = float(np.linalg.norm(high - low)) / 200.0
    while True:
        keys = np.floor((points - low) / cell).astype(np.int64)
        index = np.unique(keys, axis=0, return_index=True)[1]
        if len(index) <= count:
            return index
        cell *= 1.15
