"""Newton IK: every target solved from where the arm stands, with no memory and no look ahead."""

from __future__ import annotations

import torch
from torch import Tensor

from grr_torch.baselines.reactive_ik import ReactiveIk
from grr_torch.projection.project import project_columns
from grr_torch.spaces.configuration import difference


class NewtonIk(ReactiveIk):
    """Follows targets by pseudo-inverse Newton–Raphson, as in the paper's teleoperation experiment (Section VI-B).

    At each step the target is solved from the configuration in which the arm stands, until it converges; the arm then
    goes straight towards the solution in joint space, no joint by more than `max_step`. If there is no solution within
    limits, or it is in self-collision, the arm stays.

    The paper's Newton–Raphson is its projection operator (Section III), so ours is `project` with its defaults: the
    steps of a damped pseudo-inverse, joints stopped at their limits while the others make up for it. That serves
    better than plain pseudo-inverse steps, joints clamped, do. The arm also stays where the configuration that it
    would be sent to is in self-collision, as it may be on the way to a free solution: a crash would end the path, and
    the target moves on.
    """

    def _start(self, q: Tensor) -> None:
        self._q = q

    def _advance(self, targets: Tensor) -> Tensor:
        q = self._q
        solved, valid = project_columns(self.robot, self.task, targets, q)
        motion = difference(q, solved, self.robot.continuous[:, None])
        share = (self._max_step / motion.abs()).amin(0).clamp_max(1.0)
        moved = torch.where(valid, torch.addcmul(q, share, motion), q)
        self._q = torch.where(self.robot.columns_in_self_collision(moved), q, moved)
        return self._q
