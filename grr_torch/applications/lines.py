"""Following straight task-space lines, for many arms at once and one control step at a time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from grr_torch.applications.motions import SLACK, Motions
from grr_torch.pieces import Array, Mask, norms, some
from grr_torch.projection.continuity import continuous_columns, usual_bounds

# a line of more pieces is not followed at once
_MOST_PIECES = 24
# and nor is a swing of more, which is a detour then, of which not all is looked at in every step
_MOST_OF_SWING = 48
# how far outside of bounds a swing between two points within may lead [m]
_BULGE = 0.02
# a gap between points on a line of so many ε is one to another posture, whatever joins them
_WIDEST = 2.0
# lines no longer than this may have such gaps [rad]: it takes time to look into them
_BRIDGED = 1.5
# and it is looked into by so many bisections: what spans ε or more even in an eighth of the gap is a jump
_BISECTIONS = 3


@dataclass(frozen=True, eq=False)
class Lines:
    """Straight lines from where arms stand.

    Attributes:
        ends: (B, n) configurations at the lines' ends, NaN where not converged.
        steps: (B, n) where one control step leads; the end itself where it is near enough.
        points: (B, width) where the tools are after the steps; NaN where these are shorter than they were to be.
        converged: (B,) ends that meet their points.
        collides: (B,) of these, ends in self-collision.
        safe: (B,) steps that converge and are free of self-collision on the way.
        direct: (B,) lines that can be followed: every point on the way converges and is free of self-collision, and
            neighbouring ones are less than ε apart or pass the continuity check.
    """

    ends: Array
    steps: Array
    points: Array
    converged: Mask
    collides: Mask
    safe: Mask
    direct: Mask


class _Aim(NamedTuple):
    """Lines, and the points on them that are looked at.

    Attributes:
        q: (B, n) where the arms stand.
        near: (B,) lines that end within a step.
        length: (B,) joint-space lengths [rad].
        short: (B,) lines all of which is looked at.
        fractions: (B, K + 1) where on a line these points are: on the way, after the step, and at the end.
        looked: (B, K + 1) which of them there are: a short line has few on the way, a longer one none. Where a line
            ends within a step, its end is the step.
    """

    q: Array
    near: Mask
    length: Array
    short: Mask
    fractions: Array
    looked: Mask


class Follower(Motions):
    """How arms follow straight lines of the task space, and swing. Works on arrays, as `Motions` does."""

    def follow(
        self,
        q: Array,
        p: Array,
        guesses: Array,
        targets: Array,
        offsets: Array | None = None,
        pace: Array | float = 1.0,
        swinging: Mask | None = None,
        bounds: tuple[Array, Array] | None = None,
    ) -> Lines:
        """Follows lines, all their points at once.

        It asks what the recursion of IsContinuous asks where it ends: points on the line whose configurations are
        less than ε apart. All of them, the step and the end are one projection, so that a step takes as long as one;
        only where that leaves a gap does the recursion go on.

        Args:
            q: (B, n) configurations.
            p: (B, width) the points where their tools are.
            guesses: (B, n) guesses for the lines' ends.
            targets: (B, width) the ends.
            offsets: (B, n) what the ends are expected to differ from their guesses by, as they did in the last step:
                lines lead there, so that steps are not short where guesses are far off. By default nothing.
            pace: (B,) the most of a line that one step covers, above 0; from 1 on, the default, all of it.
            swinging: (B,) those on which the joints go straight instead, as in `swing`; by default none.
            bounds: (d,) each: where the tools of these stay, give or take 2 cm, or do not go any farther
                than where they are [m].
        """
        motion = self.difference(q, guesses if offsets is None else guesses + offsets)
        share = np.minimum(self.share(motion), pace)
        if ((share >= SLACK) & (2.0 * norms(motion) <= self.epsilon)).all():
            return self._arrive(q, p, guesses, targets)
        swinging = np.zeros(len(q), dtype=bool) if swinging is None else swinging
        aim = self._aim(q, motion, share, np.where(swinging, _MOST_OF_SWING, _MOST_PIECES))
        rows = aim.looked.nonzero()[0]
        fraction = aim.fractions[aim.looked][:, None]
        on_way = self.task.interpolate_few(p[rows], targets[rows], fraction)
        starts = q[rows] + fraction * motion[rows]
        if offsets is not None:
            last = np.zeros_like(aim.looked)
            last[:, -1] = True
            starts[last[aim.looked]] = guesses
        after = np.where(aim.near[:, None], targets, self.task.interpolate_few(p, targets, aim.fractions[:, -2, None]))
        inside = np.ones(len(rows), dtype=bool)
        if some(swinging):
            # no gap of ε or more is looked into
            aim = aim._replace(length=np.where(swinging, np.inf, aim.length))
            swung = swinging[rows]
            on_way[swung] = self._tools(starts[swung])
            after[swinging] = self._after(aim, on_way)[swinging]
            if bounds is not None:
                here = p[rows[swung], : self.task.dimension]
                low, high = np.minimum(here, bounds[0]) - _BULGE, np.maximum(here, bounds[1]) + _BULGE
                inside[swung] = self._inside(on_way[swung], (low, high))
        found, reached = self._projected(aim, on_way.T, starts.T)
        reached[aim.looked] &= inside
        return self._judge(aim, found, reached, after, p, targets)

    def swing(self, q: Array, p: Array, goals: Array, bounds: tuple[Array, Array], *, wholly: bool) -> Lines:
        """Swings: motions on which the joints go straight, and the tool where that leads it, turned as the task asks.

        Args:
            q: (B, n) configurations.
            p: (B, width) the points where their tools are.
            goals: (B, n) where they go, at points of the task.
            bounds: (d,) each: tools do not go below the one, nor above the other [m].
            wholly: Whether all of the swings is looked at, or only the step, and none is `direct`.
        """
        motion = self.difference(q, goals)
        aim = self._aim(q, motion, self.share(motion), np.full(len(q), math.inf if wholly else 0.0))
        # no gap of ε or more is looked into
        aim = aim._replace(length=np.full(len(q), np.inf))
        guesses = (q[:, None] + aim.fractions[..., None] * motion[:, None])[aim.looked]
        points = self._tools(guesses)
        found, reached = self._projected(aim, points.T, guesses.T)
        slack = self.tolerances.position
        reached[aim.looked] &= self._inside(points, (bounds[0] - slack, bounds[1] + slack))
        return self._judge(aim, found, reached, self._after(aim, points), p, p)

    def _tools(self, q: Array) -> Array:
        """Points (M, width) where the tools are at configurations (M, n), turned as the task asks."""
        pose = self.robot.few.tool_pose(np.ascontiguousarray(q.T))
        return self.task.at(*(torch.from_numpy(part) for part in pose)).numpy().T

    def _inside(self, points: Array, bounds: tuple[Array, Array]) -> Mask:
        """Which points (M, width) lie within bounds, (d,) or (M, d) each: (M,)."""
        positions = points[:, : self.task.dimension]
        return np.asarray(((positions >= bounds[0]) & (positions <= bounds[1])).all(1))

    def _after(self, aim: _Aim, points: Array) -> Array:
        """Of points (M, width) that are looked at, those where the tools are after the steps (B, width)."""
        every = np.full((*aim.looked.shape, self.task.width), np.nan, points.dtype)
        every[aim.looked] = points
        return np.where(aim.near[:, None], every[:, -1], every[:, -2])

    def _arrive(self, q: Array, p: Array, guesses: Array, targets: Array) -> Lines:
        """`follow` for lines so short that they end within a step, and nothing on the way is looked at."""
        solved, reached = self.solved(targets.T, guesses.T)
        ends = solved.T
        (steps, uncut), gaps = self.limited(q, ends), self.distance(q, ends)
        hits, struck = self.hits(ends[:, None], reached[:, None], q, steps, reached, uncut)
        safe, hit = reached & ~struck, hits[:, 0]
        direct = safe & ~hit & (gaps < _WIDEST * self.epsilon)
        wide = direct & (gaps >= self.epsilon)
        if some(wide):
            direct &= self._bridged(np.stack([q, ends], axis=1), np.stack([p, targets], axis=1), wide[:, None])
        after = np.where(uncut[:, None], targets, np.nan)
        return Lines(ends, steps, after, reached, hit | ~reached, safe, direct)

    def _projected(self, aim: _Aim, points: Array, guesses: Array) -> tuple[Array, Mask]:
        """Configurations (B, K + 1, n) at the points (width, M) looked at, and which meet these (B, K + 1).

        What is not looked at on the way does no harm: it stands where the line ends.
        """
        solved, valid = self.solved(points, guesses)
        found = np.empty((*aim.looked.shape, self.robot.n), guesses.dtype)
        reached = np.empty(aim.looked.shape, dtype=bool)
        found[aim.looked], reached[aim.looked] = solved.T, valid
        found = np.where(aim.looked[..., None], found, found[:, -1:])
        return found, np.where(aim.looked, reached, reached[:, -1:])

    def _aim(self, q: Array, motion: Array, share: Array, most: Array) -> _Aim:
        """Which points on lines with motions (B, n) are looked at: no farther than half of ε apart.

        A step covers `share` (B,) of them. Of a line of more than `most` (B,) pieces, none on the way is looked at.
        """
        near, length = share >= SLACK, norms(motion)
        pieces = np.maximum(np.ceil(2.0 * length / self.epsilon), 1.0)
        short = pieces <= most
        count = int(pieces[short].max()) if short.any() else 2
        on_way = np.arange(1, count + 1)
        looked = np.empty((len(q), count + 1), dtype=bool)
        looked[:, :-2] = short[:, None] & (on_way[:-1] < pieces[:, None])
        looked[:, -2], looked[:, -1] = ~near, True
        fractions = np.empty((len(q), count + 1), q.dtype)
        fractions[:, :-1] = on_way / pieces[:, None]
        fractions[:, -2] = np.minimum(share, 1.0)
        fractions[:, -1] = 1.0
        return _Aim(q, near, length, short, fractions, looked)

    def _judge(self, aim: _Aim, found: Array, reached: Mask, after: Array, p: Array, targets: Array) -> Lines:
        """Which of the lines can be followed, by configurations (B, K + 1, n) that were reached (B, K + 1) on them."""
        q, near = aim.q, aim.near
        ends = found[:, -1]
        steps, uncut = self.limited(q, np.where(near[:, None], ends, found[:, -2]))
        after = np.where(uncut[:, None], after, np.nan)
        chain = np.concatenate([q[:, None], found[:, :-2], ends[:, None]], axis=1)
        gaps = norms(self.difference(chain[:, :-1], chain[:, 1:]))
        wide = ~(gaps < self.epsilon)
        stepped = np.where(near, reached[:, -1], reached[:, -2])
        whole = aim.short & stepped & reached[:, :-2].all(1) & reached[:, -1]
        whole &= (gaps < np.where(aim.length <= _BRIDGED, _WIDEST, 1.0)[:, None] * self.epsilon).all(1)
        asked = np.concatenate([whole[:, None] & aim.looked[:, :-2], reached[:, -1:]], axis=1)
        hit, struck = self.hits(chain[:, 1:], asked, q, steps, stepped, near & uncut)
        safe = stepped & ~struck
        direct = whole & safe & ~hit.any(1)
        bridged = direct[:, None] & wide
        if some(bridged):
            stops = np.concatenate([np.zeros_like(q[:, :1]), aim.fractions[:, :-2], np.ones_like(q[:, :1])], axis=1)
            along = self.task.interpolate_few(p[:, None], targets[:, None], np.minimum(stops, 1.0)[..., None])
            direct &= self._bridged(chain, along, bridged)
        return Lines(ends, steps, after, reached[:, -1], hit[:, -1] | ~reached[:, -1], safe, direct)

    def _bridged(self, chain: Array, points: Array, wide: Mask) -> Mask:
        """Lines (B,) that are continuous where neighbouring points (B, K + 1, …) of them are far apart (B, K)."""
        rows, columns = wide.nonzero()

        def ends(part: Array) -> tuple[Tensor, Tensor]:
            first, second = (np.ascontiguousarray(part[rows, columns + end].T) for end in (0, 1))
            return torch.from_numpy(first), torch.from_numpy(second)

        pairs, bounds = (ends(points), ends(chain)), usual_bounds(self.robot)
        joined = continuous_columns(self.robot, self.task, *pairs, *bounds, self.tolerances, _BISECTIONS)
        result = np.ones(len(chain), dtype=bool)
        result[rows[~joined.numpy()]] = False
        return result
