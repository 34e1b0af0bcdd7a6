"""`KinematicTree` for a few configurations on the CPU, in numpy.

Up to some dozens of configurations the cost of poses is that of calls, and a call of numpy costs a third of one of
torch. Layouts and formulas are those of `KinematicTree`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from grr_torch.pieces import LAST, NEXT, Array

if TYPE_CHECKING:
    from grr_torch.robots.kinematics import KinematicTree


class FewKinematics:
    """Constants of a kinematic tree, and what is computed with them."""

    def __init__(self, tree: KinematicTree) -> None:
        self._joints = tree.joints
        self._parents = [joint.parent for joint in tree.joints]
        dofs = [joint.dof for joint in tree.joints]
        self._dofs = None if dofs == list(range(tree.n)) else np.array(dofs, dtype=np.int64)
        mounts = [mount.numpy() for mount in tree.mounts]
        # what cos q, sin q, 1 and q make of a joint's frame in its parent's
        self._terms = np.stack(
            [_terms(mount, joint.revolute) for mount, joint in zip(mounts, tree.joints, strict=True)]
        )
        self._tool, tool = tree.links[tree.tool]
        self._tool_mount = tool.numpy()
        self._base = np.eye(4, 3)
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
        values = q if self._dofs is None else q[self._dofs]
        if self._mimic is not None:
            values = (values * self._mimic[0] + self._mimic[1]).astype(q.dtype)
        count, width = values.shape
        factors = np.empty((count, width, 4), q.dtype)
        np.cos(values, out=factors[..., 0])
        np.sin(values, out=factors[..., 1])
        factors[..., 2], factors[..., 3] = 1.0, values
        local = np.matmul(factors, self._terms).reshape(count, width, 4, 4)
        frames = np.empty((count + 2, width, 4, 3), q.dtype)
        frames[-1] = self._base
        for index, parent in enumerate(self._parents):
            np.matmul(local[index], frames[parent], out=frames[index])
        np.matmul(self._tool_mount, frames[self._tool], out=frames[-2])
        return np.ascontiguousarray(frames.transpose(0, 2, 3, 1))

    def jacobian(self, frames: Array) -> Array:
        """`KinematicTree.jacobian`: (6, n, N) from frames (F, 4, 3, N)."""
        lines = frames[: len(self._path)] if self._drive is None else frames[self._path]
        axes, reach = lines[:, 2].transpose(1, 0, 2), (frames[-2, 3] - lines[:, 3]).transpose(1, 0, 2)
        rows = np.empty((6, *axes.shape[1:]), frames.dtype)
        np.subtract(axes[NEXT] * reach[LAST], axes[LAST] * reach[NEXT], out=rows[:3])
        rows[3:] = axes
        if self._slides:
            slides = [k for k, index in enumerate(self._path) if index in self._slides]
            rows[:3, slides] = rows[3:, slides]
            rows[3:, slides] = 0.0
        if self._drive is None:
            return rows
        # ∂/∂q sums over the joints that q drives
        return np.matmul(self._drive, rows).astype(frames.dtype)


def _terms(mount: Array, revolute: bool) -> Array:
    """(4, 16) rows of a joint's frame (4, 4), its axes and its origin, that go with cos q, sin q, 1 and q."""
    terms = np.zeros((4, 4, 4), mount.dtype)
    x, y, z, origin = mount
    if revolute:
        terms[0, :2] = x, y
        terms[1, :2] = y, -x
        terms[2, 2:] = z, origin
    else:
        terms[2] = mount
        terms[3, 3] = z
    return terms.reshape(4, 16)
