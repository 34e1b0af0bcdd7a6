"""`SphereKernel` for a few configurations on the CPU, in numpy.

All spheres are placed at once, whether they are near or not: up to about a thousand configurations the cost is that
of calls. Distances are those of `SphereKernel`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from grr_torch.pieces import Array

if TYPE_CHECKING:
    from grr_torch.robots.self_collision import SphereKernel


# distances between spheres that are held at once: they should stay in the cache
_DISTANCES_AT_ONCE = 1 << 16


class FewSpheres:
    """Constants of a sphere model, every link padded to as many spheres by its first one."""

    def __init__(self, kernel: SphereKernel) -> None:
        self._first, self._second = kernel.pairs.numpy()
        centres: dict[int, Array] = {}
        for first, second, pair in zip(self._first.tolist(), self._second.tolist(), kernel.spheres, strict=True):
            centres[first] = pair.first[:, :3].numpy() / -2.0
            centres[second] = pair.second[:, :3].numpy()
        size = max(map(len, centres.values()))
        # the centre of each link's bounding sphere, and of its spheres
        self._centres = np.ones((len(centres), 1 + size, 4), kernel.bounds.numpy().dtype)
        self._centres[:, :1] = kernel.bounds.numpy()
        for link, own in centres.items():
            self._centres[link, 1:, :3] = own[_padded(len(own), size)]
        self._frames = kernel.frames.numpy()
        self._bound_reach = kernel.bound_reach.numpy()
        reach = (pair.reach[..., 0].numpy() for pair in kernel.spheres)
        self._reach = np.stack([part[np.ix_(*(_padded(count, size) for count in part.shape))] for part in reach])

    # what is beyond all numbers is not known to be free
    @np.errstate(over="ignore", invalid="ignore")
    def collides(self, frames: Array, margin: float) -> NDArray[np.bool_]:
        """`SphereKernel.collides`: (N,) bool for frames (F, 4, 3, N)."""
        links, width = len(self._frames), frames.shape[3]
        placed = np.matmul(self._centres, frames[self._frames].reshape(links, 4, 3 * width))
        placed = placed.reshape(links, self._centres.shape[1], 3, width)
        apart = placed[self._first, 0] - placed[self._second, 0]
        near = ~((apart * apart).sum(1) >= np.square(self._bound_reach + margin))
        pairs, columns = near.nonzero()
        hit, limits = np.zeros(width, dtype=bool), np.square(self._reach + margin)
        at_once = max(1, _DISTANCES_AT_ONCE // self._reach[0].size)
        for start in range(0, len(pairs), at_once):
            which, column = pairs[start : start + at_once], columns[start : start + at_once]
            # relative to the first link, so that little is lost in the difference of squares
            near_to = placed[self._first[which], 0, :, column][:, None]
            a, b = (placed[side[which], 1:, :, column] - near_to for side in (self._first, self._second))
            squared = (a * a).sum(2)[:, :, None] + (b * b).sum(2)[:, None] - 2.0 * np.matmul(a, b.transpose(0, 2, 1))
            touching = ~(squared >= limits[which]).reshape(len(which), -1).all(1)
            hit[column[touching]] = True
        return hit


def _padded(count: int, size: int) -> NDArray[np.int64]:
    """Indices (size,) of `count` entries and, for the rest, of the first."""
    return np.where(np.arange(size) < count, np.arange(size), 0)
