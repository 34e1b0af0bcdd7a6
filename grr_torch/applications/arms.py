"""Arms under teleoperation: where they stand and what they are about."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from grr_torch.applications.lines import Follower
from grr_torch.pieces import Array, Mask, norms

# rotation errors up to so many tolerances are made good on the way; with larger ones an arm is off its task
_OFF_TASK = 10.0


@dataclass(eq=False)
class Arms:
    """Where arms stand and what they are about; B of them.

    Attributes:
        q: (B, n) configurations, continuous joints not wrapped.
        speed: (B, n) what they moved in the last step, where accelerations are limited.
        p: (B, width) where their tools are.
        on_task: (B,) arms that meet their task's rotation and the joint limits and are free of self-collision.
        tracks: (B,) arms that went straight to their targets in the last step.
        held: (B, width) the nearest point to an unreachable target so far; NaN where there is none.
        held_q: (B, n) configurations there.
        due: (B,) steps that are left in which an arm is to come there; at least 1.
        level: (B,) how closely round the last one it is looked for next; 0 is far.
        sought: (B, width) the target for which it was last looked for; NaN where there is none.
        searched: (B,) whether what was found then has not been acted on yet.
        solvable: (B,) whether that target was solvable.
        waited: (B,) arms that did not look for it in the last step, though it was due.
        turn: Whether it is the turn of all arms to look for it.
        last_vertex: (B,) the last vertex of a route, and
        last_goal: (B, width) the goal it belongs to; NaN where there is none.
        left_vertex: (B,) the vertex that the route led to before, −1 where there was none, and
        next_vertex: (B,) the vertex that a route leads to next; −1 where there is no route.
        swing: (B, n) the configuration that a swing leads to; NaN where there is none.
        blind: (B,) steps for which an arm on a detour follows it before it looks for a straight way to its target.
        aimed: (B, width) the target for which it does so; a target elsewhere is looked for at once.
        doubt: (B,) how many these are the next time.
        hesitated: (B,) steps for which an arm has waited before a detour since it last went straight.
        offsets: (B, n) what the end of the last line differed from its guess by; 0 where it was not to a target.
        offset_at: (B, width) where that line led; NaN where there was none.
        barred: (B, width) the last target that a route led near, without a way on from there; NaN where there is none.
        given: (B, width) the last target that was accepted; NaN where there was none.
        unchanged: (B,) steps since it was first given.
        velocity: (B, d) the mean motion of the targets in a step [m].
        going: (B,) steps for which they have gone straight.
        meets: (B, width) where an arm that has fallen behind meets its target, which it heads for as for a target; NaN
            where there is no such place.
        looks_in: (B,) steps until it is looked for again.
        caught_up: (B,) steps for which the arm has been next to its target.
        tries: (B,) how often no way back to the map was found, less how often one was.
        rests: (B,) steps for which an arm does not look for one.
        avoided: Of each arm, the edges that it could not follow since it last went straight.
    """

    q: Array
    speed: Array
    p: Array
    on_task: Mask
    tracks: Mask
    held: Array
    held_q: Array
    due: Array
    level: Array
    sought: Array
    searched: Mask
    solvable: Mask
    waited: Mask
    turn: bool
    last_vertex: Array
    last_goal: Array
    left_vertex: Array
    next_vertex: Array
    swing: Array
    blind: Array
    aimed: Array
    doubt: Array
    hesitated: Array
    offsets: Array
    offset_at: Array
    barred: Array
    given: Array
    unchanged: Array
    velocity: Array
    going: Array
    meets: Array
    looks_in: Array
    caught_up: Array
    tries: Array
    rests: Array
    avoided: list[frozenset[tuple[int, int]]]

    @staticmethod
    def at(follower: Follower, q: Array) -> Arms:
        """Arms that stand at configurations (B, n)."""
        count = len(q)

        def unknown(width: int) -> Array:
            return np.full((count, width), np.nan, q.dtype)

        width, n = follower.task.width, q.shape[1]
        arms = Arms(
            q=q,
            speed=np.zeros_like(q),
            p=unknown(width),
            on_task=np.zeros(count, dtype=bool),
            tracks=np.zeros(count, dtype=bool),
            held=unknown(width),
            held_q=unknown(n),
            due=np.ones(count, dtype=np.int64),
            level=np.zeros(count, dtype=np.int64),
            sought=unknown(width),
            searched=np.zeros(count, dtype=bool),
            solvable=np.zeros(count, dtype=bool),
            waited=np.zeros(count, dtype=bool),
            turn=False,
            last_vertex=np.full(count, -1),
            last_goal=unknown(width),
            left_vertex=np.full(count, -1),
            next_vertex=np.full(count, -1),
            swing=unknown(n),
            blind=np.zeros(count, dtype=np.int64),
            aimed=unknown(width),
            doubt=np.ones(count, dtype=np.int64),
            hesitated=np.zeros(count, dtype=np.int64),
            offsets=np.zeros_like(q),
            offset_at=unknown(width),
            barred=unknown(width),
            given=unknown(width),
            unchanged=np.zeros(count, dtype=np.int64),
            velocity=np.zeros((count, follower.task.dimension), q.dtype),
            going=np.zeros(count, dtype=np.int64),
            meets=unknown(width),
            looks_in=np.zeros(count, dtype=np.int64),
            caught_up=np.zeros(count, dtype=np.int64),
            tries=np.zeros(count, dtype=np.int64),
            rests=np.zeros(count, dtype=np.int64),
            avoided=[frozenset()] * count,
        )
        arms.look(follower, np.arange(count))
        return arms

    def look(self, follower: Follower, which: Array) -> None:
        """Finds out where the tools of some arms (A,) are, and whether these arms are on their task."""
        robot, task, q = follower.robot.few, follower.task, np.ascontiguousarray(self.q[which].T)
        position, rotation = robot.tool_pose(q)
        points = task.at(torch.from_numpy(position), torch.from_numpy(rotation)).numpy()
        turned = norms(task.error_of_few(points, position, rotation)[task.dimension :].T)
        self.p[which], self.on_task[which] = points.T, turned <= _OFF_TASK * follower.tolerances.rotation
        self.on_task[which] &= robot.within_limits(q) & ~robot.in_self_collision(q)

    def holds(self, which: Array) -> Mask:
        """Whether arms (A,) have a point to hold at: (A,)."""
        return norms(self.held[which]) < np.inf

    def swings(self, which: Array) -> Mask:
        """Whether arms (A,) are on a swing: (A,)."""
        return ~np.isnan(self.swing[which, 0])

    def detours(self, which: Array) -> Mask:
        """Whether arms (A,) are on a route or a swing: (A,)."""
        return (self.next_vertex[which] >= 0) | self.swings(which)

    def meeting(self, which: Array) -> Mask:
        """Whether arms (A,) head for where they meet their targets: (A,)."""
        return ~np.isnan(self.meets[which, 0])

    def end_detour(self, which: Array) -> None:
        """Arms (A,) that are on no route or swing any more."""
        self.next_vertex[which], self.swing[which] = -1, np.nan

    def forget(self, which: Array) -> None:
        """Arms (A,) that have no more need of a detour or a point to hold at."""
        for nothing in (self.held, self.held_q, self.barred):
            nothing[which] = np.nan
        self.end_detour(which)
        self.blind[which], self.hesitated[which] = 0, 0
        for arm in which.tolist():
            self.avoided[arm] = frozenset()
