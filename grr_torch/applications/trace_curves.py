"""Self-motion curves: null-space tracing where one joint is to spare, many curves at once, one a column.

From a configuration, a step along the null vector of the Jacobian predicts the next one, and the projection corrects it
(predictor and corrector of numerical continuation, Allgower & Georg 1990). Steps are halved where the curve turns or
the correction is long, and lengthened again where it is straight.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from grr_torch.applications.sample_manifold import in_box, search_tree
from grr_torch.progress import Progress
from grr_torch.projection.columns import null_space_projector
from grr_torch.projection.project import Tolerances, project_columns
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import difference
from grr_torch.spaces.task import TaskSpace

# largest turn of the tangent in a step, as the cosine of about 0.2 rad, and largest correction as a share of the step
_TURN, _CORRECTION = 0.98, 0.2
# a step shorter than this share of the longest is given up
_SHORTEST = 1e-3
# a joint so near its limit [rad or m] is at it
_AT_LIMIT = 1e-7
# a curve longer than this [rad or m] is given up
_LONGEST = 200.0
# corrections after which a configuration that is on the curve has been come to, and how near [share of a step]
_APPROACHES, _THERE = 4, 0.02
# curves that are traced together
_TOGETHER = 16


class End(IntEnum):
    """Why a curve goes no further."""

    CLOSED = 0  # it is back where it began
    LIMIT = 1  # a joint is at its limit
    SINGULAR = 2  # it has no single direction there
    LENGTH = 3  # it is longer than 200 rad


class Curves(NamedTuple):
    """Samples of C curves, one curve after the other, each in its order.

    Attributes:
        configurations: (n, S).
        tangents: (n, S) unit vectors along the curve.
        curve: (S,) which curve a sample is of.
        ends: (C, 2) the `End` before the first and after the last sample.
    """

    configurations: Tensor
    tangents: Tensor
    curve: Tensor
    ends: Tensor

    def take(self, curves: Tensor) -> Curves:
        """Some of the curves (K,), numbered anew."""
        number = torch.full((len(self.ends),), -1, device=curves.device)
        number[curves] = torch.arange(len(curves), device=curves.device)
        kept = (number[self.curve] >= 0).nonzero()[:, 0]
        kept = kept[number[self.curve[kept]].argsort(stable=True)]
        return Curves(self.configurations[:, kept], self.tangents[:, kept], number[self.curve[kept]], self.ends[curves])


def join(parts: list[Curves]) -> Curves:
    """The curves of all parts, in their order."""
    shifts = torch.tensor([0] + [len(part.ends) for part in parts]).cumsum(0).tolist()
    return Curves(
        torch.cat([part.configurations for part in parts], 1),
        torch.cat([part.tangents for part in parts], 1),
        torch.cat([part.curve + shift for part, shift in zip(parts, shifts, strict=False)]),
        torch.cat([part.ends for part in parts]),
    )


@dataclass(frozen=True)
class Tracer:
    """Traces curves of configurations whose tool is at one point.

    Attributes:
        robot: The robot.
        task: The task space; it leaves one joint to spare.
        target: (width, 1) the point.
        step: Longest step [rad].
        tolerances: Of the projections.
    """

    robot: Robot
    task: TaskSpace
    target: Tensor
    step: float
    tolerances: Tolerances

    def all_curves(self, starts: Tensor, progress: Progress) -> Curves:
        """Every curve that one of the starts (n, K) lies on, once."""
        found: list[Curves] = []
        count = starts.shape[1]
        while starts.shape[1]:
            progress("tracing curves", count - starts.shape[1], count)
            curves = self.both_ways(starts[:, :_TOGETHER])
            on = self.lie_on(starts, curves)
            # of starts on one curve, the first stands for it
            first = on[: len(curves.ends)].int().argmax(1)
            kept = curves.take((first == torch.arange(len(first), device=first.device)).nonzero()[:, 0])
            found.append(kept)
            starts = starts[:, (~on.any(1)).nonzero()[:, 0]]
        progress("tracing curves", count, count)
        return join(found)

    def both_ways(self, starts: Tensor) -> Curves:
        """The curves through starts (n, K), one for each, from end to end."""
        tangents = self._tangents(starts, torch.ones_like(starts).div_(torch.arange(1, len(starts) + 1)[:, None]))
        q, t, curve, order, ends = self._one_way(starts, tangents)
        open_curves = (ends != End.CLOSED).nonzero()[:, 0]
        back = self._one_way(starts[:, open_curves], -tangents[:, open_curves])
        later = back[3] > 0
        curve = torch.cat([curve, open_curves[back[2][later]]])
        order = torch.cat([order, -back[3][later]])
        rank = order.argsort(stable=True)
        rank = rank[curve[rank].argsort(stable=True)]
        both = torch.stack([ends, ends], 1)
        both[open_curves, 0] = back[4]
        return Curves(
            torch.cat([q, back[0][:, later]], 1)[:, rank],
            torch.cat([t, -back[1][:, later]], 1)[:, rank],
            curve[rank],
            both,
        )

    def lie_on(self, configurations: Tensor, curves: Curves) -> Tensor:
        """Which configurations (n, K) of the manifold lie on which curves: (K, C) bool.

        One does if steps from the curve's nearest sample come to it.
        """
        on = torch.zeros(configurations.shape[1], len(curves.ends), dtype=torch.bool, device=configurations.device)
        wraps = self.robot.continuous
        rows = in_box(configurations, wraps)
        shifts = curves.curve.bincount(minlength=len(curves.ends)).cumsum(0).tolist()
        for number, (start, end) in enumerate(zip([0, *shifts], shifts, strict=False)):
            samples, tangents = curves.configurations[:, start:end], curves.tangents[:, start:end]
            gap, nearest = search_tree(samples, wraps).query(rows, distance_upper_bound=1.5 * self.step)
            near = np.isfinite(gap)
            starts, goals = (torch.from_numpy(part).to(on.device) for part in (nearest[near], near.nonzero()[0]))
            on[goals, number] = self._leads_to(samples[:, starts], tangents[:, starts], configurations[:, goals])
        return on

    def _one_way(self, starts: Tensor, tangents: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Traces from starts (n, K) along tangents (n, K).

        Returns:
            Configurations (n, S) and tangents (n, S), the column of the start of each (S,), its number along the curve
            (S,), 0 for the start, and how the curves end (K,).
        """
        count = starts.shape[1]
        active = torch.arange(count, device=starts.device)
        q, t = starts, tangents
        step = torch.full_like(starts[0], self.step)
        length = torch.zeros_like(step)
        ends = torch.full_like(active, End.LENGTH)
        samples = [(q, t, active, torch.zeros_like(active))]
        turn = 0
        while len(active):
            turn += 1
            room = self._room(q, t)
            reach = torch.minimum(step, room)
            moved, good, turned = self._advance(q, t, reach)
            closed = self._closes(q, t, reach, starts[:, active], tangents[:, active]) & good & (length > 0.0)
            at_limit = room <= _AT_LIMIT
            singular = ~good & (reach <= _SHORTEST * self.step)
            for mask, end in ((singular, End.SINGULAR), (at_limit, End.LIMIT), (closed, End.CLOSED)):
                ends[active[mask]] = end
            on = good & ~closed & ~at_limit
            length = torch.where(on, length + reach, length)
            step = torch.where(good, (1.5 * step).clamp(max=self.step), 0.5 * reach)
            q, t = torch.where(on, moved, q), torch.where(on, turned, t)
            samples.append((q[:, on], t[:, on], active[on], torch.full_like(active[on], turn)))
            left = (~(closed | at_limit | singular) & (length <= _LONGEST)).nonzero()[:, 0]
            active, q, t, step, length = active[left], q[:, left], t[:, left], step[left], length[left]
        configurations, directions, column, order = zip(*samples, strict=True)
        return torch.cat(configurations, 1), torch.cat(directions, 1), torch.cat(column), torch.cat(order), ends

    def _advance(self, q: Tensor, t: Tensor, reach: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One step: where it leads (n, N), whether it is good (N,), and the tangents there (n, N)."""
        moved, valid = self._project(q + reach * t)
        correction = difference(q, moved, self.robot.continuous[:, None]) - reach * t
        turned = self._tangents(moved, t)
        good = valid & (correction.norm(dim=0) <= _CORRECTION * reach) & ((turned * t).sum(0) >= _TURN)
        return moved, good, turned

    def _closes(self, q: Tensor, t: Tensor, reach: Tensor, starts: Tensor, first: Tensor) -> Tensor:
        """Whether this step of each column passes the column's start (n, N), going the way it first went (N,)."""
        motion = difference(q, starts, self.robot.continuous[:, None])
        ahead = (motion * t).sum(0)
        near = (
            (ahead > 0.0) & (ahead <= 1.01 * reach) & (motion.norm(dim=0) <= 1.3 * reach) & ((t * first).sum(0) > 0.7)
        )
        closes = torch.zeros_like(near)
        columns = near.nonzero()[:, 0]
        if len(columns):
            closes[columns] = self._leads_to(q[:, columns], t[:, columns], starts[:, columns])
        return closes

    def _leads_to(self, q: Tensor, t: Tensor, goals: Tensor) -> Tensor:
        """Whether the curves through q (n, N) with tangents t pass goals (n, N), less than two steps away: (N,)."""
        wraps = self.robot.continuous[:, None]
        for _ in range(_APPROACHES):
            q, _valid = self._project(q + (t * difference(q, goals, wraps)).sum(0) * t)
            q = q.nan_to_num(torch.inf)
            t = self._tangents(q, t)
        return difference(q, goals, wraps).norm(dim=0) <= _THERE * self.step

    def _project(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """The projection of columns (n, N), in self-collision or not."""
        targets = self.target.expand(-1, q.shape[1]).contiguous()
        return project_columns(self.robot, self.task, targets, q, self.tolerances, check_collision=False)

    def _tangents(self, q: Tensor, like: Tensor) -> Tensor:
        """Unit null vectors (n, N) of the Jacobians at q (n, N), in the sense of `like` (n, N)."""
        jacobian = self.task.jacobian(self.robot.tree.jacobian(self.robot.tree.frames(q)), self.target)
        projector = null_space_projector(jacobian, 1e3 * torch.finfo(q.dtype).eps)
        tangents = (projector * like).sum(1)
        return tangents / tangents.norm(dim=0)

    def _room(self, q: Tensor, t: Tensor) -> Tensor:
        """How far (N,) columns q (n, N) can go along t (n, N) until a joint is at its limit."""
        ahead = torch.where(t > 0.0, self.robot.upper[:, None], self.robot.lower[:, None]) - q
        room = torch.where(t.abs() > 1e-12, ahead / t, torch.inf)
        return torch.where(self.robot.continuous[:, None], torch.inf, room).amin(0).clamp_min(0.0)
