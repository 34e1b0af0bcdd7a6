"""How fast a roadmap is used: solving, and steps of teleoperation."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from grr_torch.applications.teleoperate import Teleoperator
from grr_torch.experiments.paths import KINDS, draw_paths
from grr_torch.experiments.teleoperation import MAX_STEP, RATE, starts
from grr_torch.experiments.timing import median_seconds
from grr_torch.resolution.roadmap import Roadmap

# points solved at once, and arms in one step
_POINTS, _ARMS = 100_000, 100
# paths of each kind that one arm follows
_PATHS = 5


@dataclass(frozen=True)
class UseFigures:
    """How fast a roadmap is used.

    Attributes:
        points_per_second: Solved at once, inside cells whose corners are all resolved.
        valid: The share of them that is valid.
        one_point: Time to solve one [s].
        step_median: Of one arm that follows paths of all kinds, targets out of reach and detours included [s].
        step_p99: The 99th percentile [s].
        arm_step: Time of a step of 100 arms that follow random lines, over their number, median [s].
    """

    points_per_second: float
    valid: float
    one_point: float
    step_median: float
    step_p99: float
    arm_step: float


def measure_use(roadmap: Roadmap, repeats: int, *, seed: int = 0) -> UseFigures:
    """Measures a roadmap in R³ over a staggered grid.

    Args:
        roadmap: The roadmap.
        repeats: Medians of solving are taken over so many.
        seed: Of points and paths.
    """
    points = points_in_cells(roadmap, _POINTS, seed)
    calls = {"all": lambda: roadmap.solve(points), "one": lambda: roadmap.solve(points[:1])}
    seconds = median_seconds(calls, repeats)
    steps = np.array(list(_step_seconds(roadmap, seed)))
    many = draw_paths(roadmap, "line_random", _ARMS, seed=seed)
    return UseFigures(
        points_per_second=_POINTS / seconds["all"],
        valid=float(roadmap.solve(points).valid.double().mean()),
        one_point=seconds["one"],
        step_median=float(np.median(steps)),
        step_p99=float(np.quantile(steps, 0.99)),
        arm_step=float(np.median(list(_follow(roadmap, many)))) / _ARMS,
    )


def points_in_cells(roadmap: Roadmap, count: int, seed: int) -> Tensor:
    """Random points (count, 3) of the grid's cells whose corners and centres are all resolved."""
    lattice = roadmap.graph.lattice
    assert lattice is not None
    generator = torch.Generator().manual_seed(seed)
    starts_, ends = roadmap.graph.adjacency
    degrees = starts_.diff()
    corners = int((torch.tensor(lattice.cells) + 1).prod())
    centres = torch.arange(corners, len(roadmap.points))
    around = ends[starts_[centres][:, None] + torch.arange(int(degrees[corners]))]
    whole = centres[roadmap.resolved[centres] & roadmap.resolved[around].all(1)]
    chosen = whole[torch.randint(len(whole), (count,), generator=generator)]
    shifts = torch.rand(count, 3, dtype=torch.float64, generator=generator) - 0.5
    return roadmap.points[chosen] + shifts * torch.tensor(lattice.spacing, dtype=torch.float64)


def _step_seconds(roadmap: Roadmap, seed: int) -> Iterator[float]:
    """Times of the steps of one arm at a time, on paths of all kinds."""
    for kind in KINDS:
        for path in draw_paths(roadmap, kind, _PATHS, seed=seed):
            yield from _follow(roadmap, path[None])


def _follow(roadmap: Roadmap, paths: Tensor) -> Iterator[float]:
    """Times of the steps of arms on paths (arms, waypoints, width)."""
    teleoperator = Teleoperator(roadmap, RATE, max_step=MAX_STEP, start=starts(roadmap, paths[:, 0]))
    for targets in paths.unbind(1):
        begin = time.perf_counter()
        teleoperator.step(targets)
        yield time.perf_counter() - begin
