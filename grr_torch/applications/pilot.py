"""What arms do next: straight on, on a route over the roadmap, along the edge of reach, or back to the map."""

from __future__ import annotations

import numpy as np
import torch

from grr_torch.applications.arms import Arms
from grr_torch.applications.detours import SAME_GOAL, Detours
from grr_torch.applications.hold import much_nearer, nearest_feasible
from grr_torch.applications.lines import Follower, norms
from grr_torch.applications.rejoin import rejoin
from grr_torch.applications.routes import Routes
from grr_torch.applications.solve import Solver
from grr_torch.applications.steps import HOLDING, TRACKING, UNREACHABLE, Steps
from grr_torch.pieces import Array, Mask

# vertices that are tried as a way back to the map
_WAYS_BACK = 32
# the most that a guess is expected to be off by [rad]; less than what the solver calls off the map
_OFFSET = 0.3
# an arm so near [rad or m] to the map's configuration at its place is on the map
_ON_MAP = 0.05


class Pilot:
    """Decides the next step of arms that are given targets. Works on arrays, as `Follower` does."""

    def __init__(self, follower: Follower, solver: Solver, routes: Routes) -> None:
        self.follower, self.solver = follower, solver
        self.detours = Detours(follower, solver, routes)

    def steps(self, arms: Arms, which: Array, targets: Array) -> Steps:
        """The next step of some arms (A,) that are given targets (A, width).

        Steps that take long take turns with others. On a route, one that looks for a straight way comes after one that
        only follows the route; and points to hold at are searched for in every other step, of all arms at once.
        """
        on_route = (arms.next_vertex[which] >= 0) & arms.on_task[which]
        blind = on_route & (arms.blind[which] > 0) & (norms(targets - arms.aimed[which]) <= SAME_GOAL)
        arms.blind[which[blind]] -= 1
        wanted = self._search(arms, which, targets, arms.holds(which) & ~blind)
        if not on_route.any():
            return self._look(arms, which, targets)
        steps, left = Steps.none_yet(arms, which), np.ones(len(which), dtype=bool)
        on_way = (blind | wanted & on_route).nonzero()[0]
        if len(on_way):
            steps.q[on_way], left[on_way] = self.detours.follow(arms, which[on_way], wanted[on_way])
        rest = left.nonzero()[0]
        if len(rest):
            steps.put(rest, self._look(arms, which[rest], targets[rest]))
        return steps

    def _search(self, arms: Arms, which: Array, targets: Array, holding: Mask) -> Mask:
        """Looks for nearer points to hold at, and at the targets with them, of arms that are holding (A,).

        An arm waits for the turn of all, but only once, and not if its target has leapt, or a vertex on the other side
        of a hole has come nearer.

        Returns:
            (A,) the arms for which that was due in this step; some of them wait.
        """
        leapt = ~(norms(targets - arms.sought[which]) <= SAME_GOAL)
        wanted = holding & (leapt | ~arms.searched[which])
        arms.turn = not arms.turn
        search = wanted & (leapt | arms.waited[which] | arms.turn)
        waits = (wanted & ~search).nonzero()[0]
        if len(waits):
            search[waits] = much_nearer(self.solver, arms.held[which[waits]], targets[waits])[0]
        arms.waited[which] = wanted & ~search
        if search.any():
            self._hold(arms, which[search], targets[search])
        return wanted

    def _look(self, arms: Arms, which: Array, targets: Array) -> Steps:
        """`steps` of arms that look where they can go."""
        lost = arms.holds(which) & ~arms.solvable[which]
        arms.searched[which] = False
        steps, ends, valid, direct = self._straight(arms, which, targets, ~lost)
        arms.forget(which[direct])
        if direct.all():
            return steps
        fresh = ~valid & ~lost
        if fresh.any():
            self._hold(arms, which[fresh], targets[fresh])
        rest = ~direct
        steps.put(rest, self._indirect(arms, which[rest], targets[rest], valid[rest], ends[rest]))
        return steps

    def _straight(self, arms: Arms, which: Array, targets: Array, solvable: Mask) -> tuple[Steps, Array, Mask, Mask]:
        """Steps straight to targets (A, width), as far as these are solvable (A,).

        Returns:
            The steps; configurations (A, n) at the targets; which targets (A,) the map has a configuration for; and
            which arms (A,) can go straight to it.
        """
        steps = Steps.none_yet(arms, which)
        ends = np.full_like(steps.q, np.nan)
        valid, direct = np.zeros_like(solvable), np.zeros_like(solvable)
        rows = solvable.nonzero()[0]
        if len(rows):
            points = torch.from_numpy(targets[rows].astype(np.float64))
            guesses, codes = (part.numpy() for part in self.solver.guess(points, certified=False))
            near = codes <= 1
            rows, guesses = rows[near], guesses[near].astype(targets.dtype)
        if len(rows):
            chosen = which[rows]
            lines = self.follower.follow(arms.q[chosen], arms.p[chosen], guesses, targets[rows], arms.offsets[chosen])
            offsets = self.follower.difference(guesses, lines.ends)
            fits = lines.converged & (norms(offsets) <= _OFFSET)
            arms.offsets[chosen] = np.where(fits[:, None], offsets, 0.0)
            found = lines.converged & ~lines.collides
            # what is near its guess is on the map
            far = (found & ~fits).nonzero()[0]
            if len(far):
                found[far] = self.solver.on_map(
                    *(torch.from_numpy(part[far]) for part in (lines.ends, guesses))
                ).numpy()
            free = found & lines.direct & arms.on_task[chosen]
            direct[rows], valid[rows] = free, free | (found & ~arms.barred_from(chosen, targets[rows], SAME_GOAL))
            ends[rows] = lines.ends
            steps.q[rows[free]], steps.goals[rows[free]] = lines.steps[free], lines.ends[free]
            steps.points[rows[free]], steps.codes[rows[free]] = lines.points[free], TRACKING
        return steps, ends, valid, direct

    def _hold(self, arms: Arms, which: Array, targets: Array) -> None:
        """Looks for the nearest points to targets (A, width) that arms can hold at, and whether these are solvable."""
        unset = ~arms.holds(which)
        base = np.where(unset[:, None], arms.p[which], arms.held[which])
        # what is not to be gone to by any route must not be where a jump leads
        near = unset & arms.barred_from(which, targets, SAME_GOAL)
        base_q = np.where(near[:, None], arms.q[which], arms.held_q[which])
        closely = arms.closely[which] & ~unset
        found = nearest_feasible(self.follower, self.solver, base, base_q, targets, closely)
        arms.held[which], arms.held_q[which], arms.solvable[which] = found
        arms.closely[which], arms.searched[which], arms.sought[which] = ~closely, True, targets

    def _indirect(self, arms: Arms, which: Array, targets: Array, valid: Mask, ends: Array) -> Steps:
        """`steps` of arms that cannot go straight to their targets.

        Those that have a configuration there (`ends`, where `valid`) are on the way to it, others to where they hold.
        """
        goals, goals_q = targets.copy(), ends.copy()
        steps, left = Steps.none_yet(arms, which), np.ones(len(which), dtype=bool)
        arms.held[which[valid]], arms.held_q[which[valid]] = np.nan, np.nan
        lost = (~valid).nonzero()[0]
        if len(lost):
            chosen = which[lost]
            goals[lost], goals_q[lost] = arms.held[chosen], arms.held_q[chosen]
            lines = self.follower.follow(arms.q[chosen], arms.p[chosen], goals_q[lost], goals[lost])
            straight = lines.direct & arms.on_task[chosen]
            rows = lost[straight]
            arms.next_vertex[which[rows]] = -1
            steps.q[rows], steps.goals[rows] = lines.steps[straight], lines.ends[straight]
            steps.points[rows], steps.codes[rows], left[rows] = lines.points[straight], UNREACHABLE, False
        routed = (left & arms.on_task[which]).nonzero()[0]
        if len(routed):
            chosen = which[routed]
            self.detours.set_goals(arms, chosen, goals[routed], goals_q[routed])
            steps.q[routed], left[routed] = self.detours.follow(arms, chosen, np.ones(len(chosen), dtype=bool))
            arms.blind[chosen], arms.aimed[chosen] = arms.doubt[chosen], targets[routed]
            found = ~left[routed]
            self.detours.give_up_ended(arms, chosen[found], steps.q[routed[found]], targets[routed[found]])
        for row in left.nonzero()[0].tolist():
            step = self._back(arms, int(which[row]), goals_q[row])
            if step is None:
                steps.codes[row] = HOLDING
            else:
                steps.q[row] = step
        return steps

    def _back(self, arms: Arms, arm: int, goal_q: Array) -> Array | None:
        """A step of an arm off its map: towards its goal, the map at its own place, or a vertex, whichever is near."""
        arms.next_vertex[arm] = -1
        near = self.solver.nearest(torch.from_numpy(arms.p[arm][None]), _WAYS_BACK)[1][0]
        ends = self.solver.configurations[near].numpy()
        here = self.solver.solve_columns(torch.from_numpy(arms.p[arm][:, None]))[0].T.numpy()
        if not self.follower.distance(here, arms.q[arm])[0] <= _ON_MAP:
            ends = np.concatenate([goal_q[None], here, ends])
        ends = ends[np.isfinite(ends).all(1)]
        step = rejoin(self.follower, torch.from_numpy(arms.q[arm]), torch.from_numpy(ends))
        return None if step is None else step.numpy()
