"""Joint motions of a few arms: how long they take, where they end, and whether they are free of self-collision."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from grr_torch.pieces import Array, Mask, norms, some
from grr_torch.projection.continuity import usual_bounds
from grr_torch.projection.few import project_few
from grr_torch.projection.project import Tolerances, project_columns
from grr_torch.robots.robot import Robot
from grr_torch.spaces.task import TaskSpace

# configurations between two steps at which self-collision is checked, the second step's own included
SUBSTEPS = 8
# up to so many projections at once numpy is faster than pieces that stay in the cache
_FEW = 800
# of fewer arms it takes less time to look at all their ways than to find out which ones to look at
_MANY = 8
# points no farther apart than this [m] are the same goal
_SAME_GOAL = 0.03
# of the longest step, so that what the projection adds seldom has to be cut off
SLACK = 0.98
# of the precision of numbers, what a step is cut by so that rounding does not lengthen it
_ROUNDING = 16.0
# what the length of a motion counts beside the steps that its slowest joint takes
_TIE = 0.01


@dataclass(frozen=True, eq=False)
class Motions:
    """Motions of arms in steps of limited length.

    Works on arrays: of so few numbers a call of numpy takes a third of the time of torch's.

    Attributes:
        robot: The robot.
        task: The task space.
        tolerances: When a configuration counts as being at a point.
        longest: (n,) the most that a joint moves in a control step [rad or m].
    """

    robot: Robot
    task: TaskSpace
    tolerances: Tolerances
    longest: Tensor

    @property
    def epsilon(self) -> float:
        """ε of the continuity check [rad]."""
        return usual_bounds(self.robot)[1]

    def same_goal(self, first: Array, second: Array) -> Mask:
        """(B,) points (B, width) that are next to others: whoever is on the way to the one is to the other too."""
        return self.task.gap_of_few(first, second) <= _SAME_GOAL

    def share(self, motion: Array) -> Array:
        """(B,) how much of motions (B, n) a step covers, a little less than it could; above 1 of short ones."""
        return SLACK * (self._longest / np.maximum(np.abs(motion), 1e-12)).min(1)

    def duration(self, motion: Array) -> Array:
        """(…,) how many control steps motions (…, n) take; of equal ones, one of less motion in all is less."""
        return (np.abs(motion) / self._longest).max(-1) + _TIE * norms(motion / self._longest)

    def solved(self, points: Array, guesses: Array, iterations: int | None = None) -> tuple[Array, Mask]:
        """`project_columns` for arrays, self-collision left open; in fewer `iterations` than usual, if given."""
        tolerances = self.tolerances if iterations is None else replace(self.tolerances, iterations=iterations)
        if guesses.shape[1] <= _FEW:
            return project_few(self.robot, self.task, tolerances, points, guesses)
        columns = torch.from_numpy(points), torch.from_numpy(guesses)
        solved, valid = project_columns(self.robot, self.task, *columns, tolerances, check_collision=False)
        return solved.numpy(), valid.numpy()

    def limited(self, q: Array, towards: Array) -> tuple[Array, Mask]:
        """Configurations (B, n) towards others by at most a step, not wrapped, and which of them are there (B,)."""
        motion = self.difference(q, towards)
        least = max(1e-12, _ROUNDING * float(np.finfo(q.dtype).eps))
        share = ((1.0 - least) * self._longest / np.maximum(np.abs(motion), 1e-12)).min(1)
        return q + np.minimum(share, 1.0)[:, None] * motion, share >= 1.0

    def difference(self, start: Array, end: Array) -> Array:
        """`configuration.difference` of arrays."""
        motion = end - start
        per_turn, turn = self._turns
        return motion - turn * np.rint(motion * per_turn)

    def hits(self, alone: Array, asked: Mask, q: Array, ends: Array, on_way: Mask, there: Mask) -> tuple[Mask, Mask]:
        """Self-collisions of configurations, and of arms on the way from `q` (B, n) to `ends` (B, n).

        Args:
            alone: (B, K, n) configurations.
            asked: (B, K) which of them are asked for; the others count as free.
            q: (B, n) where arms are.
            ends: (B, n) where they go.
            on_way: (B,) whose ways are asked for; the others count as struck.
            there: (B,) whose ways end at the last of the configurations, which is looked at once.

        Returns:
            (B, K) configurations in self-collision, and (B,) ways that touch any.
        """
        hit, struck = np.zeros(asked.shape, dtype=bool), ~on_way
        looked, there = self._doubtful(q, ends, on_way), there & on_way & asked[:, -1]
        asked = np.concatenate([asked[:, :-1], (asked[:, -1] & ~there)[:, None]], axis=1)
        between = q[looked, None] + self._substeps * (ends - q)[looked, None]
        every = np.concatenate([alone[asked], between.reshape(-1, q.shape[1])])
        collides = self.robot.few.in_self_collision(np.ascontiguousarray(every.T))
        if some(collides):
            count = len(every) - between.shape[0] * SUBSTEPS
            hit[asked] = collides[:count]
            ways = collides[count:].reshape(-1, SUBSTEPS)
            struck[looked] = ways.any(1)
            hit[looked, -1] |= there[looked] & ways[:, -1]
        return hit, struck

    def _doubtful(self, q: Array, ends: Array, on_way: Mask) -> Array:
        """Of arms on the way from `q` (B, n) to `ends` (B, n), those (D,) whose ways have to be looked at."""
        ways = on_way.nonzero()[0]
        if len(ways) < _MANY:
            return ways
        half = 0.5 * (ends - q)[ways].T
        return ways[self.robot.few.may_collide_near(q[ways].T + half, half)]

    def distance(self, start: Array, end: Array) -> Array:
        """D_q (…,) of arrays."""
        return norms(self.difference(start, end))

    @cached_property
    def _longest(self) -> Array:
        return self.longest.numpy()

    @cached_property
    def _substeps(self) -> Array:
        """(SUBSTEPS, 1) of a step, where self-collision is checked."""
        return (np.arange(1, SUBSTEPS + 1)[:, None] / SUBSTEPS).astype(self._longest.dtype)

    @cached_property
    def _turns(self) -> tuple[Array, Array]:
        """1 / 2π and 2π of continuous joints, (n,) each; 0 of others, whose differences stay as they are."""
        continuous = self.robot.continuous.numpy().astype(self._longest.dtype)
        return continuous / (2.0 * math.pi), continuous * (2.0 * math.pi)
