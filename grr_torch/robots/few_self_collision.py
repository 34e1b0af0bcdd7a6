"""`SphereKernel` for a few configurations on the CPU, in numpy.

All spheres of a configuration are placed at once if any two links of it are near: up to about a thousand configurations
the cost is that of calls. Distances are those of `SphereKernel`.
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
        # the centre of each link's bounding sphere, and of it and the others
        self._bounds = kernel.bounds.numpy()
        self._centres = np.ones((len(centres), 1 + size, 4), self._bounds.dtype)
        self._centres[:, :1] = self._bounds
        for link, own in centres.items():
            self._centres[link, 1:, :3] = own[_padded(len(own), size)]
        self._frames = kernel.frames.numpy()
        self._bound_reach = kernel.bound_reach.numpy()
        self._levers = kernel.levers.numpy()
        reach = (pair.reach[..., 0].numpy() for pair in kernel.spheres)
        self._reach = np.stack([part[np.ix_(*(_padded(count, size) for count in part.shape))] for part in reach])

    # what is beyond all numbers is not known to be free
    @np.errstate(over="ignore", invalid="ignore")
    def collides(self, frames: Array, margin: float) -> NDArray[np.bool_]:
        """`SphereKernel.collides`: (N,) bool for frames (F, 4, 3, N)."""
        poses = frames[self._frames]
        near = self._near(poses, self._bound_reach + margin)
        if np.count_nonzero(near) == 0:
            return np.zeros(near.shape[1], dtype=bool)
        hit: NDArray[np.bool_] = np.any(near, axis=0)
        few = hit.nonzero()[0]
        hit[few] = False
        placed = _place(self._centres, poses[..., few])
        pairs, columns = near[:, few].nonzero()
        limits = np.square(self._reach + margin)
        at_once = max(1, _DISTANCES_AT_ONCE // self._reach[0].size)
        for start in range(0, len(pairs), at_once):
            which, column = pairs[start : start + at_once], columns[start : start + at_once]
            # relative to the first link, so that little is lost in the difference of squares
            near_to = placed[self._first[which], 0, :, column][:, None]
            a, b = (placed[side[which], 1:, :, column] - near_to for side in (self._first, self._second))
            # to sum over so short an axis takes einsum a fifth of the time
            squared = np.matmul(-2.0 * a, b.transpose(0, 2, 1))
            squared += np.einsum("msk,msk->ms", a, a)[:, :, None]
            squared += np.einsum("msk,msk->ms", b, b)[:, None]
            touching = ~(squared >= limits[which]).reshape(len(which), -1).all(1)
            hit[few[column[touching]]] = True
        return hit

    @np.errstate(over="ignore", invalid="ignore")
    def may_collide_near(self, frames: Array, margin: float, motions: Array) -> NDArray[np.bool_]:
        """`Few.may_collide_near` for frames (F, 4, 3, N) and motions (n, N)."""
        reach = self._bound_reach + margin + self._levers @ np.abs(motions)
        return np.asarray(np.any(self._near(frames[self._frames], reach), axis=0))

    def _near(self, poses: Array, reach: Array) -> NDArray[np.bool_]:
        """Pairs of links (P, N) whose bounding spheres' centres are nearer to each other than (P, 1 or N)."""
        bounds = _place(self._bounds, poses)[:, 0]
        apart = bounds[self._first] - bounds[self._second]
        near: NDArray[np.bool_] = ~(np.einsum("pkn,pkn->pn", apart, apart) >= np.square(reach))
        return near


def _place(centres: Array, poses: Array) -> Array:
    """(L, S, 3, N) homogeneous centres (L, S, 4) of each link, placed by its poses (L, 4, 3, N)."""
    links, width = len(poses), poses.shape[3]
    return np.matmul(centres, poses.reshape(links, 4, 3 * width)).reshape(links, centres.shape[1], 3, width)


def _padded(count: int, size: int) -> NDArray[np.int64]:
    """Indices (size,) of `count` entries and, for the rest, of the first."""
    return np.where(np.arange(size) < count, np.arange(size), 0)
