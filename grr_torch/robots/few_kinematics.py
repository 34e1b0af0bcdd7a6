"""`KinematicTree` for a few configurations on the CPU, in numpy.

Up to some dozens of configurations the cost of poses is that of calls, and a call of numpy costs a third of one of
torch. Layouts and formulas are those of `KinematicTree`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from grr_torch.pieces import Array

if TYPE_CHECKING:
    from grr_torch.robots.kinematics import KinematicTree


class FewKinematics:
    """Constants of a kinematic tree, and what is computed with them."""

    def __init__(self, tree: KinematicTree) -> None:
        self._joints = tree.joints
        self._parents = [joint.parent for joint in tree.joints]
        self._dofs = np.array([joint.dof for joint in tree.joints], dtype=np.int64)
        # rows z, origin, x, y, x
        self._mounts = [np.ascontiguousarray(mount.numpy()[[2, 3, 0, 1, 0]]) for mount in tree.mounts]
        self._tool, tool = tree.links[tree.tool]
        self._tool_mount = tool.numpy()
        self._base = np.eye(4, 3)[:, :, None]
        self._path = list(tree.path)
        self._slides = [index for index, joint in enumerate(tree.joints) if not joint.revolute]
        figures = np.array([(joint.multiplier, joint.offset) for joint in tree.joints])
        self._mimic = None if bool((figures == (1.0, 0.0)).all()) else figures.T[..., None]
        plain = [(i, joint.dof, joint.multiplier) for i, joint in zip(self._path, self._path_joints, strict=True)]
        self._drive = None
        if plain != [(i, i, 1.0) for i in range(tree.n)]:
            self._drive = np.zeros((tree.n, len(self._path)))
            for k, joint in enumerate(self._path_joints):
                self._drive[joint.dof, k] = joint.multiplier

    @property
    def _path_joints(self) -> list[Any]:
        return [self._joints[index] for index in self._path]

    def frames(self, q: Array) -> Array:
        """`KinematicTree.frames`: poses (F, 4, 3, N) for configurations q (n, N)."""
        count, width = len(self._joints), q.shape[1]
        values = q[self._dofs]
        if self._mimic is not None:
            values = (values * self._mimic[0] + self._mimic[1]).astype(q.dtype)
        cosines = np.cos(values)
        sines = np.empty((count, 2, 1, width), q.dtype)
        np.sin(values, out=sines[:, 0, 0])
        np.negative(sines[:, 0], out=sines[:, 1])
        size = 3 * width
        memory = np.empty((count + 2) * 4 * size, q.dtype)
        frames = memory.reshape(count + 2, 4, 3, width)
        whole = memory.reshape(count + 2, 4, size)
        frames[-1] = self._base
        for index, (parent, mount) in enumerate(zip(self._parents, self._mounts, strict=True)):
            # z and origin in their place, what has yet to be turned behind them, where the next frame comes to lie
            start = (4 * index + 2) * size
            rows = memory[start : start + 5 * size].reshape(5, size)
            np.matmul(mount, whole[parent], out=rows)
            turned, placed = frames[index, :2], rows.reshape(5, 3, width)
            if self._joints[index].revolute:
                # x' = c·x + s·y and y' = c·y − s·x, both at once
                np.multiply(placed[2:4], cosines[index], out=turned)
                turned += placed[3:5] * sines[index]
            else:
                turned[...] = placed[2:4]
                frames[index, 3] += frames[index, 2] * values[index]
        np.matmul(self._tool_mount, whole[self._tool], out=whole[-2])
        return frames

    def jacobian(self, frames: Array) -> Array:
        """`KinematicTree.jacobian`: (6, n, N) from frames (F, 4, 3, N)."""
        lines = frames[: len(self._path)] if self._drive is None else frames[self._path]
        ax, ay, az = lines[:, 2].transpose(1, 0, 2)
        rx, ry, rz = (frames[-2, 3] - lines[:, 3]).transpose(1, 0, 2)
        rows = np.empty((6, *ax.shape), frames.dtype)
        np.subtract(ay * rz, az * ry, out=rows[0])
        np.subtract(az * rx, ax * rz, out=rows[1])
        np.subtract(ax * ry, ay * rx, out=rows[2])
        rows[3:] = lines[:, 2].transpose(1, 0, 2)
        if self._slides:
            slides = [k for k, index in enumerate(self._path) if index in self._slides]
            rows[:3, slides] = rows[3:, slides]
            rows[3:, slides] = 0.0
        if self._drive is None:
            return rows
        # ∂/∂q sums over the joints that q drives
        return np.matmul(self._drive, rows).astype(frames.dtype)
