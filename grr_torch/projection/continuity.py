"""The continuity check of edges: the paper's Algorithm 1, for many edges at once."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from grr_torch.errors import ParameterError
from grr_torch.projection.project import DEFAULT_TOLERANCES, Tolerances, point_columns, project_columns
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import distance, interpolate
from grr_torch.spaces.task import TaskSpace

# with c > 1 the recursion need not end: what is unfinished at this depth is broken
_DEPTH = 20
# and so is an edge that has come to this many pieces, each longer than ε
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
    c = 0.5 * math.sqrt(robot.n) if c is None else c
    epsilon = 0.05 * math.sqrt(robot.n) if epsilon is None else epsilon
    if not 0.5 < c < math.inf:
        raise ParameterError("c", c, "above 0.5")
    if not 0.0 < epsilon < math.inf:
        raise ParameterError("epsilon", epsilon, "above 0")
    p = (point_columns(robot, task, points_a).T, point_columns(robot, task, points_b).T)
    q = (robot.columns(configurations_a).T, robot.columns(configurations_b).T)
    batch = points_a.shape[:-1]
    if any(part.shape[:-1] != batch for part in (points_b, configurations_a, configurations_b)):
        shapes = tuple(tuple(part.shape) for part in (points_a, points_b, configurations_a, configurations_b))
        raise ParameterError("points and configurations", shapes, "equal batch shapes")
    if not bool(q[0].isfinite().all() & q[1].isfinite().all()):
        raise ParameterError("configurations", "NaN or infinite values", "finite values")
    return _check(robot, task, p, q, c, epsilon, tolerances).reshape(batch)


def _check(
    robot: Robot,
    task: TaskSpace,
    p: tuple[Tensor, Tensor],
    q: tuple[Tensor, Tensor],
    c: float,
    epsilon: float,
    tolerances: Tolerances,
) -> Tensor:
    continuous = torch.ones(len(q[0]), dtype=torch.bool, device=q[0].device)
    (pa, pb), (qa, qb) = p, q
    edge = torch.arange(len(qa), device=qa.device)
    for _ in range(_DEPTH):
        length = distance(qa, qb, robot.continuous)
        pm = task.interpolate(pa, pb, 0.5)
        bisect = interpolate(qa, qb, 0.5, robot.continuous)
        solved, valid = project_columns(robot, task, pm.T, bisect.T, tolerances)
        qm = solved.T
        deviation = torch.maximum(distance(qa, qm, robot.continuous), distance(qm, qb, robot.continuous))
        long = length >= epsilon
        broken = ~valid | (long & ~(deviation <= c * length))
        continuous[edge[broken]] = False
        # halves that are still long, of edges that are still whole
        edge, long = torch.cat([edge, edge]), torch.cat([long, long])
        pa, pb = torch.cat([pa, pm]), torch.cat([pm, pb])
        qa, qb = torch.cat([qa, qm]), torch.cat([qm, qb])
        continuous[edge.bincount(minlength=len(continuous)) > _PIECES] = False
        split = long & continuous[edge]
        split[split.clone()] = distance(qa[split], qb[split], robot.continuous) >= epsilon
        if not bool(split.any()):
            return continuous
        edge, pa, pb, qa, qb = edge[split], pa[split], pb[split], qa[split], qb[split]
    continuous[edge] = False
    return continuous
