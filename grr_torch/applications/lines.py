"""Following straight task-space lines, for many arms at once and one control step at a time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from grr_torch.projection.continuity import continuous_columns
from grr_torch.projection.project import Tolerances, project_columns
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import difference, distance
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

    def follow(self, q: Tensor, p: Tensor, guesses: Tensor, targets: Tensor) -> Lines:
        """Follows lines, all their points at once.

        It asks what the recursion of IsContinuous asks where it ends: points on the line whose configurations are
        less than ε apart. All of them, the step and the end are one projection, so that a step takes as long as one;
        only where that leaves a gap does the recursion go on.

        Args:
            q: (B, n) configurations.
            p: (B, width) the points where their tools are.
            guesses: (B, n) guesses for the lines' ends.
            targets: (B, width) the ends.
        """
        robot = self.robot
        motion = difference(q, guesses, robot.continuous)
        share = _SLACK * (self.longest / motion.abs().clamp_min(1e-12)).amin(1)
        near = share >= _SLACK
        length = motion.norm(dim=1)
        pieces = (2.0 * length / self.epsilon).ceil().clamp_min(2.0)
        short = pieces <= _MOST_PIECES
        count = int(pieces[short].max()) if bool(short.any()) else 2
        inner = torch.arange(1, count, dtype=q.dtype, device=q.device) / count
        fractions = torch.cat(
            [inner.expand(len(q), -1), share.clamp_max(1.0)[:, None], torch.ones_like(share)[:, None]], 1
        )
        # what lies beyond the longest line is not looked at, but for the end
        rows, columns = (short[:, None] | (torch.arange(count + 1) >= count - 1)).nonzero().unbind(1)
        fraction = fractions[rows, columns][:, None]
        points = self.task.interpolate(p[rows], targets[rows], fraction)
        solved, valid = project_columns(
            robot,
            self.task,
            points.T.contiguous(),
            (q[rows] + fraction * motion[rows]).T.contiguous(),
            self.tolerances,
            check_collision=False,
        )
        found = q.new_full((len(q), count + 1, robot.n), torch.nan)
        found[rows, columns] = solved.T
        reached = torch.zeros(len(q), count + 1, dtype=torch.bool, device=q.device)
        reached[rows, columns] = valid
        ends = found[:, -1]
        steps = self.limited(q, torch.where(near[:, None], ends, found[:, -2]))
        chain = torch.cat([q[:, None], found[:, :-2], ends[:, None]], dim=1)
        gaps = distance(chain[:, :-1], chain[:, 1:], robot.continuous)
        wide = ~(gaps < self.epsilon)
        hit = self._hits(torch.cat([found[:, :-2], ends[:, None]], dim=1), q, steps)
        safe = torch.where(near, reached[:, -1], reached[:, -2]) & ~hit[:, count:].any(1)
        direct = short & safe & reached[:, : count - 1].all(1) & reached[:, -1] & ~hit[:, :count].any(1)
        direct &= (gaps < torch.where(length <= _BRIDGED, _WIDEST, 1.0)[:, None] * self.epsilon).all(1)
        if bool((direct[:, None] & wide).any()):
            stops = torch.cat([torch.zeros_like(inner[:1]), inner, torch.ones_like(inner[:1])])
            along = self.task.interpolate(p[:, None], targets[:, None], stops[:, None])
            direct &= self._bridged(chain, along, direct[:, None] & wide)
        after = torch.where(near[:, None], targets, self.task.interpolate(p, targets, share.clamp_max(1.0)[:, None]))
        return Lines(ends, steps, after, reached[:, -1], hit[:, count - 1], safe, direct)

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
        motion = difference(q, towards, self.robot.continuous)
        share = ((1.0 - 1e-12) * self.longest / motion.abs().clamp_min(1e-12)).amin(1).clamp_max(1.0)
        return q + share[:, None] * motion

    def _hits(self, alone: Tensor, q: Tensor, ends: Tensor) -> Tensor:
        """Self-collisions (B, K + S) of configurations (B, K, n) and of those between `q` and `ends` (B, n)."""
        fractions = torch.arange(1, SUBSTEPS + 1, dtype=q.dtype, device=q.device) / SUBSTEPS
        between = q[:, None] + fractions[:, None] * (ends - q)[:, None]
        all_ = torch.cat([alone, between], dim=1)
        columns = all_.reshape(-1, all_.shape[2]).T.contiguous()
        return self.robot.columns_in_self_collision(columns).reshape(all_.shape[:2])
