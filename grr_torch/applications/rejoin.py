"""Ways back for an arm that is off its map: straight joint-space motions, and out of a contact never deeper."""

from __future__ import annotations

import torch
from torch import Tensor

from grr_torch.applications.lines import Follower
from grr_torch.applications.motions import SUBSTEPS
from grr_torch.spaces.configuration import difference

# configurations on a way at which self-collision is checked; those that are not free at the first few of these are not
# looked at any more
_CHECKED = 48
_COARSE = 6
# an arm so near [rad or m] to one of the configurations is there
_ARRIVED = 1e-6
# directions out of a contact, how many of the best of them are looked at closely, and the longest motion [rad or m]
_DIRECTIONS, _TRIED, _LONGEST = 256, 16, 0.1
# of a step, what is tried where all of it would go deeper, in one step after the other
SHARES = (1.0, 0.5, 0.2, 0.05)


def rejoin(follower: Follower, q: Tensor, ends: Tensor, tries: int = 0) -> Tensor | None:
    """One control step (n,) of an arm that stands at q (n,) towards the nearest of some configurations (K, n).

    A configuration counts if the straight way to it is free of self-collision, or, from a contact, never goes
    deeper than the arm is already. If there is none, an arm in contact moves out of it where it gains most.

    Args:
        follower: How arms move.
        q: (n,) where the arm stands.
        ends: (K, n) configurations on the map.
        tries: How often no way out of the contact has been found: in other directions then, or by a shorter step.

    Returns:
        The configuration after the step; None if there is no such way.
    """
    robot = follower.robot
    motion = difference(q, ends, robot.continuous)
    lengths = motion.norm(dim=1)
    floor = clearance(follower, q[None])[0].clamp_max(0.0)
    if bool((lengths < _ARRIVED).any()) and float(floor) == 0.0:
        return None
    motion = motion[lengths.argsort()]
    free = torch.arange(len(motion), device=q.device)
    for count in (_COARSE, _CHECKED):
        fractions = torch.arange(1, count + 1, dtype=q.dtype, device=q.device)[:, None, None] / count
        free = free[_no_deeper(follower, q + fractions * motion[free], floor).all(0)]
    if len(free):
        step = torch.from_numpy(follower.limited(q[None].numpy(), (q[None] + motion[free[:1]]).numpy())[0])
        if bool(never_deeper(follower, q[None], step)[0]):
            return step[0]
    return _leave_contact(follower, q, tries) if float(floor) < 0.0 else None


def clearance(follower: Follower, q: Tensor) -> Tensor:
    """What links are apart beyond the margin (*batch,) [m]; negative in contact."""
    return follower.robot.self_collision_distance(q) - follower.robot.margin


def _no_deeper(follower: Follower, q: Tensor, floor: Tensor) -> Tensor:
    """Which configurations (*batch, n) have no less clearance than `floor`, of 0 or less: (*batch,)."""
    if float(floor) == 0.0:
        # to tell that takes a tenth of the time that distances take
        return ~follower.robot.in_self_collision(q)
    return clearance(follower, q) >= floor - 1e-9


def _leave_contact(follower: Follower, q: Tensor, tries: int) -> Tensor | None:
    """One control step (n,) that gains clearance and loses none on the way; None if no such step was found.

    The clearance is the least of many distances: where two of them are equal its gradient leads from one contact into
    the other, so of many directions the best is taken.
    """
    robot, generator = follower.robot, torch.Generator().manual_seed(tries // len(SHARES))
    drawn = torch.randn(_DIRECTIONS, len(q), dtype=q.dtype, generator=generator).to(q)
    reach = SHARES[tries % len(SHARES)] * follower.longest.clamp_max(_LONGEST).min()
    # not out of a limit, nor farther out of one
    low, high = torch.minimum(robot.lower, q), torch.maximum(robot.upper, q)
    ends = (q + reach * drawn / drawn.abs().amax(1, keepdim=True)).clamp(low, high)
    gained = clearance(follower, ends) - clearance(follower, q[None])
    best = gained.argsort(descending=True)[:_TRIED]
    fits = (never_deeper(follower, q.expand(len(best), -1), ends[best]) & (gained[best] > 0.0)).nonzero()[:, 0]
    return ends[best[fits[0]]] if len(fits) else None


def never_deeper(follower: Follower, q: Tensor, ends: Tensor) -> Tensor:
    """Whether straight joint-space motions (B, n) stay clear, or lose no clearance where there is none: (B,)."""
    fractions = torch.arange(SUBSTEPS + 1, dtype=q.dtype, device=q.device)[:, None, None] / SUBSTEPS
    along = clearance(follower, q + fractions * (ends - q))
    return (along >= along[0].clamp_max(0.0) - 1e-9).all(0)
