"""Solving tables of points into files, with memory that does not grow with them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from grr_torch.applications.solve import STATUSES
from grr_torch.progress import Progress, silent
from grr_torch.tables import Array, table_writer, unique_names

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap


def solve_table(
    roadmap: Roadmap, pieces: Iterable[Array], count: int, out: Path, *, progress: Progress = silent
) -> dict[str, int]:
    """Solves points and writes a row for each: coordinates, joints (NaN where not valid), valid, status.

    Args:
        roadmap: The roadmap.
        pieces: Points (N, width).
        count: How many there are in all.
        out: A .csv, .npy (structured), .npz (points, configurations, valid, status, joint_names) or .parquet file.
        progress: Told how many are solved.

    Returns:
        How many points have which status, in the order of `STATUSES`; those that none has are left out.

    Raises:
        ParameterError: The suffix is not known, or points are not valid.
        OutputError: It cannot be written.
    """
    axes = roadmap.task.coordinates
    columns = {
        "points": axes,
        "configurations": unique_names(roadmap.robot.joint_names, (*axes, "valid", "status")),
        "valid": ["valid"],
        "status": ["status"],
    }
    counts = dict.fromkeys(STATUSES, 0)
    done = 0
    with table_writer(out, columns, count, {"joint_names": np.array(roadmap.robot.joint_names)}) as write:
        for piece in pieces:
            progress("solving", done, count)
            solution = roadmap.solve(torch.from_numpy(piece))
            write(
                {
                    "points": piece,
                    "configurations": solution.configurations.cpu().numpy(),
                    "valid": solution.valid.cpu().numpy(),
                    "status": solution.status,
                }
            )
            for status, number in zip(*np.unique(solution.status, return_counts=True), strict=True):
                counts[str(status)] += int(number)
            done += len(piece)
    progress("solving", count, count)
    return {status: number for status, number in counts.items() if number}
