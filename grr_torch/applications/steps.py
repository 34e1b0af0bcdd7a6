"""What arms do next, and what they are doing then."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from grr_torch.applications.arms import Arms
from grr_torch.pieces import Array, Mask

# what a status says, and the codes of these
STATUSES = np.array(["tracking", "detouring", "holding", "unreachable"])
TRACKING, DETOURING, HOLDING, UNREACHABLE = range(len(STATUSES))


class Steps(NamedTuple):
    """What A arms do next.

    Attributes:
        q: (A, n) configurations after the step.
        goals: (A, n) configurations that the step leads to; NaN where they are not known.
        points: (A, width) where the tools are then, on their task; NaN where that is to be looked at.
        codes: (A,) status codes.
    """

    q: Array
    goals: Array
    points: Array
    codes: Array

    @staticmethod
    def none_yet(arms: Arms, which: Array) -> Steps:
        """Of arms (A,) that stay where they are, and of whom nothing is known."""
        q, points = arms.q[which], np.full_like(arms.p[which], np.nan)
        return Steps(q, np.full_like(q, np.nan), points, np.full(len(which), DETOURING))

    def put(self, rows: Array | Mask, others: Steps) -> None:
        """Sets those of some arms."""
        for part, other in zip(self, others, strict=True):
            part[rows] = other
