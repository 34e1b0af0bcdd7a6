"""The continuity check of edges: the paper's Algorithm 1, for many edges at once."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from grr_torch.errors import ParameterError
from grr_torch.projection.project import DEFAULT_TOLERANCES, Tolerances, point_columns, project_columns
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import difference, interpolate
from grr_torch.spaces.task import TaskSpace

# with c > 1 the recursion need not end: what is unfinished at this depth is broken
_DEPTH = 20
# and so is an edge of which a bisection gives more halves than this, those counted that are short enough
_PIECES = 1 << 12


def is_continuous(
    robot: Robot,
    task: TaskSpace,
    points_a: Tensor,
    points_b: Tensor,
    configurations_a: Tensor,
    configurations_b: Tensor,
    *,
    c: float | None = None,
    epsilon: float | None = None,
    tolerances: Tolerances = DEFAULT_TOLERANCES,
) -> Tensor:
    """Whether a straight task-space line is followed without going far from the straight joint-space line.

    The paper's Algorithm 1 (IsContinuous): the middle of both lines is projected; it may lie at most c · D_q from
    either end; and so on for both halves until they are shorter than ε. Stricter than the paper's text: a middle
    that does not converge or collides breaks the edge, and that of an edge shorter than ε is checked as well.

    Args:
        robot: The robot.
        task: The task space.
        points_a: (*batch, width) starts.
        points_b: (*batch, width) ends.
        configurations_a: (*batch, n) configurations at the starts.
        configurations_b: (*batch, n) configurations at the ends.
        c: Largest deviation as a share of the distance; 0.5 · √n by default.
        epsilon: Distance below which no more is asked [rad]; 0.05 · √n by default.
        tolerances: Of the projections.

    Returns:
        (*batch,) bool.

    Raises:
        ParameterError: Shapes do not fit, an input is not finite, or c ≤ 0.5 or ε ≤ 0.
    """
    usual_c, usual_epsilon = usual_bounds(robot)
    c = usual_c if c is None else c
    epsilon = usual_epsilon if epsilon is None else epsilon
    if not 0.5 < c < math.inf:
        raise ParameterError("c", c, "above 0.5")
    if not 0.0 < epsilon < math.inf:
        raise ParameterError("epsilon", epsilon, "above 0")
    p = (point_columns(robot, task, points_a), point_columns(robot, task, points_b))
    q = (robot.columns(configurations_a), robot.columns(configurations_b))
    batch = points_a.shape[:-1]
    if any(part.shape[:-1] != batch for part in (points_b, configurations_a, configurations_b)):
        shapes = tuple(tuple(part.shape) for part in (points_a, points_b, configurations_a, configurations_b))
        raise ParameterError("points and configurations", shapes, "equal batch shapes")
    if not bool(q[0].isfinite().all() & q[1].isfinite().all()):
        raise ParameterError("configurations", "NaN or infinite values", "finite values")
    return continuous_columns(robot, task, p, q, c, epsilon, tolerances).reshape(batch)


def usual_bounds(robot: Robot) -> tuple[float, float]:
    """C and ε [rad] of `is_continuous`, as the paper chooses them: 0.5 √n and 0.05 √n."""
    return 0.5 * math.sqrt(robot.n), 0.05 * math.sqrt(robot.n)


def continuous_columns(
    robot: Robot,
    task: TaskSpace,
    p: tuple[Tensor, Tensor],
    q: tuple[Tensor, Tensor],
    c: float,
    epsilon: float,
    tolerances: Tolerances,
    depth: int = _DEPTH,
) -> Tensor:
    """`is_continuous` (N,) for columns: points (width, N) and configurations (n, N). One projection a bisection.

    What is still too far apart after `depth` bisections is not continuous.
    """
    wraps = robot.continuous[:, None]
    (pa, pb), (qa, qb) = p, q
    continuous = torch.ones(qa.shape[1], dtype=torch.bool, device=qa.device)
    edge = torch.arange(qa.shape[1], device=qa.device)
    length = _length(qa, qb, wraps)
    for _ in range(depth):
        pm = task.interpolate(pa.T, pb.T, 0.5).T
        qm, valid = project_columns(robot, task, pm, interpolate(qa, qb, 0.5, wraps), tolerances)
        first, second = _length(qa, qm, wraps), _length(qm, qb, wraps)
        long = length >= epsilon
        broken = ~valid | (long & ~(torch.maximum(first, second) <= c * length))
        continuous[edge[broken]] = False
        # halves that are still long, of edges that are still whole
        going_on = long & continuous[edge]
        split = torch.cat([going_on & (first >= epsilon), going_on & (second >= epsilon)])
        edge = torch.cat([edge, edge])
        if bool((edge.bincount(minlength=len(continuous)) > _PIECES).any()):
            continuous[edge.bincount(minlength=len(continuous)) > _PIECES] = False
            split &= continuous[edge]
        left = split.nonzero()[:, 0]
        if len(left) == 0:
            return continuous
        edge, length = edge[left], torch.cat([first, second])[left]
        pa, pb, qa, qb = (_halves(*pair, left) for pair in ((pa, pm), (pm, pb), (qa, qm), (qm, qb)))
    continuous[edge] = False
    return continuous


def _length(start: Tensor, end: Tensor, wraps: Tensor) -> Tensor:
    """D_q (N,) of columns."""
    return difference(start, end, wraps).square().sum(0).sqrt()


def _halves(first: Tensor, second: Tensor, left: Tensor) -> Tensor:
    return torch.cat([first, second], dim=1).index_select(1, left)
