"""Arms under teleoperation: where they stand and what they are about."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch

from grr_torch.applications.lines import Follower
from grr_torch.pieces import Array, Mask, norms

# rotation errors up to so many tolerances are made good on the way; with larger ones an arm is off its task
_OFF_TASK = 10.0


@dataclass(eq=False)
class Hold:
    """Where arms hold whose targets cannot be reached.

    Attributes:
        point: (B, width) the nearest point to an unreachable target so far; NaN where there is none.
        q: (B, n) configurations there.
        due: (B,) steps that are left in which an arm is to come there; at least 1.
        level: (B,) how closely round the last one it is looked for next; 0 is far.
        sought: (B, width) the target for which it was last looked for; NaN where there is none.
        searched: (B,) whether what was found then has not been acted on yet.
        solvable: (B,) whether that target was solvable.
        waited: (B,) arms that did not look for it in the last step, though it was due.
        barred: (B, width) the last target that a route led near, without a way on from there; NaN where there is none.
    """

    point: Array
    q: Array
    due: Array
    level: Array
    sought: Array
    searched: Mask
    solvable: Mask
    waited: Mask
    barred: Array

    @staticmethod
    def none(q: Array, width: int) -> Hold:
        """Of arms (B, n) that do not hold, in a task space of so many coordinates."""
        return Hold(
            point=_unknown(q, width),
            q=np.full_like(q, np.nan),
            due=_counts(q, 1),
            level=_counts(q, 0),
            sought=_unknown(q, width),
            searched=_nobody(q),
            solvable=_nobody(q),
            waited=_nobody(q),
            barred=_unknown(q, width),
        )

    def known(self, which: Array) -> Mask:
        """Whether arms (A,) have a point to hold at: (A,)."""
        return norms(self.point[which]) < np.inf

    def forget(self, which: Array) -> None:
        """Arms (A,) that have no more need of one."""
        for nothing in (self.point, self.q, self.barred):
            nothing[which] = np.nan


@dataclass(eq=False)
class Detour:
    """Routes and swings that arms are on.

    Attributes:
        last_vertex: (B,) the last vertex of a route, and
        last_goal: (B, width) the goal it belongs to; NaN where there is none.
        left_vertex: (B,) the vertex that the route led to before, −1 where there was none, and
        next_vertex: (B,) the vertex that a route leads to next; −1 where there is no route.
        swing: (B, n) the configuration that a swing leads to; NaN where there is none.
        refused: (B,) arms whose swing to that goal came to nothing: they take a route.
        blind: (B,) steps for which an arm on a detour follows it before it looks for a straight way to its target.
        aimed: (B, width) the target for which it does so; a target elsewhere is looked for at once.
        doubt: (B,) how many these are the next time.
        hesitated: (B,) steps for which an arm has waited before a detour since it last went straight.
        avoided: Of each arm, the edges that it could not follow since it last went straight.
    """

    last_vertex: Array
    last_goal: Array
    left_vertex: Array
    next_vertex: Array
    swing: Array
    refused: Mask
    blind: Array
    aimed: Array
    doubt: Array
    hesitated: Array
    avoided: list[frozenset[tuple[int, int]]]

    @staticmethod
    def none(q: Array, width: int) -> Detour:
        """Of arms (B, n) that are on none, in a task space of so many coordinates."""
        return Detour(
            last_vertex=_counts(q, -1),
            last_goal=_unknown(q, width),
            left_vertex=_counts(q, -1),
            next_vertex=_counts(q, -1),
            swing=np.full_like(q, np.nan),
            refused=_nobody(q),
            blind=_counts(q, 0),
            aimed=_unknown(q, width),
            doubt=_counts(q, 1),
            hesitated=_counts(q, 0),
            avoided=[frozenset()] * len(q),
        )

    def swinging(self, which: Array) -> Mask:
        """Whether arms (A,) are on a swing: (A,)."""
        return ~np.isnan(self.swing[which, 0])

    def under_way(self, which: Array) -> Mask:
        """Whether arms (A,) are on a route or a swing: (A,)."""
        return (self.next_vertex[which] >= 0) | self.swinging(which)

    def end(self, which: Array) -> None:
        """Arms (A,) that are on no route or swing any more."""
        self.next_vertex[which], self.swing[which] = -1, np.nan

    def forget(self, which: Array) -> None:
        """Arms (A,) that have no more need of one."""
        self.end(which)
        self.blind[which], self.hesitated[which], self.refused[which] = 0, 0, False
        for arm in which.tolist():
            self.avoided[arm] = frozenset()


@dataclass(eq=False)
class Meeting:
    """How targets move, and where arms that have fallen behind meet them.

    Attributes:
        given: (B, width) the last target that was accepted; NaN where there was none.
        unchanged: (B,) steps since it was first given.
        velocity: (B, d) the mean motion of the targets in a step [m].
        going: (B,) steps for which they have gone straight.
        place: (B, width) where an arm that has fallen behind meets its target, which it heads for as for a target; NaN
            where there is no such place.
        across: (B,) whether that is on the other side of a hole.
        looks_in: (B,) steps until it is looked for again.
        caught_up: (B,) steps for which the arm has been next to its target.
    """

    given: Array
    unchanged: Array
    velocity: Array
    going: Array
    place: Array
    across: Mask
    looks_in: Array
    caught_up: Array

    @staticmethod
    def none(q: Array, width: int, dimension: int) -> Meeting:
        """Of arms (B, n) without targets, in a task space of so many coordinates and dimensions."""
        return Meeting(
            given=_unknown(q, width),
            unchanged=_counts(q, 0),
            velocity=np.zeros((len(q), dimension), q.dtype),
            going=_counts(q, 0),
            place=_unknown(q, width),
            across=_nobody(q),
            looks_in=_counts(q, 0),
            caught_up=_counts(q, 0),
        )

    def planned(self, which: Array) -> Mask:
        """Whether arms (A,) head for where they meet their targets: (A,)."""
        return ~np.isnan(self.place[which, 0])


@dataclass(eq=False)
class Arms:
    """Where arms stand and what they are about; B of them.

    Attributes:
        q: (B, n) configurations, continuous joints not wrapped.
        p: (B, width) where their tools are.
        on_task: (B,) arms that meet their task's rotation and the joint limits and are free of self-collision.
        hold: Where they hold.
        detour: The routes and swings that they are on.
        meeting: Where they meet their targets.
        speed: (B, n) what they moved in the last step, where accelerations are limited.
        tracks: (B,) arms that went straight to their targets in the last step.
        offsets: (B, n) what the end of the last line differed from its guess by; 0 where it was not to a target.
        offset_at: (B, width) where that line led; NaN where there was none.
        tries: (B,) how often no way back to the map was found, less how often one was.
        rests: (B,) steps for which an arm does not look for one.
        turn: Whether it is the turn of all arms to look for points to hold at.
    """

    q: Array
    p: Array
    on_task: Mask
    hold: Hold
    detour: Detour
    meeting: Meeting
    speed: Array = field(init=False)
    tracks: Mask = field(init=False)
    offsets: Array = field(init=False)
    offset_at: Array = field(init=False)
    tries: Array = field(init=False)
    rests: Array = field(init=False)
    turn: bool = False

    def __post_init__(self) -> None:
        """Arms at rest, of whose last step nothing is known."""
        self.speed, self.offsets = np.zeros_like(self.q), np.zeros_like(self.q)
        self.tracks, self.offset_at = _nobody(self.q), np.full_like(self.p, np.nan)
        self.tries, self.rests = _counts(self.q, 0), _counts(self.q, 0)

    @staticmethod
    def at(follower: Follower, q: Array) -> Arms:
        """Arms that stand at configurations (B, n)."""
        width, d = follower.task.width, follower.task.dimension
        records = Hold.none(q, width), Detour.none(q, width), Meeting.none(q, width, d)
        arms = Arms(q, _unknown(q, width), _nobody(q), *records)
        arms.look(follower, np.arange(len(q)))
        return arms

    def look(self, follower: Follower, which: Array) -> None:
        """Finds out where the tools of some arms (A,) are, and whether these arms are on their task."""
        robot, task, q = follower.robot.few, follower.task, np.ascontiguousarray(self.q[which].T)
        position, rotation = robot.tool_pose(q)
        points = task.at(torch.from_numpy(position), torch.from_numpy(rotation)).numpy()
        turned = norms(task.error_of_few(points, position, rotation)[task.dimension :].T)
        self.p[which], self.on_task[which] = points.T, turned <= _OFF_TASK * follower.tolerances.rotation
        self.on_task[which] &= robot.within_limits(q) & ~robot.in_self_collision(q)


def _unknown(q: Array, width: int) -> Array:
    """(B, width) of arms (B, n): NaN."""
    return np.full((len(q), width), np.nan, q.dtype)


def _nobody(q: Array) -> Mask:
    return np.zeros(len(q), dtype=bool)


def _counts(q: Array, count: int) -> Array:
    return np.full(len(q), count, dtype=np.int64)
