"""Points drawn in a roadmap's certified cells and solved by it, a piece at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from grr_torch.errors import ParameterError, check_kind, check_seed, check_whole
from grr_torch.learning.region import certified_region
from grr_torch.learning.split import Split
from grr_torch.progress import Progress, silent
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.tables import PIECE


@dataclass(frozen=True, eq=False)
class Samples:
    """Points and what a roadmap says of them.

    Attributes:
        points: (N, d) [m].
        configurations: (N, n) [rad or m]; NaN where not valid.
        valid: (N,) bool.
        split: (N,) uint8, indices into `SPLITS`.
    """

    points: Tensor
    configurations: Tensor
    valid: Tensor
    split: Tensor


def check_learnable(roadmap: Roadmap) -> None:
    """Checks that a network can be trained from a roadmap.

    Raises:
        ParameterError: It is none, or rotation varies in its task.
    """
    check_kind("roadmap", roadmap, Roadmap, "Roadmap.load(file)")
    if roadmap.task.rotations is not None:
        raise ParameterError("task", roadmap.task.kind, "position or fixed-rotation: varying rotation is not learned")


def draw_samples(
    roadmap: Roadmap, count: int, split: Split, *, seed: int = 0, progress: Progress = silent
) -> Iterator[Samples]:
    """Samples in pieces, so that memory does not grow with their number.

    Args:
        roadmap: The roadmap.
        count: How many samples in all; points that the map does not solve are among them, and not valid.
        split: Training, validation and test.
        seed: Of the points.
        progress: Told how many are solved.

    Raises:
        ParameterError: The count is not valid, or no cell is certified.
    """
    count = check_whole("samples", count, 1)
    generator = torch.Generator().manual_seed(check_seed(seed))
    region, splitter = certified_region(roadmap, progress), split.of(roadmap)
    for start in range(0, count, PIECE):
        progress("solving", start, count)
        points = region.draw(min(PIECE, count - start), generator)
        solution = roadmap.solve(points)
        yield Samples(points, solution.configurations.cpu(), solution.valid.cpu(), splitter(points))
    progress("solving", count, count)
