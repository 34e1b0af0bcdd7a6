"""Arms that go straight: to their targets' configurations on the map, or to where they hold."""

from __future__ import annotations

import numpy as np
import torch

from grr_torch.applications.arms import Arms
from grr_torch.applications.lines import Follower, Lines
from grr_torch.applications.solve import LAST_VALID, Solver
from grr_torch.applications.steps import TRACKING, UNREACHABLE, Steps
from grr_torch.pieces import Array, Mask, norms, some

# a configuration so near the guess that led to it [rad] is on the map; less than what the solver calls off it. Where it
# is farther, the arm is near full stretch, where it goes slowly: so much joint motion brings little
_NEAR = 0.3


class Straight:
    """Leads arms straight on. Works on arrays, as `Follower` does."""

    def __init__(self, follower: Follower, solver: Solver) -> None:
        self.follower, self.solver = follower, solver

    def track(self, arms: Arms, which: Array, targets: Array) -> tuple[Steps, Mask]:
        """Steps of arms (A,) straight to their targets (A, width), and which of these can be taken (A,)."""
        guesses, codes = self.solver.guess(torch.from_numpy(targets.astype(np.float64)), certified=False)
        nobody = np.zeros(len(which), dtype=bool)
        near = guesses.numpy().astype(targets.dtype)
        lines, found, offsets = self._lines(arms, which, targets, near, nobody)
        direct: Mask = found & lines.direct & (codes.numpy() <= LAST_VALID)
        arms.offsets[which[direct]], arms.offset_at[which[direct]] = offsets[direct], targets[direct]
        return Steps(lines.steps, lines.ends, lines.points, np.full(len(which), TRACKING)), direct

    def steps(self, arms: Arms, which: Array, targets: Array, lost: Mask) -> tuple[Steps, Array, Mask, Mask]:
        """Steps straight to targets (A, width), or to where those arms hold that are `lost` (A,).

        Returns:
            The steps; configurations (A, n) where they lead; which targets (A,) the map has a configuration for; and
            which arms (A,) can go straight.
        """
        steps = Steps.none_yet(arms, which)
        ends, known = np.full_like(steps.q, np.nan), lost.copy()
        ends[lost] = arms.hold.q[which[lost]]
        rows = (~lost).nonzero()[0]
        if len(rows):
            points = torch.from_numpy(targets[rows].astype(np.float64))
            guesses, codes = (part.numpy() for part in self.solver.guess(points, certified=False))
            ends[rows], known[rows] = guesses, codes <= LAST_VALID
        valid, direct = np.zeros_like(lost), self._rests(arms, which, lost)
        steps.points[direct], steps.codes[direct] = arms.p[which[direct]], UNREACHABLE
        rows = (known & ~direct).nonzero()[0]
        if len(rows):
            chosen, holding = which[rows], lost[rows]
            goals = np.where(holding[:, None], arms.hold.point[chosen], targets[rows])
            lines, found, arms.offsets[chosen] = self._lines(arms, chosen, goals, ends[rows], holding)
            arms.offset_at[chosen], arms.hold.due[chosen] = goals, np.maximum(arms.hold.due[chosen] - 1, 1)
            free = (found | holding) & lines.direct & arms.on_task[chosen]
            direct[rows], valid[rows] = free, found & (free | ~self.follower.same_goal(goals, arms.hold.barred[chosen]))
            ends[rows[~holding]] = lines.ends[~holding]
            steps.q[rows[free]], steps.goals[rows[free]] = lines.steps[free], lines.ends[free]
            steps.points[rows[free]] = lines.points[free]
            steps.codes[rows[free]] = np.where(holding, UNREACHABLE, TRACKING)[free]
        return steps, ends, valid, direct

    def _rests(self, arms: Arms, which: Array, lost: Mask) -> Mask:
        """Which of the arms (A,) that are `lost` (A,) stand where they hold, and stay.

        Whatever the map's configuration there is now: near full stretch many are within the tolerance.
        """
        if not lost.any():
            return np.zeros_like(lost)
        there = (
            self.follower.task.gap_of_few(arms.hold.point[which], arms.p[which]) <= self.follower.tolerances.position
        )
        there &= self.follower.distance(arms.q[which], arms.hold.q[which]) <= _NEAR
        return lost & there & arms.on_task[which]

    def _lines(self, arms: Arms, which: Array, goals: Array, guesses: Array, lost: Mask) -> tuple[Lines, Mask, Array]:
        """Lines to goals (A, width), by the map's guesses (A, n) for these.

        Arms that are `lost` (A,) go to where they hold, in as many steps as are left for that.

        Returns:
            The lines, which goals the map has a configuration for (A,), and what that differs from the guess by (A, n).
        """
        same = ~lost & self.follower.same_goal(goals, arms.offset_at[which])
        offsets = np.where(same[:, None], arms.offsets[which], 0.0)
        pace = np.where(lost, 1.0 / arms.hold.due[which], 1.0)
        stretched = (norms(offsets) > _NEAR).nonzero()[0]
        if len(stretched):
            motion = self.follower.difference(arms.q[which[stretched]], guesses[stretched])
            pace[stretched] = self.follower.share(motion)
        placed = arms.q[which], arms.p[which], guesses, goals
        # along the edge of reach a straight line leads through points that it takes much self-motion to come to
        lines = self.follower.follow(*placed, offsets, pace, swinging=lost, bounds=self.solver.bounds)
        offsets = self.follower.difference(guesses, lines.ends)
        found = ~lost & lines.converged & ~lines.collides
        far = found & ~(norms(offsets) <= _NEAR)
        if some(far):
            both = (torch.from_numpy(part[far]) for part in (lines.ends, guesses))
            found[far] = self.solver.on_map(*both).numpy()
        return lines, found, np.where(found[:, None], offsets, 0.0)
