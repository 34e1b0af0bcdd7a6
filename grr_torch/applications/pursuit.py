"""Where arms that have fallen behind meet their targets: interception, as long as these go on as they do."""

from __future__ import annotations

import math

import numpy as np
import torch

from grr_torch.applications.arms import Arms, Meeting
from grr_torch.applications.lines import Follower
from grr_torch.applications.solve import LAST_VALID, Solver
from grr_torch.pieces import Array, Mask, norms, some

# control steps that are looked ahead at most
_FARTHEST = 1_000_000
# of the longest edge: what is so near a resolved vertex counts as open. Projections would tell, but take three times as
# long as a look does without them
_OPEN = 0.5
# points at which a target's way ahead is looked at
_LOOKED = 25
# an arm looks in every so many-th step
_EVERY = 8
# a target's motion is its mean over the last so many seconds, and none if it has not moved for longer than that
_MEAN, _STALE = 0.1, 0.15
# one that is faster than this [m/s] has leapt, and one that is slower rests
_LEAP, _REST = 5.0, 0.05
# a motion whose cosine with the mean is less has turned
_STRAIGHT = 0.8
# a place to meet is kept until a better one is farther from it than this [m]
_MOVED = 0.05
# what has gone straight so long is taken to go on for so many times as long
_AS_LONG = 1.5
# of the way from where a target comes out of a hole to where it can be met in time: an arm heads for that, for to be
# on the target's path again sooner is worth being a little late
_LATE = 0.5
# what is not so far [s] is come to along the edge of reach
_FAR = 0.4
# steps in which an arm that is next to its target can be there
_NEXT_TO = 2.0
# an arm that is next to its target for so long [s] has caught up: at once, it would fall behind again beside the hole
_CAUGHT_UP = 1.0


class Pursuit:
    """Aims for arms whose targets they cannot follow.

    A target is taken to go on straight, as fast as it has been, for half as long again as it has done so. An arm whose
    target has gone into a hole of the map waits as near as it can, and sets off for the other side when it has to in
    order to be there in time. If it is too late for that, it heads for a point beyond the hole, somewhat before the
    first one at which it can be in time. From then on it heads for the first such point, until it has caught up.
    """

    def __init__(self, follower: Follower, solver: Solver, rate: float, foresight: float) -> None:
        """For `rate` control steps a second, and targets that are taken to go on so for `foresight` seconds at most."""
        self.follower, self.solver, self.rate = follower, solver, rate
        horizon = math.ceil(min(foresight * rate, _FARTHEST))
        self._ahead = np.unique(np.linspace(0, horizon, 1 + min(horizon, _LOOKED)).round())

    def aims(self, arms: Arms, which: Array, targets: Array) -> Array:
        """The points (A, width) that some arms (A,) head for, whose targets are (A, width)."""
        if len(self._ahead) < 2:
            return targets
        meeting = arms.meeting
        self._watch(meeting, which, targets)
        behind = meeting.planned(which)
        due = behind | arms.hold.known(which) & ~arms.hold.solvable[which]
        if not some(due):
            meeting.looks_in[which] = 0
            return targets
        moves = norms(meeting.velocity[which]) > _REST / self.rate
        meeting.place[which[~moves]] = np.nan
        due &= moves
        meeting.looks_in[which] = np.where(due, meeting.looks_in[which] - 1, 0)
        # not in the steps in which points to hold at are searched for
        rows = (due & (meeting.looks_in[which] <= 0)).nonzero()[0] if arms.turn else ()
        if len(rows):
            meeting.looks_in[which[rows]] = _EVERY
            self._look(arms, which[rows], targets[rows], behind[rows])
        planned = meeting.planned(which)
        # who is next to its target keeps the same little way ahead of it
        ahead = (planned & (meeting.caught_up[which] > 0)).nonzero()[0]
        little = self._on_way(targets[ahead], meeting.velocity[which[ahead]], np.array([_NEXT_TO]))
        meeting.place[which[ahead]] = little[:, 0]
        return np.where(planned[:, None], meeting.place[which], targets)

    def _on_way(self, targets: Array, velocity: Array, steps: Array) -> Array:
        """Points (A, K, width) where targets (A, width) are after steps (K,) with a velocity (A, d)."""
        points = targets[:, None].repeat(len(steps), 1)
        points[..., : velocity.shape[1]] += steps.astype(targets.dtype)[:, None] * velocity[:, None]
        return points

    def _watch(self, meeting: Meeting, which: Array, targets: Array) -> None:
        """How targets (A, width) move. They may be given less often than in every step."""
        d, passed = self.follower.task.dimension, meeting.unchanged[which]
        motion = (targets - meeting.given[which])[:, :d] / passed[:, None]
        length, velocity = norms(motion), meeting.velocity[which]
        stale, rests = passed > _STALE * self.rate, length == 0.0
        # comparison with NaN, where there was no target yet, is false
        goes_on = (length <= _LEAP / self.rate) & ~stale & ~rests
        straight = (motion * velocity).sum(1) > _STRAIGHT * length * norms(velocity)
        share = -np.expm1(-passed / (_MEAN * self.rate))
        mean = velocity + share[:, None] * (motion - velocity)
        if not goes_on.all():
            mean = np.where(goes_on[:, None], mean, np.where((rests & ~stale)[:, None], velocity, 0.0))
        meeting.velocity[which] = mean
        meeting.going[which] = np.where(rests | goes_on & straight, meeting.going[which] + 1, 0)
        meeting.given[which] = targets
        meeting.unchanged[which[~rests]] = 0

    def _look(self, arms: Arms, which: Array, targets: Array, behind: Mask) -> None:
        """Looks for where arms (A,) meet targets (A, width); those that are not `behind` (A,) may wait."""
        meeting = arms.meeting
        steps, points = self._ahead, self._on_way(targets, meeting.velocity[which], self._ahead)
        open_, needs = self._needs(arms.q[which], points)
        known, rows = steps <= _AS_LONG * meeting.going[which, None], np.arange(len(which))
        in_time = (needs <= steps) & known
        # on the other side of a hole that is ahead of the target, or that it is in
        shut = ~open_
        shut[:, 0] |= ~behind
        beyond = open_ & known & np.logical_or.accumulate(shut, axis=1) & (needs >= _FAR * self.rate)
        first, out, can_meet = in_time.argmax(1), beyond.argmax(1), in_time & beyond
        met = np.where(can_meet.any(1), can_meet.argmax(1), len(steps) - 1)
        near = behind & (needs[:, 0] <= _NEXT_TO)
        across = beyond.any(1) & (needs[rows, out] >= steps[out]) & ~near
        near_out = out + np.round(_LATE * (met - out)).astype(np.int64)
        first = np.where(across, np.where(open_[rows, near_out], near_out, out), first)
        meeting.caught_up[which] = np.where(near, meeting.caught_up[which] + _EVERY, 0)
        meets = in_time.any(1) & behind | can_meet.any(1) & across
        meets &= (first > 0) & (meeting.caught_up[which] < _CAUGHT_UP * self.rate)
        # who is at its target does not leave it for a hole ahead; guesses beside one are rough
        there = behind & self.follower.same_goal(arms.p[which], targets)
        meets &= ~(there & (needs[rows, first] >= _FAR * self.rate))
        place = points[rows, first]
        kept = self.follower.task.gap_of_few(place, meeting.place[which]) < _MOVED
        meeting.place[which[meets & ~kept]] = place[meets & ~kept]
        meeting.place[which[~meets]] = np.nan

    def _needs(self, q: Array, points: Array) -> tuple[Mask, Array]:
        """Which points (A, K, width) are likely open (A, K), and the steps there (A, K) from configurations (A, n)."""
        flat = torch.from_numpy(points.reshape(-1, points.shape[2]))
        guesses, codes = self.solver.guess(flat, certified=False)
        likely = codes <= LAST_VALID
        if self.follower.task.rotations is None:  # else, to look for the nearest vertex takes long
            likely &= self.solver.nearest(flat)[0][:, 0] <= _OPEN * self.solver.radius
        open_: Mask = likely.numpy().reshape(points.shape[:2])
        motion = self.follower.difference(q[:, None], guesses.numpy().reshape(*open_.shape, -1))
        return open_, np.where(open_, self.follower.duration(np.nan_to_num(motion)), np.inf)
