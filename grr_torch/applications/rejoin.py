"""Ways back for an arm that is off its map: straight joint-space motions, and out of a contact never deeper."""

from __future__ import annotations

import torch
from torch import Tensor

from grr_torch.applications.lines import Follower
from grr_torch.spaces.configuration import difference

# configurations on a way at which self-collision is checked
_CHECKED = 48
# an arm so near [rad or m] to one of the configurations is there
_ARRIVED = 1e-6
# of a step, what is tried where all of it would go deeper
_SHARES = (1.0, 0.5, 0.2, 0.05)


def rejoin(follower: Follower, q: Tensor, ends: Tensor) -> Tensor | None:
    """One control step (n,) of an arm that stands at q (n,) towards the nearest of some configurations (K, n).

    A configuration counts if the straight way to it is free of self-collision, or, from a contact, never goes
    deeper than the arm is already. If there is none, an arm in contact moves straight out of it.

    Returns:
        The configuration after the step; None if there is no such way.
    """
    robot = follower.robot
    motion = difference(q, ends, robot.continuous)
    lengths = motion.norm(dim=1)
    if bool((lengths < _ARRIVED).any()) and not bool(clearance(follower, q[None])[0] < 0.0):
        return None
    motion = motion[lengths.argsort()]
    fractions = torch.arange(1, _CHECKED + 1, dtype=q.dtype, device=q.device)[:, None, None] / _CHECKED
    floor = clearance(follower, q[None])[0].clamp_max(0.0)
    free = (clearance(follower, q + fractions * motion) >= floor - 1e-9).all(0).nonzero()[:, 0]
    if len(free):
        step = follower.limited(q[None], q[None] + motion[free[:1]])
        if bool(never_deeper(follower, q[None], step)[0]):
            return step[0]
    return leave_contact(follower, q) if float(floor) < 0.0 else None


def clearance(follower: Follower, q: Tensor) -> Tensor:
    """What links are apart beyond the margin (*batch,) [m]; negative in contact."""
    return follower.robot.self_collision_distance(q) - follower.robot.margin


def leave_contact(follower: Follower, q: Tensor) -> Tensor | None:
    """One control step (n,) along which the clearance grows fastest; None if it does not grow."""
    with torch.enable_grad():
        variable = q.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(follower.robot.self_collision_distance(variable), variable)
    if not bool(gradient.isfinite().all()) or float(gradient.abs().max()) < 1e-9:
        return None
    unit = gradient / gradient.abs().max()
    steps = q + unit.new_tensor(_SHARES)[:, None] * unit * follower.longest.clamp_max(0.1).min()
    steps = torch.minimum(
        torch.maximum(steps, torch.minimum(follower.robot.lower, q)), torch.maximum(follower.robot.upper, q)
    )
    fits = never_deeper(follower, q.expand_as(steps), steps).nonzero()[:, 0]
    return steps[fits[0]] if len(fits) else None


def never_deeper(follower: Follower, q: Tensor, ends: Tensor) -> Tensor:
    """Whether straight joint-space motions (B, n) stay clear, or lose no clearance where there is none: (B,)."""
    fractions = torch.arange(9, dtype=q.dtype, device=q.device)[:, None, None] / 8.0
    along = clearance(follower, q + fractions * (ends - q))
    return (along >= along[0].clamp_max(0.0) - 1e-9).all(0)
