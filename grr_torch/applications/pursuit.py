"""Where arms that have fallen behind meet their targets: interception, as long as these go on as they do."""

from __future__ import annotations

import math

import numpy as np
import torch

from grr_torch.applications.arms import Arms, Meeting
from grr_torch.applications.hold import solve_few
from grr_torch.applications.lines import Follower
from grr_torch.applications.solve import LAST_VALID, Solver
from grr_torch.pieces import Array, Mask, norms, some

# control steps that are looked ahead at most
_FARTHEST = 1_000_000
# of the longest edge: what is so near a resolved vertex counts as open. Projections would tell, but take three times as
# long as a look does without them
_OPEN = 0.5
# points at which a target's way is looked at for so many seconds ahead; farther on, each is so many times as far
_LOOKED, _NEAR, _FARTHER = 25, 2.0, 1.15
# an arm looks after so many seconds again, but not in the next step
_EVERY = 0.16
# a target's motion is its mean over the last so many seconds, and none if it has not moved for longer than that
_MEAN, _STALE = 0.1, 0.15
# one that is faster than this [m/s] has leapt, and one that is slower rests
_LEAP, _REST = 5.0, 0.05
# a motion whose cosine with the mean is less has turned
_STRAIGHT = 0.8
# an arm so near [m] to where it meets its target is there
_THERE = 0.01
# a place on the other side of a hole is kept as long as it is no farther than this [m] from where its target goes, and
# that has not come past it for so long [s]
_ASIDE, _TOO_LATE = 0.05, 0.6
# what has gone straight so long is taken to go on for so many times as long
_AS_LONG = 1.5
# what is not so far [s] is come to along the edge of reach
_FAR = 0.4
# so many points from where a target seems to come out of a hole on are solved, in at most so many iterations: it can be
# followed from the first of two successive ones on that the map solves. That leaves out one in thirty that it solves,
# most beside the hole
_SOLVED, _LOOK_ITERATIONS = 14, 3
# an arm one of whose joints has to make about half a turn [rad], as for a target that goes through the base axis, meets
# it so much later [s]: the way round is shorter there
_HALF_TURN, _LATER = 2.95, 0.28
# an arm that is behind goes along its target's way, so far [s] at a time: straight to the target, it would leave out
# all that is between
_CHORD = 0.24
# steps in which an arm that is next to its target can be there
_NEXT_TO = 2.0
# an arm that is next to its target for so long [s] has caught up: at once, it would fall behind again beside the hole
_CAUGHT_UP = 1.0


class Pursuit:
    """Aims for arms whose targets they cannot follow.

    A target is taken to go on straight, as fast as it has been, for half as long again as it has done so. An arm whose
    target has gone into a hole of the map waits as near as it can, and sets off for where the target can be followed
    again when it has to, to be there in time, or if it can be in time only farther on. From there it goes along the
    target's way, as fast as it can, until it has caught up.
    """

    def __init__(self, follower: Follower, solver: Solver, rate: float, foresight: float) -> None:
        """For `rate` control steps a second, and targets that are taken to go on so for `foresight` seconds at most."""
        self.follower, self.solver, self.rate = follower, solver, rate
        horizon = math.ceil(min(foresight * rate, _FARTHEST))
        near = min(horizon, math.ceil(_NEAR * rate))
        looked = np.linspace(0, near, 1 + min(near, _LOOKED)).round()
        more = math.ceil(math.log(max(horizon / max(near, 1), 1.0), _FARTHER))
        farther = near * _FARTHER ** np.arange(1, 1 + more)
        self._ahead = np.unique(np.concatenate([looked, farther.round().clip(max=horizon)]))
        self._every = max(2, round(_EVERY * rate))
        self._turning = np.zeros(follower.robot.n, dtype=bool)
        self._turning[[joint.dof for joint in follower.robot.tree.joints if joint.revolute]] = True

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
        goes_on = self._goes_on(arms, which, targets)
        soon = due & ~(meeting.across[which] & ~goes_on)
        meeting.looks_in[which] = np.where(soon, meeting.looks_in[which] - 1, 0)
        meeting.across[which] = goes_on
        # not in the steps in which points to hold at are searched for
        rows = (due & ~goes_on & (meeting.looks_in[which] <= 0)).nonzero()[0] if arms.turn else ()
        if len(rows):
            meeting.looks_in[which[rows]] = self._every
            self._look(arms, which[rows], targets[rows], behind[rows])
        planned = meeting.planned(which)
        # who is next to its target keeps the same little way ahead of it
        ahead = (planned & (meeting.caught_up[which] > 0)).nonzero()[0]
        little = self._on_way(targets[ahead], meeting.velocity[which[ahead]], np.array([_NEXT_TO]))
        meeting.place[which[ahead]] = little[:, 0]
        return np.where(planned[:, None], meeting.place[which], targets)

    def _on_way(self, targets: Array, velocity: Array, steps: Array) -> Array:
        """Points (A, K, width) where targets (A, width) are after steps (K,), or (A, K), with a velocity (A, d)."""
        points = targets[:, None].repeat(steps.shape[-1], 1)
        points[..., : velocity.shape[1]] += steps.astype(targets.dtype)[..., None] * velocity[:, None]
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
        meeting.across[which] &= meeting.going[which] > 0
        meeting.given[which] = targets
        meeting.unchanged[which[~rests]] = 0

    def _goes_on(self, arms: Arms, which: Array, targets: Array) -> Mask:
        """Which arms (A,) go on to the other side of a hole, or wait there for targets (A, width).

        There, they will be turned as these are now.
        """
        meeting, place = arms.meeting, arms.meeting.place[which]
        across = meeting.across[which]
        if not some(across):
            return across
        gap, velocity = self.follower.task.gap_of_few, meeting.velocity[which]
        ahead = self._steps_ahead(place, targets, velocity)
        on_way = self._on_way(targets, velocity, ahead[:, None])[:, 0]
        aside = norms((place - on_way)[:, : velocity.shape[1]])
        late = (ahead <= 0.0) & ((gap(arms.p[which], place) <= _THERE) | (ahead < -_TOO_LATE * self.rate))
        # comparison with NaN, where there is no place, is false
        goes_on = across & (aside < _ASIDE) & ~late
        meeting.place[which[goes_on], velocity.shape[1] :] = targets[goes_on, velocity.shape[1] :]
        return goes_on

    def _steps_ahead(self, points: Array, targets: Array, velocity: Array) -> Array:
        """Of how many steps of targets (A, width) points (A, width) are ahead (A,), along velocities (A, d)."""
        gap = (points - targets)[:, : velocity.shape[1]]
        return (gap * velocity).sum(1) / np.maximum((velocity * velocity).sum(1), np.finfo(velocity.dtype).tiny)

    def _look(self, arms: Arms, which: Array, targets: Array, behind: Mask) -> None:
        """Looks for where arms (A,) meet targets (A, width); those that are not `behind` (A,) may wait."""
        meeting, steps, rows = arms.meeting, self._ahead, np.arange(len(which))
        velocity = meeting.velocity[which]
        points = self._on_way(targets, velocity, steps)
        open_, needs = self._needs(arms.q[which], points)
        known = steps <= _AS_LONG * meeting.going[which, None]
        in_time, near = (needs <= steps) & known, behind & (needs[:, 0] <= _NEXT_TO)
        first = in_time.argmax(1)
        goals, needed = steps[first], needs[rows, first]
        # on the other side of a hole that is ahead of the target, or that it is in
        shut = ~open_
        shut[:, 0] |= ~behind
        beyond = open_ & known & np.logical_or.accumulate(shut, axis=1) & (needs >= _FAR * self.rate)
        out = beyond.argmax(1)
        # it must be possible to meet somewhere there, if not where the target comes out
        across = (in_time & beyond).any(1) & ~near
        across &= (behind & ~open_[:, 0]) | (needs[rows, out] + self._every >= steps[out])
        far = across.nonzero()[0]
        if len(far):
            meet_at, found, needed_there = self._beyond(arms.q[which[far]], points[far], known[far], out[far])
            across[far] = found & (behind[far] | (needed_there >= meet_at))
            goals[far] = np.where(across[far], meet_at, goals[far])
        meeting.caught_up[which] = np.where(near, meeting.caught_up[which] + self._every, 0)
        meets = (across | in_time.any(1) & behind) & (goals > 0.0)
        meets &= meeting.caught_up[which] < _CAUGHT_UP * self.rate
        # who is at its target does not leave it for a hole ahead; guesses beside one are rough
        at_target = behind & self.follower.same_goal(arms.p[which], targets)
        meets &= ~(at_target & (across | (needed >= _FAR * self.rate)))
        meeting.across[which] = across & meets
        # along the way, from where the arm is
        mine = np.maximum(self._steps_ahead(arms.p[which], targets, velocity), -1.0 * meeting.going[which])
        some_way = mine + _CHORD * self.rate * (goals - mine) / np.maximum(needed, 1.0)
        follows = ~across & ~near & (mine < 0.0) & (some_way < goals)
        place = self._on_way(targets, velocity, np.where(follows, some_way, goals)[:, None])[:, 0]
        meeting.place[which] = np.where(meets[:, None], place, np.nan)

    def _beyond(self, q: Array, points: Array, known: Mask, out: Array) -> tuple[Array, Mask, Array]:
        """Where arms at configurations (R, n) are to meet targets that come out of holes.

        Args:
            q: (R, n).
            points: (R, K, width) where the targets will be,
            known: (R, K) and up to where they are taken to go on so.
            out: (R,) the first of these that are likely on the other side.

        Returns:
            After how many steps (R,), whether there is such a place (R,), and the steps there (R,).
        """
        rows, steps = np.arange(len(q)), self._ahead
        index = np.clip(out[:, None] + np.arange(-1, _SOLVED - 1), 0, len(steps) - 1)
        looked, times = points[rows[:, None], index], steps[index]
        solved, solvable, _ = solve_few(
            self.follower, self.solver, looked.reshape(-1, points.shape[2]), _LOOK_ITERATIONS
        )
        ways, valid = solved.reshape(*index.shape, -1), solvable.reshape(index.shape)
        valid &= known[rows[:, None], index]
        followed = valid[:, :-1] & valid[:, 1:] & (np.diff(times, axis=1) > 0.0)
        exits, motion = followed.argmax(1), np.nan_to_num(self.follower.difference(q[:, None], ways))
        half = np.abs(motion[rows, exits][:, self._turning]).max(1, initial=0.0) >= _HALF_TURN
        after = times[rows, exits] + np.where(half, _LATER * self.rate, 0.0)
        # between two points that the map has configurations for, if there are such
        last = np.minimum((times < after[:, None]).sum(1), times.shape[1] - 1)
        fits = valid[rows, last] & valid[rows, np.maximum(last - 1, 0)] & (times[rows, last] >= after)
        chosen = np.where(fits, last, exits)
        needs = self.follower.duration(motion[rows, chosen])
        return np.where(fits, after, times[rows, exits]), np.asarray(followed.any(1)), needs

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
