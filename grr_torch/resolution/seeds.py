"""Seeds: configurations that the expansion starts from."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from grr_torch.errors import GrrWarning, SeedError
from grr_torch.projection.project import Tolerances, project_columns, tool_points
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import distance
from grr_torch.spaces.graph import TaskGraph
from grr_torch.spaces.task import TaskSpace
from grr_torch.tables import read_rows

# vertices near its tool that a seed is projected to
_TRIED = 8

SeedsLike = Tensor | np.ndarray[Any, Any] | Sequence[Sequence[float]]


def read_seeds(path: str | os.PathLike[str], joint_names: Sequence[str] | None = None) -> Tensor:
    """Reads seeds (S, n) from a file, one configuration a row: .npy, .parquet, or else text (.csv, .txt).

    Args:
        path: The file; see `grr_torch.tables.read_rows`.
        joint_names: Names of columns that may be in any order; None: columns have no names.

    Raises:
        FileFormatError: It is missing, does not hold a table of finite numbers, or has other columns.
    """
    return torch.from_numpy(np.concatenate(list(read_rows(Path(path), joint_names, "seeds"))))


def check_seeds(robot: Robot, seeds: SeedsLike) -> Tensor:
    """Seeds as (S, n), finite.

    Raises:
        SeedError: There are none, they have another length than n, or hold NaN.
    """
    try:
        table = torch.as_tensor(seeds, dtype=robot.dtype).detach()
    except (ValueError, TypeError, OverflowError) as error:
        raise SeedError(f"seeds are not a table of numbers: {error}") from error
    if table.ndim != 2 or table.shape[1] != robot.n:
        raise SeedError(
            f"seeds have shape {tuple(table.shape)}; valid: (S, {robot.n}), in the order of joints "
            f"{', '.join(robot.joint_names)}"
        )
    if len(table) == 0:
        raise SeedError("no seeds were given; valid: at least one configuration")
    bad = (~table.isfinite()).any(1).nonzero()[:, 0].tolist()
    if bad:
        raise SeedError(f"seeds {_names(bad)} hold NaN or infinite values", dict.fromkeys(bad, "not finite"))
    return table.to(robot.device)


def in_the_middle(robot: Robot, seeds: Tensor) -> Tensor:
    """The same poses of the arm with joints that can turn more than once near the middle of their limits.

    Every such joint turns by whole turns, the same number for all seeds (S, n), so that what is near stays near, as far
    as all of them stay within limits. Continuous joints stay as they are.
    """
    turn = 2.0 * math.pi
    rates: dict[int, list[float]] = {}
    for joint in robot.tree.joints:
        rates.setdefault(joint.dof, []).append(joint.multiplier if joint.revolute else math.nan)
    moved = seeds.clone()
    for dof, (lower, upper) in enumerate(zip(robot.lower.tolist(), robot.upper.tolist(), strict=True)):
        # a joint that follows must come round too
        whole = all(rate.is_integer() for rate in rates[dof])
        if len(seeds) == 0 or not whole or bool(robot.continuous[dof]) or not turn < upper - lower < math.inf:
            continue
        first, last = float(seeds[:, dof].amin()), float(seeds[:, dof].amax())
        wanted = round((lower + upper - first - last) / (2.0 * turn))
        fewest, most = math.ceil((lower - first) / turn), math.floor((upper - last) / turn)
        # what lies beyond a limit by a rounding is not turned away from it
        moved[:, dof] += turn * max(min(0, fewest), min(wanted, max(0, most)))
    return moved


def place_seeds(
    robot: Robot, task: TaskSpace, graph: TaskGraph, seeds: Tensor, tolerances: Tolerances, *, warn: bool = True
) -> tuple[Tensor, Tensor]:
    """Projects each seed to the vertex nearest to its tool, or the next nearest of eight that it reaches.

    Of seeds that share a vertex, the one that had to move least is kept. Seeds that cannot be used are named in a
    GrrWarning, if `warn`.

    Returns:
        Vertices (K,) and their configurations (K, n).

    Raises:
        SeedError: No seed can be used.
    """
    nearest = graph.nearest(tool_points(robot, task, seeds), _TRIED)
    tried = nearest.shape[1]
    targets = graph.points[nearest].to(seeds).reshape(-1, task.width)
    guesses = seeds.repeat_interleave(tried, dim=0)
    solved, valid = project_columns(robot, task, targets.T.contiguous(), guesses.T.contiguous(), tolerances)
    valid = valid.reshape(len(seeds), tried)
    wrong = {
        "outside joint limits": ~robot.within_limits(seeds),
        "in self-collision": robot.in_self_collision(seeds),
    }
    usable = valid.any(1) & ~torch.stack(list(wrong.values())).any(0)
    _report(usable, wrong, warn)
    first = valid.int().argmax(1)
    rows = torch.arange(len(seeds), device=seeds.device)
    configurations = solved.T.reshape(len(seeds), tried, robot.n)[rows, first]
    vertices = nearest.to(seeds.device)[rows, first]
    moved = torch.where(usable, distance(seeds, configurations, robot.continuous), torch.inf)
    chosen: dict[int, int] = {}
    for index in torch.argsort(moved, stable=True)[: int(usable.sum())].tolist():
        chosen.setdefault(int(vertices[index]), index)
    kept = torch.tensor(sorted(chosen.values()), device=seeds.device)
    return vertices[kept], configurations[kept]


def _report(usable: Tensor, wrong: dict[str, Tensor], warn: bool) -> None:
    """Warns, if asked to, of seeds that cannot be used, each with the first thing that is wrong with it.

    Raises:
        SeedError: None can.
    """
    reasons: dict[int, str] = {}
    for index in (~usable).nonzero()[:, 0].tolist():
        found = [reason for reason, seeds in wrong.items() if bool(seeds[index])]
        reasons[index] = (found or ["the task cannot be met near it"])[0]
    if not reasons:
        return
    text = "; ".join(f"seed {index}: {reason}" for index, reason in reasons.items())
    if len(reasons) == len(usable):
        raise SeedError(f"none of {len(usable)} seeds can be used: {text}", reasons)
    if warn:
        warnings.warn(f"{len(reasons)} of {len(usable)} seeds are not used: {text}", GrrWarning, stacklevel=4)


def _names(indices: Sequence[int]) -> str:
    return ", ".join(map(str, indices))
