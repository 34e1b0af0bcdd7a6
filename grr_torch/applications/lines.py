"""Following straight task-space lines, for many arms at once and one control step at a time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from grr_torch.pieces import Array
from grr_torch.projection.continuity import continuous_columns
from grr_torch.projection.project import Tolerances, project_columns
from grr_torch.robots.robot import Robot
from grr_torch.spaces.task import TaskSpace

# configurations between two steps at which self-collision is checked, the second step's own included
SUBSTEPS = 8
# a line of more pieces is not followed at once
_MOST_PIECES = 24
# a gap between points on a line of so many ε is one to another posture, whatever joins them
_WIDEST = 2.0
# lines no longer than this may have such gaps [rad]: it takes time to look into them
_BRIDGED = 1.5
# of the longest step, so that what the projection adds seldom has to be cut off
_SLACK = 0.98


@dataclass(frozen=True, eq=False)
class Lines:
    """Straight lines from where arms stand.

    Attributes:
        ends: (B, n) configurations at the lines' ends, NaN where not converged.
        steps: (B, n) where one control step leads; the end itself where it is near enough.
        points: (B, width) where the tools are after the steps.
        converged: (B,) ends that meet their points.
        collides: (B,) of these, ends in self-collision.
        safe: (B,) steps that converge and are free of self-collision on the way.
        direct: (B,) lines that can be followed: every point on the way converges and is free of self-collision, and
            neighbouring ones are less than ε apart or pass the continuity check.
    """

    ends: Tensor
    steps: Tensor
    points: Tensor
    converged: Tensor
    collides: Tensor
    safe: Tensor
    direct: Tensor


class _Found(NamedTuple):
    """What a projection of lines gave.

    Attributes:
        q: (B, n) where the arms stand.
        near: (B,) lines that end within a step.
        length: (B,) joint-space lengths [rad].
        short: (B,) lines all of which was looked at.
        found: (B, K + 1, n) configurations on the way, after the step, and at the end; NaN where not converged.
        reached: (B, K + 1) converged.
        after: (B, width) where the tools are after the steps.
    """

    q: Array
    near: Array
    length: Array
    short: Array
    found: Array
    reached: Array
    after: Array


@dataclass(frozen=True, eq=False)
class Follower:
    """How arms follow lines.

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
        """ε of the continuity check: 0.05 √n [rad]."""
        return 0.05 * math.sqrt(self.robot.n)

    def follow(self, q: Tensor, p: Tensor, guesses: Tensor, targets: Tensor, offsets: Tensor | None = None) -> Lines:
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
        """
        standing, wanted = q.numpy(), targets.numpy()
        count = len(standing)
        aims = guesses if offsets is None else guesses + offsets
        motion = self._difference(standing, aims.numpy())
        share = _SLACK * (self._longest / np.maximum(np.abs(motion), 1e-12)).min(1)
        near = share >= _SLACK
        length = _norm(motion)
        pieces = np.maximum(np.ceil(2.0 * length / self.epsilon), 2.0)
        short = pieces <= _MOST_PIECES
        parts = int(pieces[short].max()) if short.any() else 2
        # points on the way, the step, the end
        fractions = np.ones((count, parts + 1), standing.dtype)
        fractions[:, : parts - 1] = np.arange(1, parts) / parts
        fractions[:, parts - 1] = np.minimum(share, 1.0)
        # what lies beyond the longest line is not looked at, but for the end
        looked = short[:, None] | (np.arange(parts + 1) >= parts - 1)
        rows = looked.nonzero()[0]
        fraction = fractions[looked][:, None]
        places = torch.from_numpy(p.numpy()[rows]), torch.from_numpy(wanted[rows])
        on_way = self.task.interpolate(*places, torch.from_numpy(fraction))
        starts = standing[rows] + fraction * motion[rows]
        if offsets is not None:
            starts[np.cumsum(looked.sum(1)) - 1] = guesses.numpy()
        solved, valid = project_columns(
            self.robot, self.task, on_way.T, torch.from_numpy(starts.T), self.tolerances, check_collision=False
        )
        found = np.full((count, parts + 1, self.robot.n), np.nan, standing.dtype)
        found[looked] = solved.T.numpy()
        reached = np.zeros((count, parts + 1), dtype=bool)
        reached[looked] = valid.numpy()
        after = wanted.copy()
        after[~near] = on_way.numpy()[np.cumsum(looked)[parts - 1 :: parts + 1][~near] - 1]
        return self._judge(_Found(standing, near, length, short, found, reached, after), p, targets)

    def _judge(self, made: _Found, p: Tensor, targets: Tensor) -> Lines:
        """Which of the lines that were projected can be followed."""
        q, near, length, short, found, reached, after = made
        parts = found.shape[1] - 1
        ends, way = found[:, -1], found[:, :-2]
        steps = self._limited(q, np.where(near[:, None], ends, found[:, -2]))
        chain = np.concatenate([q[:, None], way, ends[:, None]], axis=1)
        gaps = _norm(self._difference(chain[:, :-1], chain[:, 1:]))
        wide = ~(gaps < self.epsilon)
        stepped = np.where(near, reached[:, -1], reached[:, -2])
        whole = short & stepped & reached[:, : parts - 1].all(1) & reached[:, -1]
        whole &= (gaps < np.where(length <= _BRIDGED, _WIDEST, 1.0)[:, None] * self.epsilon).all(1)
        asked = np.concatenate([np.repeat(whole[:, None], parts - 1, 1), reached[:, -1:], stepped[:, None]], axis=1)
        hit = self._hits(chain[:, 1:], q, steps, asked)
        safe = stepped & ~hit[:, parts:].any(1)
        direct = whole & safe & ~hit[:, :parts].any(1)
        bridged = direct[:, None] & wide
        if bridged.any():
            stops = torch.arange(parts + 1, dtype=p.dtype) / parts
            along = self.task.interpolate(p[:, None], targets[:, None], stops[:, None])
            direct &= self._bridged(torch.from_numpy(chain), along, torch.from_numpy(bridged)).numpy()
        tensors = (ends, steps, after, reached[:, -1], hit[:, parts - 1], safe, direct)
        return Lines(*(torch.from_numpy(np.ascontiguousarray(array)) for array in tensors))

    def _bridged(self, chain: Tensor, points: Tensor, wide: Tensor) -> Tensor:
        """Lines (B,) that are continuous where neighbouring points (B, K + 1, …) of them are far apart (B, K)."""
        rows, columns = wide.nonzero().unbind(1)
        pairs = [(part[rows, columns].T, part[rows, columns + 1].T) for part in (points, chain)]
        joined = continuous_columns(
            self.robot, self.task, pairs[0], pairs[1], 0.5 * math.sqrt(self.robot.n), self.epsilon, self.tolerances
        )
        result = torch.ones(len(chain), dtype=torch.bool, device=chain.device)
        result[rows[~joined]] = False
        return result

    def limited(self, q: Tensor, towards: Tensor) -> Tensor:
        """Configurations (B, n) towards others by at most a step, continuous joints not wrapped."""
        return torch.from_numpy(self._limited(q.numpy(), towards.numpy()))

    def _limited(self, q: Array, towards: Array) -> Array:
        motion = self._difference(q, towards)
        share = ((1.0 - 1e-12) * self._longest / np.maximum(np.abs(motion), 1e-12)).min(1)
        return q + np.minimum(share, 1.0)[:, None] * motion

    def _difference(self, start: Array, end: Array) -> Array:
        """`configuration.difference` of arrays."""
        motion = end - start
        per_turn, turn = self._turns
        return motion - turn * np.round(motion * per_turn)

    def _hits(self, alone: Array, q: Array, ends: Array, asked: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Self-collisions (B, K + S) of configurations (B, K, n) and of those between `q` and `ends` (B, n).

        What is not asked for, by `asked` (B, K + 1), counts as one; its last column is for all between `q` and `ends`.
        """
        fractions = (np.arange(1, SUBSTEPS + 1)[:, None] / SUBSTEPS).astype(q.dtype)
        between = q[:, None] + fractions * (ends - q)[:, None]
        every = np.concatenate([alone, between], axis=1)
        asked = np.concatenate([asked[:, :-1], np.repeat(asked[:, -1:], SUBSTEPS, 1)], axis=1)
        hit = np.ones(every.shape[:2], dtype=bool)
        columns = torch.from_numpy(np.ascontiguousarray(every[asked].T))
        hit[asked] = self.robot.columns_in_self_collision(columns).numpy()
        return hit

    @cached_property
    def _longest(self) -> Array:
        return self.longest.numpy()

    @cached_property
    def _turns(self) -> tuple[Array, Array]:
        """1 / 2π and 2π of continuous joints, (n,) each; 0 of others, whose differences stay as they are."""
        continuous = self.robot.continuous.numpy().astype(self._longest.dtype)
        return continuous / (2.0 * math.pi), continuous * (2.0 * math.pi)


def _norm(motion: Array) -> Array:
    """Norms over the last axis; a fifth of the time that numpy.linalg's function takes."""
    return np.sqrt((motion * motion).sum(-1))
