"""What arms do next: straight on, on a route over the roadmap, along the edge of reach, or back to the map."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch

from grr_torch.applications.arms import Arms
from grr_torch.applications.hold import much_nearer, nearest_feasible
from grr_torch.applications.lines import Follower, norms
from grr_torch.applications.rejoin import rejoin
from grr_torch.applications.routes import Routes
from grr_torch.applications.solve import Solver
from grr_torch.applications.steps import HOLDING, TRACKING, UNREACHABLE, Steps
from grr_torch.pieces import Array, Mask

# vertices that are tried as the first of a route, as its last, and as a way back to the map
_ENTRIES = 6
_ENDS = 8
# of the latter, those that are tried first
_LIKELY = 2
_WAYS_BACK = 32
# metres that a goal moves before the last vertex of the route to it is looked for again
_SAME_GOAL = 0.03
# the most steps for which an arm on a route does not look for a straight way
_MOST_DOUBT = 32
# edges that an arm avoids before it gives a goal up
_MOST_AVOIDED = 8
# the most that a guess is expected to be off by [rad]; less than what the solver calls off the map
_OFFSET = 0.3
# an arm so near [rad or m] to a vertex's configuration is at the vertex
_ARRIVED = 1e-6
# an arm so near [rad or m] to the map's configuration at its place is on the map
_ON_MAP = 0.05


class Pilot:
    """Decides the next step of arms that are given targets. Works on arrays, as `Follower` does."""

    def __init__(self, follower: Follower, solver: Solver, routes: Routes) -> None:
        self.follower, self.solver, self.routes = follower, solver, routes

    def steps(self, arms: Arms, which: Array, targets: Array) -> Steps:
        """The next step of some arms (A,) that are given targets (A, width).

        On a route, steps that look for a straight way, and for a point to hold at, take turns with such that only
        follow it: none takes long.
        """
        on_route = (arms.next_vertex[which] >= 0) & arms.on_task[which]
        blind = on_route & (arms.blind[which] > 0) & (norms(targets - arms.aimed[which]) <= _SAME_GOAL)
        arms.blind[which[blind]] -= 1
        # who waits for a target to become feasible looks for a nearer point to hold at, and at the target with it
        search = arms.holds(which) & ~arms.searched[which] & ~blind
        arms.turn = not arms.turn
        if search.any() and not arms.turn:
            # every other time, and all arms at once, is enough, unless one has come to the other side of a hole
            search[search.copy()] = much_nearer(self.solver, arms.held[which[search]], targets[search])[0]
        if search.any():
            self._hold(arms, which[search], targets[search])
        if not on_route.any():
            return self._look(arms, which, targets)
        steps, left = Steps.none_yet(arms, which), np.ones(len(which), dtype=bool)
        on_way = (blind | search & on_route).nonzero()[0]
        if len(on_way):
            steps.q[on_way], left[on_way] = self._route(arms, which[on_way], search[on_way])
        rest = left.nonzero()[0]
        if len(rest):
            steps.put(rest, self._look(arms, which[rest], targets[rest]))
        return steps

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
            direct[rows], valid[rows] = free, free | (found & ~arms.barred_from(chosen, targets[rows], _SAME_GOAL))
            ends[rows] = lines.ends
            steps.q[rows[free]], steps.goals[rows[free]] = lines.steps[free], lines.ends[free]
            steps.points[rows[free]], steps.codes[rows[free]] = lines.points[free], TRACKING
        return steps, ends, valid, direct

    def _hold(self, arms: Arms, which: Array, targets: Array) -> None:
        """Looks for the nearest points to targets (A, width) that arms can hold at, and whether these are solvable."""
        unset = ~arms.holds(which)
        base = np.where(unset[:, None], arms.p[which], arms.held[which])
        # what is not to be gone to by any route must not be where a jump leads
        near = unset & arms.barred_from(which, targets, _SAME_GOAL)
        base_q = np.where(near[:, None], arms.q[which], arms.held_q[which])
        closely = arms.closely[which] & ~unset
        found = nearest_feasible(self.follower, self.solver, base, base_q, targets, closely)
        arms.held[which], arms.held_q[which], arms.solvable[which] = found
        arms.closely[which], arms.searched[which] = ~closely, True

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
            self._set_goals(arms, chosen, goals[routed], goals_q[routed])
            steps.q[routed], left[routed] = self._route(arms, chosen, np.ones(len(chosen), dtype=bool))
            arms.blind[chosen], arms.aimed[chosen] = arms.doubt[chosen], targets[routed]
            found = ~left[routed]
            self._find_ended(arms, chosen[found], steps.q[routed[found]], targets[routed[found]])
        for row in left.nonzero()[0].tolist():
            step = self._back(arms, int(which[row]), goals_q[row])
            if step is None:
                steps.codes[row] = HOLDING
            else:
                steps.q[row] = step
        return steps

    def _find_ended(self, arms: Arms, which: Array, steps: Array, targets: Array) -> None:
        """Looks for arms (A,) whose next configurations (A, n) are where they stand: their route has come to nothing.

        From a vertex whose next edge cannot be followed, another route is taken. Where there is no way on from the last
        vertex, the arm is to go as near to its target (A, width) as it can.
        """
        for row in (np.abs(steps - arms.q[which]).max(1) <= _ARRIVED).nonzero()[0].tolist():
            arm = int(which[row])
            here, last = int(arms.next_vertex[arm]), int(arms.last_vertex[arm])
            following = -1 if here < 0 else int(self.routes.towards(last, arms.avoided[arm])[1][here])
            if here != last and following >= 0 and len(arms.avoided[arm]) < _MOST_AVOIDED:
                arms.avoided[arm] |= {(here, following)}
            else:
                arms.barred[arm] = targets[row]
            arms.blind[arm] = 0

    def _set_goals(self, arms: Arms, which: Array, goals: Array, goals_q: Array) -> None:
        """Looks for the last vertices of arms' routes again, where the goals (A, width) have moved."""
        moved = ~(norms(goals - arms.last_goal[which]) <= _SAME_GOAL)
        # whose straight way to the same goal came to nothing trusts the next one later, lest it goes to and fro
        again = arms.next_vertex[which] < 0
        longer = np.minimum(np.where(again, 2 * arms.doubt[which], arms.doubt[which]), _MOST_DOUBT)
        arms.doubt[which] = np.where(moved, 1, longer)
        if moved.any():
            for arm in which[moved].tolist():
                arms.avoided[arm] = frozenset()
            arms.last_goal[which[moved]] = goals[moved]
            arms.last_vertex[which[moved]] = self._last_vertices(goals[moved], goals_q[moved])

    def _route(self, arms: Arms, which: Array, looked: Mask) -> tuple[Array, Mask]:
        """Steps (A, n) of arms on shortest paths to their last vertices, and which found no way (A,).

        Arms that have `looked` round (A,) in this step go on to the next vertex; others try to leave some out.
        """
        result, left = arms.q[which].copy(), np.ones(len(which), dtype=bool)
        ends = arms.last_vertex[which].tolist()
        for fresh in (False, True):
            # where the next vertex of a route cannot be gone to any more, a new way in is looked for
            rows = (left & ((arms.next_vertex[which] >= 0) | fresh)).nonzero()[0].tolist()
            entries = self._nearest(arms.p[which], _ENTRIES) if fresh and rows else None
            tried: list[tuple[int, int, float, bool]] = []
            for row in rows:
                cost, following = self.routes.towards(ends[row], arms.avoided[int(which[row])])
                current = int(arms.next_vertex[which[row]])
                ahead = _ahead(current, following) if entries is None else entries[row].tolist()
                on_edge = 0 if fresh else 1 + self._arrived(arms, int(which[row]))
                if looked[row] and not fresh:
                    ahead = ahead[:on_edge]
                tried += [(row, v, float(cost[v]), k < on_edge) for k, v in enumerate(ahead) if cost[v] < float("inf")]
            if tried:
                self._enter(arms, which, result, left, tried)
        return result, left

    def _arrived(self, arms: Arms, arm: int) -> bool:
        """Whether an arm is at the vertex that its route led to."""
        return bool(self.follower.distance(arms.q[arm], self._placed[arms.next_vertex[arm]]) < _ARRIVED)

    def _enter(
        self, arms: Arms, which: Array, result: Array, left: Mask, tried: list[tuple[int, int, float, bool]]
    ) -> None:
        """Sends arms (A,) to that of their vertices from which the way is shortest, if one can be gone to.

        Args:
            arms: All arms.
            which: (A,) those that are routed.
            result: (A, n) their next configurations, which are set.
            left: (A,) those that have no next configuration yet.
            tried: Row in `which`, vertex, length of the way from there, and whether the arm is on an edge that leads
                there, which is known to be continuous.
        """
        owner, vertex, lengths, on_edge = (np.array(part) for part in zip(*tried, strict=True))
        q, p = arms.q[which[owner]], arms.p[which[owner]]
        placed, points = self._placed[vertex], self._points[vertex]
        lines = self.follower.follow(q, p, placed, points)
        total = np.where(lines.direct | (lines.safe & on_edge), lengths + self.follower.distance(q, placed), np.inf)
        for row in dict.fromkeys(owner.tolist()):
            mine = (owner == row).nonzero()[0]
            # of equal ways, the one that leads on
            best = mine[len(mine) - 1 - total[mine][::-1].argmin()]
            if total[best] < np.inf:
                result[row], left[row] = lines.steps[best], False
                arms.next_vertex[which[row]] = vertex[best]

    def _last_vertices(self, goals: Array, goals_q: Array) -> Array:
        """Of the vertices round each goal that it is joined to by a continuous line, the one most like it.

        Of all of them, where there is no such line.
        """
        vertices = self._nearest(goals, _ENDS)
        apart = self.follower.distance(self._placed[vertices], goals_q[:, None])
        vertices = np.take_along_axis(vertices, apart.argsort(1, kind="stable"), axis=1)
        chosen, left = vertices[:, 0].copy(), np.arange(len(goals))
        # the first one that is joined is it, and it is seldom far down the list
        for tried in (vertices[:, :_LIKELY], vertices[:, _LIKELY:]):
            ends = tried[left]
            if ends.size == 0:
                break
            q, p = (part[left].repeat(ends.shape[1], 0) for part in (goals_q, goals))
            lines = self.follower.follow(q, p, self._placed[ends.ravel()], self._points[ends.ravel()])
            joined = lines.direct.reshape(ends.shape)
            found = joined.any(1)
            chosen[left[found]] = ends[found, joined[found].argmax(1)]
            left = left[~found]
        return chosen

    def _back(self, arms: Arms, arm: int, goal_q: Array) -> Array | None:
        """A step of an arm off its map: towards its goal, the map at its own place, or a vertex, whichever is near."""
        arms.next_vertex[arm] = -1
        ends = self._placed[self._nearest(arms.p[arm][None], _WAYS_BACK)[0]]
        here = self.solver.solve_columns(torch.from_numpy(arms.p[arm][:, None]))[0].T.numpy()
        if not self.follower.distance(here, arms.q[arm])[0] <= _ON_MAP:
            ends = np.concatenate([goal_q[None], here, ends])
        ends = ends[np.isfinite(ends).all(1)]
        step = rejoin(self.follower, torch.from_numpy(arms.q[arm]), torch.from_numpy(ends))
        return None if step is None else step.numpy()

    def _nearest(self, points: Array, count: int) -> Array:
        """(A, count) resolved vertices nearest to points (A, width)."""
        return self.solver.nearest(torch.from_numpy(points), count)[1].numpy()

    @cached_property
    def _placed(self) -> Array:
        """(V, n) configurations of the vertices."""
        return self.solver.configurations.numpy()

    @cached_property
    def _points(self) -> Array:
        """(V, width) points of the vertices."""
        return self.solver.points.numpy()


def _ahead(vertex: int, following: np.ndarray) -> list[int]:
    """A vertex and the next two on the way from it."""
    path = [vertex]
    while len(path) < 3 and following[path[-1]] >= 0:
        path.append(int(following[path[-1]]))
    return path
