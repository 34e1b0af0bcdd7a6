"""Times for the waypoints of a path: as fast as the joints' limits allow."""

from __future__ import annotations

import numpy as np
import torch
from scipy.optimize import linprog
from scipy.sparse import diags, vstack
from torch import Tensor

from grr_torch.errors import GrrError, ParameterError

# what is taken for a joint that has no velocity limit [rad/s or m/s]
_SPEED = 1.0
# the smallest limits
_SLOWEST = 1e-9
# of every time, so that rounding does not break a limit
_SLACK = 1e-9
# times stay finite where a path stops [share of the highest ṡ²]
_LEAST = 1e-8


def retime(q: Tensor, velocity_limits: Tensor, acceleration_limits: Tensor | None = None) -> Tensor:
    """Times (K,) [s] at which unwrapped configurations (K, n) are passed, from 0.

    With velocity limits alone, each piece takes as long as its slowest joint. With acceleration limits the arm begins
    and ends at rest, and the speed ṡ along the path solves the linear program of time-optimal path
    parameterisation (Verscheure et al. 2009) in b = ṡ²: maximise Σ b, with q′ b′/2 + q″ b within the limits. Where
    differences of the result still exceed them, all of it is slowed down.

    Args:
        q: (K, n) configurations, no two neighbours equal.
        velocity_limits: (n,) [rad/s or m/s].
        acceleration_limits: (n,) [rad/s² or m/s²].
    """
    steps = q.diff(dim=0)
    if len(steps) == 0:
        return q.new_zeros(len(q))
    durations = (steps.abs() / velocity_limits).amax(1)
    if acceleration_limits is not None:
        durations = _with_accelerations(steps, durations, acceleration_limits)
    slack = max(_SLACK, 16.0 * torch.finfo(q.dtype).eps)
    return torch.cat([q.new_zeros(1), (durations * (1.0 + slack)).cumsum(0)])


def accelerations(q: Tensor, times: Tensor) -> Tensor:
    """Accelerations (K, n) of configurations (K, n) at times (K,), by differences; from and to rest."""
    durations = times.diff()
    velocity = torch.nn.functional.pad(q.diff(dim=0) / durations[:, None], (0, 0, 1, 1))
    apart = 0.5 * (torch.nn.functional.pad(durations, (0, 1)) + torch.nn.functional.pad(durations, (1, 0)))
    return velocity.diff(dim=0) / apart[:, None]


def _with_accelerations(steps: Tensor, least: Tensor, limits: Tensor) -> Tensor:
    """Durations (K − 1,) of steps (K − 1, n), not shorter than the least ones."""
    lengths = steps.norm(dim=1)
    if len(steps) == 1:
        # its speed differs from rest by v in half its time, at either end
        return torch.maximum(least, (2.0 * steps.abs() / limits).sqrt().amax(1))
    highest = torch.nn.functional.pad((lengths / least).square(), (1, 1))
    # ṡ² at the waypoints, 0 at both ends
    speed = _highest_speed(steps / lengths[:, None], lengths, torch.minimum(highest[1:], highest[:-1]), limits).sqrt()
    durations = 2.0 * lengths / (speed[1:] + speed[:-1])
    q, times = (torch.cat([part[:1] * 0.0, part.cumsum(0)]) for part in (steps, durations))
    excess = (accelerations(q, times).abs() / limits).max().clamp_min(1.0)
    return durations * excess.sqrt()


def _highest_speed(tangents: Tensor, lengths: Tensor, bounds: Tensor, limits: Tensor) -> Tensor:
    """The largest ṡ² (K,) that stays below its bounds (K,), and with which no joint exceeds its acceleration limit.

    Where a piece of the path begins and where it ends, q′ s̈ + q″ ṡ² is limited, s̈ being constant on it.
    """
    count = len(lengths)
    bend = torch.zeros(count + 1, tangents.shape[1], dtype=tangents.dtype)
    bend[1:-1] = tangents.diff(dim=0) / (0.5 * (lengths[1:] + lengths[:-1]))[:, None]
    # with the largest acceleration of any piece as far as the middle of the path: where that is far below the other
    # bounds, all would come down to the solver's tolerance
    reach = float(lengths.sum() * (limits / tangents.abs().clamp_min(1e-12)).amin(1).max())
    bounds = bounds.clamp_max(reach)
    scale = float(bounds.max())
    rows = []
    for joint, limit in enumerate((limits / scale).tolist()):
        rise = (tangents[:, joint] / (2.0 * lengths * limit)).numpy()
        turn = (bend[:, joint] / limit).numpy()
        rows.append(diags([-rise + turn[:-1], rise], [0, 1], shape=(count, count + 1)))
        rows.append(diags([-rise, rise + turn[1:]], [0, 1], shape=(count, count + 1)))
    matrix = vstack(rows)
    upper = (bounds / scale).numpy()
    result = linprog(
        -np.ones(count + 1),
        vstack([matrix, -matrix]).tocsr(),
        np.ones(2 * matrix.shape[0]),
        bounds=np.column_stack([np.zeros(count + 1), upper]),
    )
    if result.x is None:
        raise GrrError(f"the path cannot be timed: {result.message}")
    return scale * torch.from_numpy(np.where(upper > 0.0, np.maximum(result.x, _LEAST), 0.0))


def per_joint(name: str, value: float | Tensor, like: Tensor) -> Tensor:
    """One positive number for each joint (n,).

    Raises:
        ParameterError: It is too small, or not one number or n of them.
    """
    given = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    if given.shape not in (torch.Size(), like.shape) or not bool(((given >= _SLOWEST) & given.isfinite()).all()):
        raise ParameterError(name, value, f"one finite number, {_SLOWEST:g} or more, or {len(like)} of them")
    return given.expand(len(like)).clone()


def usual_speeds(limits: Tensor) -> Tensor:
    """Velocity limits (n,) with 1 rad/s or 1 m/s where a joint has none."""
    return torch.where(limits.isfinite(), limits, _SPEED)
