"""What arms do next: straight on, on a route over the roadmap, along the edge of reach, or back to the map."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from grr_torch.applications.arms import Arms
from grr_torch.applications.detours import Detours
from grr_torch.applications.hold import LEVELS, NEARER, much_nearer, nearest_feasible
from grr_torch.applications.lines import Follower
from grr_torch.applications.pursuit import Pursuit
from grr_torch.applications.rejoin import SHARES, rejoin
from grr_torch.applications.routes import Routes
from grr_torch.applications.solve import Solver
from grr_torch.applications.steps import DETOURING, HOLDING, TRACKING, UNREACHABLE, Steps
from grr_torch.applications.straight import Straight
from grr_torch.pieces import Array, Mask, norms

# vertices that are tried as a way back to the map
_WAYS_BACK = 32
# steps in which an arm goes to a new point to hold at
_GRADUALLY = 4
# steps for which an arm waits before it turns round for a target that is next to it
_HESITATION = 2
# an arm so near [rad or m] to the map's configuration at its place is on the map
_ON_MAP = 0.05
# steps for which an arm that found no way back to the map, with steps of any length, does not look for one
_REST = 5
# what is so much nearer to the target [m] is worth a detour, however far off that is
_MUCH = 0.05


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
        self.straight = Straight(follower, solver)
        self.detours = Detours(follower, solver, routes)

    def steps(self, arms: Arms, which: Array, targets: Array) -> Steps:
        """The next step of some arms (A,) that are given targets (A, width).

        Arms that have just gone straight to their targets are likely to do so again: if all have, what others have to
        look at is left out until they cannot.
        """
        aims, steps = self.pursuit.aims(arms, which, targets), Steps.none_yet(arms, which)
        arms.turn = not arms.turn
        rows = np.arange(len(which))
        if (arms.tracks[which] & arms.on_task[which]).all():
            made, direct = self.straight.track(arms, which, aims)
            steps.put(rows, made)
            rows = (~direct).nonzero()[0]
        if len(rows):
            arms.tracks[which[rows]] = False
            steps.put(rows, self._decided(arms, which[rows], aims[rows]))
            arms.tracks[which[rows]] = steps.codes[rows] == TRACKING
        ahead = (arms.meeting.planned(which) & (steps.codes != HOLDING)).nonzero()[0]
        if len(ahead):
            near = self.follower.same_goal(arms.p[which[ahead]], targets[ahead])
            steps.codes[ahead[~near]] = DETOURING
        return steps

    def _decided(self, arms: Arms, which: Array, targets: Array) -> Steps:
        """Steps of arms (A,) to targets (A, width), whatever they are about.

        Steps that take long take turns with others. On a route, one that looks for a straight way comes after one that
        only follows the route; and points to hold at are searched for in every other step, of all arms at once.
        """
        on_route = arms.detour.under_way(which) & arms.on_task[which]
        blind = on_route & (arms.detour.blind[which] > 0)
        if blind.any():
            blind &= self.follower.same_goal(targets, arms.detour.aimed[which])
            arms.detour.blind[which[blind]] -= 1
        # what was found in the last step is acted on first, however the target leaps
        found = on_route & arms.hold.searched[which]
        wanted = self._search(arms, which, targets, arms.hold.known(which) & ~blind & ~found)
        steps, ends = Steps.none_yet(arms, which), np.full_like(arms.q[which], np.nan)
        round_ = _Round(arms, which, targets, steps, ends)
        on_way = on_route & (blind | wanted)
        looks = ~on_way
        # all routes at once; whose way has come to nothing looks for another
        while looks.any() or on_way.any():
            looks = self._lead(round_, self._look(round_, looks), on_way, wanted)
            on_way = np.zeros_like(on_way)
        return steps

    def _search(self, arms: Arms, which: Array, targets: Array, holding: Mask) -> Mask:
        """Looks for nearer points to hold at, and at the targets with them, of arms that are holding (A,).

        An arm waits for the turn of all, but only once, and not if its target has leapt, or a vertex on the other side
        of a hole has come nearer.

        Returns:
            (A,) the arms for which that was due in this step; some of them wait.
        """
        hold = arms.hold
        if not holding.any():
            hold.waited[which] = False
            return holding
        leapt = ~self.follower.same_goal(targets, hold.sought[which])
        wanted = holding & (leapt | ~hold.searched[which])
        search = wanted & (leapt | hold.waited[which] | arms.turn)
        waits = (wanted & ~search).nonzero()[0]
        if len(waits):
            search[waits] = much_nearer(self.follower, self.solver, hold.point[which[waits]], targets[waits])[0]
        hold.waited[which] = wanted & ~search
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
        lost = arms.hold.known(which) & ~arms.hold.solvable[which]
        made, found, valid, direct = self.straight.steps(arms, which, targets, lost)
        arms.hold.searched[which] = False
        arms.hold.forget(which[direct & ~lost])
        arms.detour.forget(which[direct & ~lost])
        fresh = (~valid & ~lost).nonzero()[0]
        if len(fresh):
            self._hold(arms, which[fresh], targets[fresh])
            every = np.ones(len(fresh), dtype=bool)
            again, found[fresh], _, direct[fresh] = self.straight.steps(arms, which[fresh], targets[fresh], every)
            made.put(fresh, again)
        direct |= self._stay(arms, which, targets, ~direct & ~valid, made)
        arms.detour.end(which[direct])
        away = ~direct & ~self._hesitate(arms, which, targets, valid & ~direct, made)
        arms.hold.point[which[away & valid]], arms.hold.q[which[away & valid]] = np.nan, np.nan
        round_.steps.put(rows, made)
        round_.ends[rows], routed[rows] = found, away
        away &= arms.on_task[which]
        if away.any():
            chosen, goals = which[away], np.where(valid[:, None], targets, arms.hold.point[which])[away]
            self.detours.set_goals(arms, chosen, goals)
            arms.detour.blind[chosen], arms.detour.aimed[chosen] = arms.detour.doubt[chosen], targets[away]
            on_swing = self._swing(round_, rows[away], found[away])
            routed[rows[away][on_swing]] = False
            # no way to a target is quicker, so it is not left for one that is straight, until that is elsewhere
            swings = on_swing & valid[away]
            left = self.follower.difference(round_.steps.q[rows[away][swings]], arms.detour.swing[chosen[swings]])
            arms.detour.blind[chosen[swings]] = np.ceil(self.follower.duration(left))
            others = ~on_swing
            self.detours.set_last_vertices(arms, chosen[others], goals[others], found[away][others])
        return routed

    def _stay(self, arms: Arms, which: Array, targets: Array, blocked: Mask, steps: Steps) -> Mask:
        """Which of the arms (A,) that are `blocked` (A,) on their way to where they would hold do so where they are.

        They do where it is hardly nearer to the target: a detour along the edge of reach leads away from it first.
        """
        rows = (blocked & arms.on_task[which] & ~arms.detour.under_way(which)).nonzero()[0]
        gap, chosen = self.follower.task.gap_of_few, which[rows]
        away = gap(arms.p[chosen], targets[rows])
        hardly = away - gap(arms.hold.point[chosen], targets[rows]) < np.minimum((1.0 - NEARER) * away, _MUCH)
        rows, chosen = rows[hardly], chosen[hardly]
        arms.hold.point[chosen], arms.hold.q[chosen], arms.hold.due[chosen] = arms.p[chosen], arms.q[chosen], 1
        steps.q[rows], steps.goals[rows] = arms.q[chosen], arms.q[chosen]
        steps.points[rows], steps.codes[rows] = arms.p[chosen], UNREACHABLE
        stays = np.zeros_like(blocked)
        stays[rows] = True
        return stays

    def _swing(self, round_: _Round, rows: Array, goals_q: Array) -> Mask:
        """Sets the steps of arms, by their rows, that are free to swing to configurations (R, n): (R,)."""
        steps, points, free = self.detours.swing(round_.arms, round_.which[rows], goals_q)
        rows, made = rows[free], round_.steps
        made.q[rows], made.points[rows] = steps[free], points[free]
        made.goals[rows] = round_.arms.detour.swing[round_.which[rows]]
        return free

    def _hesitate(self, arms: Arms, which: Array, targets: Array, turned: Mask, steps: Steps) -> Mask:
        """Which of the arms (A,) whose way has just `turned` into a detour (A,) wait instead of setting off on it.

        At the edge of a hole a target next to the tool often is one of a few steps that are on the other side of a
        self-motion, and the arm would turn round for them.
        """
        if not turned.any():
            return turned
        near = self.follower.same_goal(targets, arms.p[which]) & arms.on_task[which]
        waits = turned & near & ~arms.detour.under_way(which) & (arms.detour.hesitated[which] < _HESITATION)
        arms.detour.hesitated[which[waits]] += 1
        steps.points[waits], steps.codes[waits] = arms.p[which[waits]], HOLDING
        return waits

    def _hold(self, arms: Arms, which: Array, targets: Array) -> None:
        """Looks for the nearest points to targets (A, width) that arms can hold at, and whether these are solvable."""
        hold = arms.hold
        unset = ~hold.known(which)
        base = np.where(unset[:, None], arms.p[which], hold.point[which])
        # what is not to be gone to by any route must not be where a jump leads
        here = unset & self.follower.same_goal(targets, hold.barred[which])
        base_q = np.where(here[:, None], arms.q[which], hold.q[which])
        level = np.where(unset, 0, hold.level[which])
        found = nearest_feasible(self.follower, self.solver, base, base_q, targets, level)
        hold.due[which[norms(found[0] - hold.point[which]) != 0.0]] = _GRADUALLY
        hold.point[which], hold.q[which], hold.solvable[which] = found
        hold.level[which], hold.searched[which], hold.sought[which] = (level + 1) % LEVELS, True, targets

    def _lead(self, round_: _Round, routed: Mask, on_way: Mask, briefly: Mask) -> Mask:
        """Sets the steps of arms on routes: of those that have just been `routed`, or else taken back to their map.

        Returns:
            (A,) those that were `on_way` and have no way on.
        """
        arms, which, targets, steps, ends = round_
        left = (routed & ~arms.on_task[which]) | on_way
        swinging = on_way & arms.detour.swinging(which)
        rows = swinging.nonzero()[0]
        if len(rows):
            left[rows] = ~self._swing(round_, rows, arms.detour.swing[which[rows]])
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
        """A step of an arm off its map: towards its goal, the map at its own place, or a vertex, whichever is near.

        Where it finds no way, to look again takes long.
        """
        arms.detour.end(np.array([arm]))
        if arms.rests[arm] > 0:
            arms.rests[arm] -= 1
            return None
        near = self.solver.nearest(torch.from_numpy(arms.p[arm][None]), _WAYS_BACK)[1][0]
        ends = self.solver.configurations[near].numpy()
        here = self.solver.solve_columns(torch.from_numpy(arms.p[arm][:, None]))[0].T.numpy()
        if not self.follower.distance(here, arms.q[arm])[0] <= _ON_MAP:
            ends = np.concatenate([goal_q[None], here, ends])
        ends = ends[np.isfinite(ends).all(1)]
        step = rejoin(self.follower, torch.from_numpy(arms.q[arm]), torch.from_numpy(ends), int(arms.tries[arm]))
        if step is not None:
            arms.tries[arm] = max(arms.tries[arm] - 1, 0)
            return step.numpy()
        arms.tries[arm] += 1
        arms.rests[arm] = _REST if arms.tries[arm] >= len(SHARES) else 0
        return None
