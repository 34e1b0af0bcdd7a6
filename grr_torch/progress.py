"""How long work reports where it is, and what is left of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

# called as progress(what is being done, how much of it is done, how much there is)
Progress = Callable[[str, int, int], None]

# stages in the order in which they are done, with about how long each takes beside the others
Plan = Sequence[tuple[str, float]]

# of a stage that is less far, its weight tells more than its speed
_TELLING = 0.05


def silent(stage: str, done: int, total: int) -> None:
    """Reports nothing."""


class Outlook:
    """Foretells how long work will take, from a plan of its stages and from how fast those behind it were.

    A stage that comes again takes as long as it took before; others as long as their weights say beside what is done.
    """

    def __init__(self, plan: Plan, clock: Callable[[], float] = time.perf_counter) -> None:
        """Before the first stage.

        Args:
            plan: Stages and their weights. A stage may come more than once, or not at all.
            clock: Gives the time [s].
        """
        self._plan, self._clock = list(plan), clock
        self._entered = clock()
        self._at = -1
        # how far the present stage is, and how far it was when it was entered: some are done in part before
        self._share = self._since = 0.0
        self._seconds: dict[int, float] = {}

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Takes a report, as of `Progress`; stages that are not in the plan, or behind, count for nothing."""
        share = done / total if total else 1.0
        current = self._plan[self._at][0] if self._at >= 0 else None
        if stage != current or share < self._share:
            # one that begins anew is the next one of its name, or the same once more
            last = self._at + 2 if stage == current else len(self._plan)
            following = (at for at in range(self._at + 1, min(last, len(self._plan))) if self._plan[at][0] == stage)
            found = next(following, None)
            if found is None:
                return
            now = self._clock()
            if current is not None and self._since < _TELLING:
                self._seconds[self._at] = now - self._entered
            self._at, self._entered, self._since = found, now, share
        self._share = share

    def left(self) -> float | None:
        """Seconds that the current stage and those ahead will take; None while there is nothing to tell by."""
        if self._at < 0:
            return None
        weight = self._plan[self._at][1]
        spent = self._clock() - self._entered
        done = self._share - self._since
        weights = sum(self._plan[at][1] for at in self._seconds)
        if weights:
            per_weight = sum(self._seconds.values()) / weights
        elif done > 0.0:
            per_weight = spent / (done * weight)
        else:
            return None
        per_share = spent / done if done >= _TELLING else per_weight * weight
        ahead = (self._expected(at, per_weight) for at in range(self._at + 1, len(self._plan)))
        return per_share * (1.0 - self._share) + sum(ahead)

    def _expected(self, at: int, per_weight: float) -> float:
        """Seconds of a stage ahead."""
        name, weight = self._plan[at]
        same = [before for before in self._seconds if self._plan[before][0] == name]
        if not same:
            return per_weight * weight
        return weight * sum(self._seconds[k] for k in same) / sum(self._plan[k][1] for k in same)
