"""Acceleration limits: never so fast that an arm could not stop free of self-collision."""

from __future__ import annotations

import torch
from torch import Tensor

from grr_torch.applications.lines import Follower
from grr_torch.applications.motions import SUBSTEPS
from grr_torch.applications.rejoin import clearance
from grr_torch.robots.few import LIMITS_SLACK
from grr_torch.spaces.configuration import difference

# a joint that is to move less [rad or m] is at rest
_AT_REST = 1e-9
# of the samples of one step, so many times are looked at on the way to a standstill
_STEPS_CHECKED = 4


def limit_acceleration(
    follower: Follower, gain: Tensor, q: Tensor, speed: Tensor, wanted: Tensor, goals: Tensor
) -> Tensor:
    """Motions (B, n) of one control step that change the speed by at most `gain`.

    They lead towards the wanted configurations, no faster than what can be braked before the goals. Braking takes all
    joints down together, so it goes straight on. A motion is made only if the way to a standstill after it is free,
    within limits and, from a contact, never deeper; if not, the arm brakes, on the way found free a step before.

    Args:
        follower: How arms move.
        gain: (n,) the most that a joint's motion changes from one step to the next [rad or m].
        q: (B, n) configurations.
        speed: (B, n) motions of the last step.
        wanted: (B, n) where the arms would go without acceleration limits.
        goals: (B, n) where they are to stop, if known; NaN where not.
    """
    motion = wanted - q
    left = difference(q, goals, follower.robot.continuous).abs()
    # the sum of v, v − a, v − 2a … must not exceed what is left
    fastest = (0.25 * gain**2 + 2.0 * gain * left).sqrt() - 0.5 * gain
    # joints that are where they are to stop, but for rounding, do not keep the others
    share = torch.where(motion.abs() > _AT_REST, fastest / motion.abs(), 1.0).nan_to_num(nan=1.0).amin(1).clamp_max(1.0)
    change = share[:, None] * motion - speed
    moved = speed + change * (gain / change.abs().clamp_min(1e-12)).amin(1).clamp_max(1.0)[:, None]
    moved = torch.maximum(torch.minimum(moved, follower.longest), -follower.longest)
    slower = speed * (1.0 - 1.0 / _braking_steps(speed, gain)[:, None])
    return torch.where(_can_stop(follower, gain, q, moved)[:, None], moved, slower)


def _braking_steps(motion: Tensor, gain: Tensor) -> Tensor:
    """(B,) steps in which motions (B, n) can be brought to nothing."""
    return (motion.abs() / gain).amax(1).ceil().clamp_min(1.0)


def _can_stop(follower: Follower, gain: Tensor, q: Tensor, motion: Tensor) -> Tensor:
    """Whether arms (B,) that make motions (B, n) can stop after them within limits and free of self-collision."""
    robot = follower.robot
    way = motion * (0.5 * (_braking_steps(motion, gain) + 1.0))[:, None]
    count = SUBSTEPS * _STEPS_CHECKED
    fractions = torch.arange(count + 1, dtype=q.dtype, device=q.device)[:, None, None] / count
    apart = clearance(follower, q + fractions * way)
    free = (apart >= apart[0].clamp_max(0.0) - 1e-9).all(0)
    # a joint that is beyond a limit goes no farther out
    end, slack = q + way, LIMITS_SLACK
    lower, upper = torch.minimum(q, robot.lower) - slack, torch.maximum(q, robot.upper) + slack
    return free & ((end >= lower) & (end <= upper)).all(1)
