"""Arms under teleoperation: where they stand and what they are about."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from grr_torch.applications.lines import Follower

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
        held: (B, width) the nearest point to an unreachable target so far; NaN where there is none.
        held_q: (B, n) configurations there.
        last_vertex: (B,) the last vertex of a route, and
        last_goal: (B, width) the goal it belongs to; NaN where there is none.
        next_vertex: (B,) the vertex that a route leads to next; −1 where there is no route.
        blind: (B,) steps for which an arm on a route follows it before it looks for a straight way to its target again.
        aimed: (B, width) the target for which it does so; a target elsewhere is looked for at once.
        doubt: (B,) how many these are the next time.
        offsets: (B, n) what the last end of a line differed from its guess by.
        barred: (B, width) the last target that a route led near, without a way on from there; NaN where there is none.
        avoided: Of each arm, the edges that it could not follow since it last went straight.
    """

    q: Tensor
    speed: Tensor
    p: Tensor
    on_task: Tensor
    held: Tensor
    held_q: Tensor
    last_vertex: Tensor
    last_goal: Tensor
    next_vertex: Tensor
    blind: Tensor
    aimed: Tensor
    doubt: Tensor
    offsets: Tensor
    barred: Tensor
    avoided: list[frozenset[tuple[int, int]]]

    @staticmethod
    def at(follower: Follower, q: Tensor) -> Arms:
        """Arms that stand at configurations (B, n)."""
        nothing = q.new_full((len(q), follower.task.width), torch.nan)
        off, no_vertex = torch.zeros(len(q), dtype=torch.bool), torch.full((len(q),), -1)
        held, last_goal = nothing.clone(), nothing.clone()
        trust = torch.zeros_like(no_vertex), nothing.clone(), torch.ones_like(no_vertex)
        routes = no_vertex.clone(), last_goal, no_vertex, *trust
        still = torch.zeros_like(q)
        arms = Arms(
            q, still, nothing, off, held, q * torch.nan, *routes, still.clone(), nothing.clone(), [frozenset()] * len(q)
        )
        arms.look(follower, torch.arange(len(q)))
        return arms

    def look(self, follower: Follower, which: Tensor) -> None:
        """Finds out where the tools of some arms (A,) are, and whether these arms are on their task."""
        robot, task, q = follower.robot, follower.task, self.q[which]
        position, rotation = robot.forward_kinematics(q)
        self.p[which] = position[:, : task.dimension]
        error = task.error(self.p[which].T, position.T, rotation.permute(1, 2, 0))
        turned = task.residuals(error)[1] <= _OFF_TASK * follower.tolerances.rotation
        self.on_task[which] = turned & robot.within_limits(q) & ~robot.in_self_collision(q)

    def barred_from(self, which: Tensor, targets: Tensor, distance: float) -> Tensor:
        """Whether arms (A,) have targets (A, width) within a distance [m] of those that they are barred from: (A,)."""
        return (targets - self.barred[which]).norm(dim=1) <= distance

    def forget(self, which: Tensor) -> None:
        """Arms (A,) that have no more need of a route or a point to hold at."""
        self.held[which] = self.held_q[which] = self.barred[which] = torch.nan
        self.next_vertex[which] = -1
        self.blind[which] = 0
        for arm in which.tolist():
            self.avoided[arm] = frozenset()
