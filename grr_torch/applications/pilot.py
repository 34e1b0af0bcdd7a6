"""What arms do next: straight on, on a route over the roadmap, along the edge of reach, or back to the map."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from grr_torch.applications.arms import Arms
from grr_torch.applications.detours import Detours
from grr_torch.applications.hold import much_nearer, nearest_feasible
from grr_torch.applications.lines import Follower, Lines
from grr_torch.applications.pursuit import Pursuit
from grr_torch.applications.rejoin import rejoin
from grr_torch.applications.routes import Routes
from grr_torch.applications.solve import Solver
from grr_torch.applications.steps import DETOURING, HOLDING, TRACKING, UNREACHABLE, Steps
from grr_torch.pieces import Array, Mask, norms

# vertices that are tried as a way back to the map
_WAYS_BACK = 32
# a configuration so near the guess that led to it [rad] is on the map; less than what the solver calls off it. Where it
# is farther, the arm is near full stretch, where it goes slowly: so much joint motion brings little
_NEAR = 0.3
# steps in which an arm goes to a new point to hold at: searches that look far and closely find one in four, or two
_GRADUALLY = 4
# steps for which an arm waits before it turns round for a target that is next to it
_HESITATION = 2
# an arm so near [rad or m] to the map's configuration at its place is on the map
_ON_MAP = 0.05


class _Round(NamedTuple):
    """A step of A arms while it is decided.

    Attributes:
        arms: All arms.
        which: (A,) those that are given targets.
        targets: (A, width) these.
        steps: What they do next, set by and by.
        ends: (A, n) configurations that they are on the way to, set by and by.
    """

    arms: Arms
    which: Array
    targets: Array
    steps: Steps
    ends: Array


class Pilot:
    """Decides the next step of arms that are given targets. Works on arrays, as `Follower` does."""

    def __init__(self, follower: Follower, solver: Solver, routes: Routes, pursuit: Pursuit) -> None:
        self.follower, self.solver, self.pursuit = follower, solver, pursuit
        self.detours = Detours(follower, solver, routes)

    def steps(self, arms: Arms, which: Array, targets: Array) -> Steps:
        """The next step of some arms (A,) that are given targets (A, width).

        Steps that take long take turns with others. On a route, one that looks for a straight way comes after one that
        only follows the route; and points to hold at are searched for in every other step, of all arms at once.
        """
        asked, targets = targets, self.pursuit.aims(arms, which, targets)
        on_route = arms.detours(which) & arms.on_task[which]
        blind = on_route & (arms.blind[which] > 0)
        if blind.any():
            blind &= self.follower.same_goal(targets, arms.aimed[which])
            arms.blind[which[blind]] -= 1
        wanted = self._search(arms, which, targets, arms.holds(which) & ~blind)
        steps, ends = Steps.none_yet(arms, which), np.full_like(arms.q[which], np.nan)
        round_ = _Round(arms, which, targets, steps, ends)
        on_way = on_route & (blind | wanted)
        looks = ~on_way
        # all routes at once; whose way has come to nothing looks for another
        while looks.any() or on_way.any():
            looks = self._lead(round_, self._look(round_, looks), on_way, wanted)
            on_way = np.zeros_like(on_way)
        ahead = (arms.meeting(which) & (steps.codes != HOLDING)).nonzero()[0]
        if len(ahead):
            near = self.follower.same_goal(arms.p[which[ahead]], asked[ahead])
            steps.codes[ahead[~near]] = DETOURING
        return steps

    def _search(self, arms: Arms, which: Array, targets: Array, holding: Mask) -> Mask:
        """Looks for nearer points to hold at, and at the targets with them, of arms that are holding (A,).

        An arm waits for the turn of all, but only once, and not if its target has leapt, or a vertex on the other side
        of a hole has come nearer.

        Returns:
            (A,) the arms for which that was due in this step; some of them wait.
        """
        arms.turn = not arms.turn
        if not holding.any():
            arms.waited[which] = False
            return holding
        leapt = ~self.follower.same_goal(targets, arms.sought[which])
        wanted = holding & (leapt | ~arms.searched[which])
        search = wanted & (leapt | arms.waited[which] | arms.turn)
        waits = (wanted & ~search).nonzero()[0]
        if len(waits):
            search[waits] = much_nearer(self.follower, self.solver, arms.held[which[waits]], targets[waits])[0]
        arms.waited[which] = wanted & ~search
        if search.any():
            self._hold(arms, which[search], targets[search])
        return wanted

    def _look(self, round_: _Round, looks: Mask) -> Mask:
        """Sets the steps of arms (A,) that look where they can go.

        Returns:
            (A,) those that cannot go straight, but by a route.
        """
        routed, rows = np.zeros_like(looks), looks.nonzero()[0]
        if len(rows) == 0:
            return routed
        arms, which, targets = round_.arms, round_.which[rows], round_.targets[rows]
        lost = arms.holds(which) & ~arms.solvable[which]
        made, found, valid, direct = self._straight(arms, which, targets, lost)
        arms.searched[which] = False
        arms.forget(which[direct & ~lost])
        fresh = (~valid & ~lost).nonzero()[0]
        if len(fresh):
            self._hold(arms, which[fresh], targets[fresh])
            every = np.ones(len(fresh), dtype=bool)
            again, found[fresh], _, direct[fresh] = self._straight(arms, which[fresh], targets[fresh], every)
            made.put(fresh, again)
        arms.end_detour(which[direct])
        away = ~direct & ~self._hesitate(arms, which, targets, valid & ~direct, made)
        arms.held[which[away & valid]], arms.held_q[which[away & valid]] = np.nan, np.nan
        round_.steps.put(rows, made)
        round_.ends[rows], routed[rows] = found, away
        away &= arms.on_task[which]
        if away.any():
            chosen, goals = which[away], np.where(valid[:, None], targets, arms.held[which])[away]
            self.detours.set_goals(arms, chosen, goals)
            arms.blind[chosen], arms.aimed[chosen] = arms.doubt[chosen], targets[away]
            on_swing = self._swing(round_, rows[away], found[away], wholly=True)
            routed[rows[away][on_swing]] = False
            others = ~on_swing
            self.detours.set_last_vertices(arms, chosen[others], goals[others], found[away][others])
        return routed

    def _swing(self, round_: _Round, rows: Array, goals_q: Array, *, wholly: bool) -> Mask:
        """Sets the steps of arms, by their rows, that are free to swing to configurations (R, n): (R,)."""
        steps, free = self.detours.swing(round_.arms, round_.which[rows], goals_q, wholly=wholly)
        round_.steps.q[rows[free]] = steps[free]
        return free

    def _hesitate(self, arms: Arms, which: Array, targets: Array, turned: Mask, steps: Steps) -> Mask:
        """Which of the arms (A,) whose way has just `turned` into a detour (A,) wait instead of setting off on it.

        At the edge of a hole a target next to the tool often is one of a few steps that are on the other side of a
        self-motion, and the arm would turn round for them.
        """
        if not turned.any():
            return turned
        near = self.follower.same_goal(targets, arms.p[which]) & arms.on_task[which]
        waits = turned & near & ~arms.detours(which) & (arms.hesitated[which] < _HESITATION)
        arms.hesitated[which[waits]] += 1
        steps.points[waits], steps.codes[waits] = arms.p[which[waits]], HOLDING
        return waits

    def _straight(self, arms: Arms, which: Array, targets: Array, lost: Mask) -> tuple[Steps, Array, Mask, Mask]:
        """Steps straight to targets (A, width), or to where those arms hold that are `lost` (A,).

        Returns:
            The steps; configurations (A, n) where they lead; which targets (A,) the map has a configuration for; and
            which arms (A,) can go straight.
        """
        steps = Steps.none_yet(arms, which)
        ends, known = np.full_like(steps.q, np.nan), lost.copy()
        ends[lost] = arms.held_q[which[lost]]
        rows = (~lost).nonzero()[0]
        if len(rows):
            points = torch.from_numpy(targets[rows].astype(np.float64))
            guesses, codes = (part.numpy() for part in self.solver.guess(points, certified=False))
            ends[rows], known[rows] = guesses, codes <= 1
        valid, direct = np.zeros_like(lost), self._rests(arms, which, lost)
        steps.points[direct], steps.codes[direct] = arms.p[which[direct]], UNREACHABLE
        rows = (known & ~direct).nonzero()[0]
        if len(rows):
            chosen, holding = which[rows], lost[rows]
            goals = np.where(holding[:, None], arms.held[chosen], targets[rows])
            lines, found = self._lines(arms, chosen, goals, ends[rows], holding)
            free = (found | holding) & lines.direct & arms.on_task[chosen]
            direct[rows], valid[rows] = free, found & (free | ~self.follower.same_goal(goals, arms.barred[chosen]))
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
        there = self.follower.task.gap_of_few(arms.held[which], arms.p[which]) <= self.follower.tolerances.position
        there &= self.follower.distance(arms.q[which], arms.held_q[which]) <= _NEAR
        return lost & there & arms.on_task[which]

    def _lines(self, arms: Arms, which: Array, goals: Array, guesses: Array, lost: Mask) -> tuple[Lines, Mask]:
        """Lines to goals (A, width), and which of these the map has a configuration for (A,), by its guesses (A, n).

        Arms that are `lost` (A,) go to where they hold, in as many steps as are left for that.
        """
        same = ~lost & self.follower.same_goal(goals, arms.offset_at[which])
        offsets = np.where(same[:, None], arms.offsets[which], 0.0)
        pace = np.where(lost, 1.0 / arms.due[which], 1.0)
        arms.due[which] = np.maximum(arms.due[which] - 1, 1)
        stretched = (norms(offsets) > _NEAR).nonzero()[0]
        if len(stretched):
            motion = self.follower.difference(arms.q[which[stretched]], guesses[stretched])
            pace[stretched] = self.follower.share(motion)
        lines = self.follower.follow(arms.q[which], arms.p[which], guesses, goals, offsets, pace)
        offsets = self.follower.difference(guesses, lines.ends)
        found = ~lost & lines.converged & ~lines.collides
        far = found & ~(norms(offsets) <= _NEAR)
        if far.any():
            both = (torch.from_numpy(part[far]) for part in (lines.ends, guesses))
            found[far] = self.solver.on_map(*both).numpy()
        arms.offsets[which], arms.offset_at[which] = np.where(found[:, None], offsets, 0.0), goals
        return lines, found

    def _hold(self, arms: Arms, which: Array, targets: Array) -> None:
        """Looks for the nearest points to targets (A, width) that arms can hold at, and whether these are solvable."""
        unset = ~arms.holds(which)
        base = np.where(unset[:, None], arms.p[which], arms.held[which])
        # what is not to be gone to by any route must not be where a jump leads
        here = unset & self.follower.same_goal(targets, arms.barred[which])
        base_q = np.where(here[:, None], arms.q[which], arms.held_q[which])
        closely = arms.closely[which] & ~unset
        found = nearest_feasible(self.follower, self.solver, base, base_q, targets, closely)
        arms.due[which[norms(found[0] - arms.held[which]) != 0.0]] = _GRADUALLY
        arms.held[which], arms.held_q[which], arms.solvable[which] = found
        arms.closely[which], arms.searched[which], arms.sought[which] = ~closely, True, targets

    def _lead(self, round_: _Round, routed: Mask, on_way: Mask, briefly: Mask) -> Mask:
        """Sets the steps of arms on routes: of those that have just been `routed`, or else taken back to their map.

        Returns:
            (A,) those that were `on_way` and have no way on.
        """
        arms, which, targets, steps, ends = round_
        left = (routed & ~arms.on_task[which]) | on_way
        swinging = on_way & arms.swings(which)
        rows = swinging.nonzero()[0]
        if len(rows):
            left[rows] = ~self._swing(round_, rows, arms.swing[which[rows]], wholly=False)
        rows = (routed & arms.on_task[which] | on_way & ~swinging).nonzero()[0]
        if len(rows):
            chosen = which[rows]
            steps.q[rows], left[rows] = self.detours.follow(arms, chosen, (briefly | routed)[rows])
            found = rows[~left[rows] & routed[rows]]
            ended = self.detours.give_up_ended(arms, which[found], steps.q[found], targets[found])
            steps.codes[found[ended]] = HOLDING
        for row in (left & routed).nonzero()[0].tolist():
            step = self._back(arms, int(which[row]), ends[row])
            if step is None:
                steps.codes[row] = HOLDING
            else:
                steps.q[row] = step
        return left & on_way

    def _back(self, arms: Arms, arm: int, goal_q: Array) -> Array | None:
        """A step of an arm off its map: towards its goal, the map at its own place, or a vertex, whichever is near."""
        arms.end_detour(np.array([arm]))
        near = self.solver.nearest(torch.from_numpy(arms.p[arm][None]), _WAYS_BACK)[1][0]
        ends = self.solver.configurations[near].numpy()
        here = self.solver.solve_columns(torch.from_numpy(arms.p[arm][:, None]))[0].T.numpy()
        if not self.follower.distance(here, arms.q[arm])[0] <= _ON_MAP:
            ends = np.concatenate([goal_q[None], here, ends])
        ends = ends[np.isfinite(ends).all(1)]
        step = rejoin(self.follower, torch.from_numpy(arms.q[arm]), torch.from_numpy(ends))
        return None if step is None else step.numpy()
