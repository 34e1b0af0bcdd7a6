"""Detours of arms to where they cannot go straight: swings, and the quickest routes over the roadmap."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch

from grr_torch.applications.arms import Arms
from grr_torch.applications.lines import Follower
from grr_torch.applications.routes import Routes
from grr_torch.applications.solve import Solver
from grr_torch.pieces import Array, Mask

# vertices that are tried as the first of a route, and as its last
_ENTRIES = 6
_ENDS = 8
# of the latter, those that are tried first
_LIKELY = 2
# the most steps for which an arm on a route does not look for a straight way
_MOST_DOUBT = 32
# edges that an arm avoids before it gives a goal up
_MOST_AVOIDED = 8
# of the longest step: a shorter one along an edge that does not end there leads nowhere
_ALL_BUT_ENDED = 0.05
# an arm so near [rad or m] to a vertex's configuration is at the vertex
_ARRIVED = 1e-6


class Detours:
    """Leads arms on swings and over the roadmap. Works on arrays, as `Follower` does."""

    def __init__(self, follower: Follower, solver: Solver, routes: Routes) -> None:
        self.follower, self.solver, self.routes = follower, solver, routes

    def set_goals(self, arms: Arms, which: Array, goals: Array) -> None:
        """Arms have no way straight to goals (A, width); where these have moved, there is no route to them yet."""
        detour = arms.detour
        moved = ~self.follower.same_goal(goals, detour.last_goal[which])
        # whose straight way to the same goal came to nothing trusts the next one later, lest it goes to and fro
        again = ~detour.under_way(which)
        longer = np.minimum(np.where(again, 2 * detour.doubt[which], detour.doubt[which]), _MOST_DOUBT)
        detour.doubt[which] = np.where(moved, 1, longer)
        for arm in which[moved].tolist():
            detour.avoided[arm] = frozenset()
        detour.last_goal[which[moved]], detour.last_vertex[which[moved]] = goals[moved], -1
        detour.refused[which[moved]] = False

    def swing(self, arms: Arms, which: Array, goals_q: Array) -> tuple[Array, Array, Mask]:
        """Swings of arms to configurations (A, n), or next to them. No route is quicker.

        One that an arm is already on has been looked at; of it only the step is. One that is not free, or leads no
        nearer, since the tool had to be turned on the way, is over.

        Returns:
            Steps (A, n), the points (A, width) where tools are after them, and which swings (A,) are free.
        """
        detour = arms.detour
        under_way = self.follower.distance(detour.swing[which], goals_q) < self.follower.epsilon
        under_way &= self.follower.distance(arms.q[which], detour.swing[which]) >= _ARRIVED
        ends = np.where(under_way[:, None], detour.swing[which], goals_q)
        steps, points, free = arms.q[which], arms.p[which], np.zeros_like(under_way)
        for wholly, rows in ((False, under_way.nonzero()[0]), (True, (~under_way).nonzero()[0])):
            if len(rows):
                placed = arms.q[which[rows]], arms.p[which[rows]]
                lines = self.follower.swing(*placed, ends[rows], self.solver.bounds, wholly=wholly)
                steps[rows], points[rows] = lines.steps, lines.points
                free[rows] = lines.direct if wholly else lines.safe
        left = self.follower.distance(arms.q[which], ends)
        astray = under_way & ~(self.follower.distance(steps, ends) < left)
        detour.refused[which[astray]] = True
        free &= ~detour.refused[which]
        # a route is left for a swing that is free, not for one that is refused
        detour.swing[which] = np.where(free[:, None], ends, np.nan)
        detour.next_vertex[which[free]] = -1
        detour.blind[which[self.follower.distance(steps, ends) < _ARRIVED]] = 0
        return steps, points, free

    def set_last_vertices(self, arms: Arms, which: Array, goals: Array, goals_q: Array) -> None:
        """Looks for last vertices of routes to goals (A, width), configurations (A, n), where they are not known."""
        unknown = arms.detour.last_vertex[which] < 0
        if unknown.any():
            arms.detour.last_vertex[which[unknown]] = self._last_vertices(goals[unknown], goals_q[unknown])

    def follow(self, arms: Arms, which: Array, briefly: Mask) -> tuple[Array, Mask]:
        """Steps (A, n) of arms on the quickest paths to their last vertices, and which found no way (A,).

        Arms that have to do it `briefly` (A,), for something else took time, go on to the next vertex; others try to
        leave some out.
        """
        detour = arms.detour
        result, left = arms.q[which].copy(), np.ones(len(which), dtype=bool)
        ends = detour.last_vertex[which].tolist()
        for fresh in (False, True):
            # where the next vertex of a route cannot be gone to any more, a new way in is looked for
            rows = (left & ((detour.next_vertex[which] >= 0) | fresh)).nonzero()[0].tolist()
            entries = self._nearest(arms.p[which], _ENTRIES) if fresh and rows else None
            tried: list[tuple[int, int, float, bool]] = []
            for row in rows:
                cost, following = self.routes.towards(ends[row], detour.avoided[int(which[row])])
                current = int(detour.next_vertex[which[row]])
                ahead = _ahead(current, following) if entries is None else entries[row].tolist()
                on_edge = 0 if fresh else 1 + self._arrived(arms, int(which[row]))
                if briefly[row] and not fresh:
                    ahead = ahead[:on_edge]
                tried += [(row, v, float(cost[v]), k < on_edge) for k, v in enumerate(ahead) if cost[v] < float("inf")]
            if tried:
                self._enter(arms, which, result, left, tried)
        return result, left

    def give_up_ended(self, arms: Arms, which: Array, steps: Array, targets: Array) -> Mask:
        """Gives up routes that have come to nothing: whose arms' next configurations (A, n) bring them no farther.

        Where the straight way along an edge, or on from a vertex, ends, another route is taken. Where there is none,
        the arm is to go as near to its target (A, width) as it can.

        Returns:
            (A,) those that were given up.
        """
        detour = arms.detour
        share = (np.abs(steps - arms.q[which]) / self.follower.longest.numpy()).max(1)
        heading = detour.next_vertex[which]
        there = self.follower.distance(steps, self._placed[heading]) < _ARRIVED
        ended = share <= np.where(there & (heading != detour.last_vertex[which]), _ARRIVED, _ALL_BUT_ENDED)
        for row in ended.nonzero()[0].tolist():
            arm = int(which[row])
            edge = self._edge_ahead(arms, arm) if there[row] else (int(detour.left_vertex[arm]), int(heading[row]))
            if min(edge) >= 0 and len(detour.avoided[arm]) < _MOST_AVOIDED:
                detour.avoided[arm] |= {edge}
                detour.next_vertex[arm] = heading[row] if there[row] else -1
            else:
                # nor is there a way to where it was to hold
                arms.hold.point[arm], arms.hold.q[arm], arms.hold.barred[arm] = np.nan, np.nan, targets[row]
            detour.blind[arm] = 0
        return ended

    def _edge_ahead(self, arms: Arms, arm: int) -> tuple[int, int]:
        """The edge on which an arm at the next vertex of its route goes on; a negative vertex where there is none."""
        detour = arms.detour
        here, last = int(detour.next_vertex[arm]), int(detour.last_vertex[arm])
        return here, -1 if here == last else int(self.routes.towards(last, detour.avoided[arm])[1][here])

    def _arrived(self, arms: Arms, arm: int) -> bool:
        """Whether an arm is at the vertex that its route led to."""
        return bool(self.follower.distance(arms.q[arm], self._placed[arms.detour.next_vertex[arm]]) < _ARRIVED)

    def _enter(
        self, arms: Arms, which: Array, result: Array, left: Mask, tried: list[tuple[int, int, float, bool]]
    ) -> None:
        """Sends arms (A,) to that of their vertices from which the way is quickest, if one can be gone to.

        Args:
            arms: All arms.
            which: (A,) those that are routed.
            result: (A, n) their next configurations, which are set.
            left: (A,) those that have no next configuration yet.
            tried: Row in `which`, vertex, length of the way from there, and whether the arm is on an edge that leads
                there, which is known to be continuous.
        """
        detour = arms.detour
        owner, vertex, lengths, on_edge = (np.array(part) for part in zip(*tried, strict=True))
        q, p = arms.q[which[owner]], arms.p[which[owner]]
        placed, points = self._placed[vertex], self._points[vertex]
        lines = self.follower.follow(q, p, placed, points)
        steps = lengths + self.follower.duration(self.follower.difference(q, placed))
        total = np.where(lines.direct | (lines.safe & on_edge), steps, np.inf)
        for row in dict.fromkeys(owner.tolist()):
            mine = (owner == row).nonzero()[0]
            # of equal ways, the one that leads on
            best = mine[len(mine) - 1 - total[mine][::-1].argmin()]
            if total[best] < np.inf:
                arm = which[row]
                result[row], left[row] = lines.steps[best], False
                if vertex[best] != detour.next_vertex[arm]:
                    detour.left_vertex[arm], detour.next_vertex[arm] = detour.next_vertex[arm], vertex[best]

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
