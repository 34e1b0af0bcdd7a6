"""Changes to a roadmap that lose none of its connected edges.

An edge that barely passes may fail beside other edges, as sums are rounded otherwise. What a roadmap calls connected is
what the check of all its edges says; so that check has the last word, and what it loses is won back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from grr_torch.progress import Progress, silent
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.checkpoint import UNKEPT, Stage
from grr_torch.resolution.edges import EdgeCheck, check_edges, continuous_edges
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.resolution.slopes import within_bound

# edges of maps that are checked whole again
_MOST_CHECKED = 65536


@dataclass(frozen=True)
class FlagCheck:
    """How edges of a roadmap are checked anew.

    Attributes:
        tolerances: Of the projections.
        check: What checks batches of edges.
        progress: Told how many edges are checked.
        kept: Where it is kept how far that is, when all are for the first time.
    """

    tolerances: Tolerances
    check: EdgeCheck
    progress: Progress = silent
    kept: Stage = UNKEPT

    def first(self, roadmap: Roadmap) -> Tensor:
        """All edges (E,) of a roadmap, for the first time."""
        return self._continuous(roadmap, roadmap.edges, self.progress, self.kept)

    def again(self, roadmap: Roadmap, which: Tensor | None = None) -> Tensor:
        """All edges of a roadmap, or some (E,) of them, without the others beside them: as many as are asked for."""

        def progress(_: str, done: int, total: int) -> None:
            self.progress("checking again", done, total)

        return self._continuous(roadmap, roadmap.edges if which is None else roadmap.edges[which], progress, UNKEPT)

    def _continuous(self, roadmap: Roadmap, edges: Tensor, progress: Progress, kept: Stage) -> Tensor:
        parts = roadmap.points, roadmap.configurations, roadmap.resolved, edges
        found = continuous_edges(roadmap.robot, roadmap.task, *parts, self.tolerances, progress, kept, self.check).cpu()
        return found & within_bound(roadmap, edges)


def is_large(roadmap: Roadmap) -> bool:
    """Whether a map has more than 65,536 edges between resolved vertices: to check all of them again takes long."""
    return int(roadmap.resolved[roadmap.edges].all(1).sum()) > _MOST_CHECKED


def moved(before: Roadmap, after: Roadmap) -> Tensor:
    """(V,) vertices that are not where they were, or were not resolved."""
    old, new = before.configurations, after.configurations
    return ((old != new) & ~(old.isnan() & new.isnan())).any(1)


def without_losses(
    before: Roadmap, after: Roadmap, send_back: Callable[[Roadmap, Tensor], Roadmap], flags: FlagCheck
) -> Roadmap:
    """A changed roadmap, but for the surroundings of edges that would be lost.

    The ends of such edges are sent back, as far as they are not where they were. If they are, the edge fails because
    others are checked beside it that were not: then what has changed nearest to it is sent back. Nothing is lost at the
    latest when all is as it was. In large maps what has moved is checked among few others only, and what has not is
    what it was.

    Args:
        before: The roadmap as it was; what it wrongly calls connected may be lost, if it is not large.
        after: The same with other configurations, or more vertices resolved.
        send_back: Gives, of a changed roadmap, one in which some vertices (K,) are nearer to what they were.
        flags: How edges are checked.

    Returns:
        The roadmap; its flags are those of all edges, checked together, if it is not large.
    """
    edges = before.edges
    claimed, settled = before.connected.clone(), torch.zeros_like(before.connected)
    connected, whole = flags.first(after), True
    while True:
        changed = moved(before, after)
        lost = claimed & ~connected
        rooted = lost & ~changed[edges].any(1)
        doubtful = rooted & ~settled
        if bool(doubtful.any()) and not is_large(after):
            # they were called connected and are not, or come out otherwise beside other edges: it is the batches in
            # which all edges of what was are checked that tell
            again = check_edges(before, flags.tolerances, wanted=doubtful) & within_bound(before, edges)
            claimed[doubtful] = again[doubtful]
            settled |= doubtful
            continue
        if not whole or is_large(after):
            # among few others, nothing is learned of what has not moved
            connected, lost = connected | rooted, lost & ~rooted
        back = _to_send_back(edges, lost, changed)
        if len(back):
            after = send_back(after, back)
            stale = torch.zeros_like(changed).index_fill_(0, back, True)[edges].any(1)
            connected[stale] = flags.again(after, stale)
            whole = False
        elif whole or is_large(after):
            flags.progress("checking again", len(edges), len(edges))
            return replace(after, connected=connected)
        else:
            connected, whole = flags.again(after), True


def _to_send_back(edges: Tensor, lost: Tensor, moved: Tensor) -> Tensor:
    """Of vertices that have moved (V,), the ends of lost edges (E,) and those nearest to lost ones that have not."""
    ends, near = torch.zeros_like(moved), torch.zeros_like(moved)
    ends[edges[lost]] = True
    near[edges[lost & ~moved[edges].any(1)]] = True
    while bool(near.any()) and bool(moved.any()) and not bool((near & moved).any()):
        wider = near.clone()
        wider[edges[near[edges].any(1)]] = True
        # what is cut off from all that has moved is checked beside any of it
        near = moved if torch.equal(wider, near) else wider
    return ((ends | near) & moved).nonzero()[:, 0]
