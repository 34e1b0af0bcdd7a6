"""What arms do next: straight on, on a route over the roadmap, along the edge of reach, or back to the map."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from grr_torch.applications.arms import Arms
from grr_torch.applications.hold import nearest_feasible
from grr_torch.applications.lines import Follower
from grr_torch.applications.rejoin import rejoin
from grr_torch.applications.routes import Routes
from grr_torch.applications.solve import Solver
from grr_torch.spaces.configuration import difference, distance

TRACKING, DETOURING, HOLDING, UNREACHABLE = range(4)

# vertices that are tried as the first of a route, as its last, and as a way back to the map
_ENTRIES = 6
_ENDS = 8
_WAYS_BACK = 32
# metres that a goal moves before the last vertex of the route to it is looked for again
_SAME_GOAL = 0.03
# the most steps for which an arm on a route does not look for a straight way
_MOST_DOUBT = 32
# the most that a guess is expected to be off by [rad]
_OFFSET = 0.3
# more than any distance of configurations [rad]
_NOT_JOINED = 1e3
# an arm so near [rad or m] to a vertex's configuration is at the vertex
_ARRIVED = 1e-6
# an arm so near [rad or m] to the map's configuration at its place is on the map
_ON_MAP = 0.05


class Steps(NamedTuple):
    """What A arms do next.

    Attributes:
        q: (A, n) configurations after the step.
        goals: (A, n) configurations that the step leads to; NaN where they are not known.
        points: (A, width) where the tools are then, on their task; NaN where that is to be looked at.
        codes: (A,) status codes.
    """

    q: Tensor
    goals: Tensor
    points: Tensor
    codes: Tensor


class Pilot:
    """Decides the next step of arms that are given targets."""

    def __init__(self, follower: Follower, solver: Solver, routes: Routes) -> None:
        self.follower, self.solver, self.routes = follower, solver, routes

    def steps(self, arms: Arms, which: Tensor, targets: Tensor) -> Steps:
        """The next step of some arms (A,) that are given targets (A, width).

        On a route, steps that look for a straight way take turns with such that only follow it: none takes long.
        """
        unknown = torch.full_like(targets, torch.nan)
        nowhere = torch.full_like(arms.q[which], torch.nan)
        steps = Steps(arms.q[which], nowhere, unknown, torch.full((len(which),), DETOURING))
        left = torch.ones(len(which), dtype=torch.bool)
        same = (targets - arms.aimed[which]).norm(dim=1) <= _SAME_GOAL
        blind = same & (arms.blind[which] > 0) & (arms.next_vertex[which] >= 0) & arms.on_task[which]
        on_way = blind.nonzero()[:, 0]
        if len(on_way):
            arms.blind[which[on_way]] -= 1
            steps.q[on_way], left[on_way] = self._route(arms, which[on_way])
        rest = left.nonzero()[:, 0]
        if len(rest) == len(which):
            return self._look(arms, which, targets)
        if len(rest):
            for part, other in zip(steps, self._look(arms, which[rest], targets[rest]), strict=True):
                part[rest] = other
        return steps

    def _look(self, arms: Arms, which: Tensor, targets: Tensor) -> Steps:
        """`steps` of arms that look where they can go."""
        # who waits for a target to become feasible looks for a nearer point to hold at, and at the target with it
        lost = arms.held[which].isfinite().all(1)
        if bool(lost.any()):
            lost[lost.clone()] = ~self._hold(arms, which[lost], targets[lost])
        q, p = arms.q[which], arms.p[which]
        direct, valid = torch.zeros_like(lost), torch.zeros_like(lost)
        steps = Steps(q, torch.full_like(q, torch.nan), p, torch.full((len(which),), TRACKING))
        rows = (~lost).nonzero()[:, 0]
        if len(rows):
            guesses, codes = self.solver.guess(targets[rows].to(torch.float64))
            rows, guesses = rows[codes <= 1], guesses[codes <= 1].to(targets)
        if len(rows):
            lines = self.follower.follow(q[rows], p[rows], guesses, targets[rows], arms.offsets[which[rows]])
            offsets = difference(guesses, lines.ends, self.follower.robot.continuous)
            fits = offsets.norm(dim=1) <= _OFFSET
            arms.offsets[which[rows]] = torch.where((lines.converged & fits)[:, None], offsets, 0.0)
            found = lines.converged & ~lines.collides & self.solver.on_map(lines.ends, guesses)
            direct[rows] = found & lines.direct & arms.on_task[which[rows]]
            valid[rows] = direct[rows] | (found & ~arms.barred_from(which[rows], targets[rows], _SAME_GOAL))
            steps.q[rows], steps.goals[rows], steps.points[rows] = lines.steps, lines.ends, lines.points
        if bool(direct.all()):
            arms.forget(which)
            return steps
        arms.forget(which[direct])
        fresh = (~valid & ~lost).nonzero()[:, 0]
        if len(fresh):
            self._hold(arms, which[fresh], targets[fresh])
        rest = (~direct).nonzero()[:, 0]
        others = self._indirect(arms, which[rest], targets[rest], valid[rest], steps.goals[rest])
        for part, other in zip(steps, others, strict=True):
            part[rest] = other
        return steps

    def _hold(self, arms: Arms, which: Tensor, targets: Tensor) -> Tensor:
        """Looks for the nearest points to targets (A, width) that arms can hold at; which targets are solvable (A,)."""
        unset = arms.held[which].isnan().any(1)
        base = torch.where(unset[:, None], arms.p[which], arms.held[which])
        # what is not to be gone to by any route must not be where a jump leads
        near = unset & arms.barred_from(which, targets, _SAME_GOAL)
        base_q = torch.where(near[:, None], arms.q[which], arms.held_q[which])
        arms.held[which], arms.held_q[which], solved = nearest_feasible(self.solver, base, base_q, targets)
        return solved

    def _indirect(self, arms: Arms, which: Tensor, targets: Tensor, valid: Tensor, ends: Tensor) -> Steps:
        """`steps` of arms that cannot go straight to their targets.

        Those that have a configuration there (`ends`, where `valid`) are on the way to it, others to where they hold.
        """
        goals, goals_q = targets.clone(), ends.clone()
        unknown = torch.full_like(goals, torch.nan)
        codes = torch.full((len(which),), DETOURING)
        steps = Steps(arms.q[which].clone(), torch.full_like(ends, torch.nan), unknown, codes)
        left = torch.ones_like(valid)
        arms.held[which[valid]] = arms.held_q[which[valid]] = torch.nan
        lost = (~valid).nonzero()[:, 0]
        if len(lost):
            goals[lost], goals_q[lost] = arms.held[which[lost]], arms.held_q[which[lost]]
            lines = self.follower.follow(arms.q[which[lost]], arms.p[which[lost]], goals_q[lost], goals[lost])
            straight = lines.direct & arms.on_task[which[lost]]
            rows = lost[straight]
            arms.next_vertex[which[rows]] = -1
            steps.q[rows], steps.goals[rows], steps.points[rows] = (
                part[straight] for part in (lines.steps, lines.ends, lines.points)
            )
            steps.codes[rows], left[rows] = UNREACHABLE, False
        routed = (left & arms.on_task[which]).nonzero()[:, 0]
        if len(routed):
            self._set_goals(arms, which[routed], goals[routed], goals_q[routed])
            steps.q[routed], left[routed] = self._route(arms, which[routed], looked=True)
            arms.blind[which[routed]], arms.aimed[which[routed]] = arms.doubt[which[routed]], targets[routed]
            self._find_ended(arms, which[routed], steps.q[routed], targets[routed])
        for row in left.nonzero()[:, 0].tolist():
            step = self._back(arms, int(which[row]), goals_q[row])
            if step is None:
                steps.codes[row] = HOLDING
            else:
                steps.q[row] = step
        return steps

    def _find_ended(self, arms: Arms, which: Tensor, steps: Tensor, targets: Tensor) -> None:
        """Looks for arms (A,) whose next configurations (A, n) are where they stand: their route has come to nothing.

        From a vertex whose next edge cannot be followed, another route is taken. Where there is no way on from the last
        vertex, the arm is to go as near to its target (A, width) as it can.
        """
        for row in ((steps - arms.q[which]).abs().amax(1) <= _ARRIVED).nonzero()[:, 0].tolist():
            arm = int(which[row])
            here, last = int(arms.next_vertex[arm]), int(arms.last_vertex[arm])
            following = -1 if here < 0 else int(self.routes.towards(last, arms.avoided[arm])[1][here])
            if here != last and following >= 0:
                arms.avoided[arm] |= {(here, following)}
            else:
                arms.barred[arm] = targets[row]
            arms.blind[arm] = 0

    def _set_goals(self, arms: Arms, which: Tensor, goals: Tensor, goals_q: Tensor) -> None:
        """Looks for the last vertices of arms' routes again, where the goals (A, width) have moved."""
        moved = ~((goals - arms.last_goal[which]).norm(dim=1) <= _SAME_GOAL)
        # whose straight way to the same goal came to nothing trusts the next one later, lest it goes to and fro
        again = arms.next_vertex[which] < 0
        longer = torch.where(again, 2 * arms.doubt[which], arms.doubt[which]).clamp_max(_MOST_DOUBT)
        arms.doubt[which] = torch.where(moved, 1, longer)
        if bool(moved.any()):
            arms.last_goal[which[moved]] = goals[moved]
            arms.last_vertex[which[moved]] = torch.tensor(self._last_vertices(goals[moved], goals_q[moved]))

    def _route(self, arms: Arms, which: Tensor, looked: bool = False) -> tuple[Tensor, Tensor]:
        """Steps (A, n) of arms on shortest paths to their last vertices, and which found no way (A,).

        Arms that have `looked` round in this step go on to the next vertex; others try to leave some out.
        """
        result, left = arms.q[which].clone(), torch.ones(len(which), dtype=torch.bool)
        ends = arms.last_vertex[which].tolist()
        for fresh in (False, True):
            # where the next vertex of a route cannot be gone to any more, a new way in is looked for
            rows = (left & ((arms.next_vertex[which] >= 0) | fresh)).nonzero()[:, 0].tolist()
            entries = self.solver.nearest(arms.p[which], _ENTRIES)[1] if fresh and rows else None
            tried: list[tuple[int, int, float, bool]] = []
            for row in rows:
                cost, following = self.routes.towards(ends[row], arms.avoided[int(which[row])])
                current = int(arms.next_vertex[which[row]])
                ahead = _ahead(current, following) if entries is None else entries[row].tolist()
                on_edge = 0 if fresh else 1 + self._arrived(arms, int(which[row]))
                if looked and not fresh:
                    ahead = ahead[:on_edge]
                tried += [(row, v, float(cost[v]), k < on_edge) for k, v in enumerate(ahead) if cost[v] < float("inf")]
            if tried:
                self._enter(arms, which, result, left, tried)
        return result, left

    def _arrived(self, arms: Arms, arm: int) -> bool:
        """Whether an arm is at the vertex that its route led to."""
        there = self.solver.configurations[arms.next_vertex[arm]].to(arms.q)
        return bool(distance(arms.q[arm], there, self.follower.robot.continuous) < _ARRIVED)

    def _enter(
        self, arms: Arms, which: Tensor, result: Tensor, left: Tensor, tried: list[tuple[int, int, float, bool]]
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
        owner, vertex = torch.tensor([item[0] for item in tried]), torch.tensor([item[1] for item in tried])
        q, p = arms.q[which[owner]], arms.p[which[owner]]
        placed, points = self.solver.configurations[vertex], self.solver.points[vertex]
        lines = self.follower.follow(q, p, placed, points)
        passable = lines.direct | (lines.safe & torch.tensor([item[3] for item in tried]))
        total = q.new_tensor([item[2] for item in tried]) + distance(q, placed, self.follower.robot.continuous)
        total = torch.where(passable, total, torch.inf)
        for row in dict.fromkeys(item[0] for item in tried):
            mine = (owner == row).nonzero()[:, 0]
            # of equal ways, the one that leads on
            best = mine[len(mine) - 1 - total[mine].flip(0).argmin()]
            if bool(total[best] < torch.inf):
                result[row], left[row] = lines.steps[best], False
                arms.next_vertex[which[row]] = vertex[best]

    def _last_vertices(self, goals: Tensor, goals_q: Tensor) -> list[int]:
        """Of the vertices round each goal that it is joined to by a continuous line, the one most like it.

        Of all of them, where there is no such line.
        """
        vertices = self.solver.nearest(goals, _ENDS)[1]
        placed = self.solver.configurations[vertices].to(goals_q)
        apart = distance(placed, goals_q[:, None], self.follower.robot.continuous)
        count = vertices.shape[1]
        lines = self.follower.follow(
            goals_q.repeat_interleave(count, 0),
            goals.repeat_interleave(count, 0),
            placed.reshape(-1, placed.shape[2]),
            self.solver.points[vertices].to(goals).reshape(-1, goals.shape[1]),
        )
        apart += torch.where(lines.direct.reshape(apart.shape), 0.0, _NOT_JOINED)
        return vertices.gather(1, apart.argmin(1)[:, None])[:, 0].tolist()

    def _back(self, arms: Arms, arm: int, goal_q: Tensor) -> Tensor | None:
        """A step of an arm off its map: towards its goal, the map at its own place, or a vertex, whichever is near."""
        arms.next_vertex[arm] = -1
        vertices = self.solver.nearest(arms.p[arm][None], _WAYS_BACK)[1][0]
        ends = self.solver.configurations[vertices].to(goal_q)
        here = self.solver.solve_columns(arms.p[arm][:, None])[0].T
        if not bool(distance(here, arms.q[arm], self.follower.robot.continuous) <= _ON_MAP):
            ends = torch.cat([goal_q[None], here, ends])
        return rejoin(self.follower, arms.q[arm], ends[ends.isfinite().all(1)])


def _ahead(vertex: int, following: np.ndarray) -> list[int]:
    """A vertex and the next two on the way from it."""
    path = [vertex]
    while len(path) < 3 and following[path[-1]] >= 0:
        path.append(int(following[path[-1]]))
    return path
