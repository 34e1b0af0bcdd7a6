"""Poses and Jacobians of all links for many configurations at once, one configuration a column.

A column layout, (n, N) in and (rows, …, N) out, makes every step an operation on long contiguous rows. Each moving
joint gets a *frame*: its link's frame turned so that the joint's axis is the frame's z axis. Poses of all frames are
one tensor (F, 4, 3, N): frame, its x, y, z axes and its origin, base coordinates, configuration. Behind the frames of
the joints come the tool's and the base's.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from grr_torch.pieces import are_few
from grr_torch.robots.few_kinematics import FewKinematics


@dataclass(frozen=True)
class MovingJoint:
    """A joint whose value depends on the configuration.

    Attributes:
        parent: Index of the frame it is mounted on; −1 for the base.
        revolute: Turns about the frame's z axis if true, slides along it otherwise.
        dof: The configuration entry that drives it.
        multiplier: Joint value = multiplier · q[dof] + offset (1 and 0 unless it is a mimic joint).
        offset: See `multiplier`.
    """

    parent: int
    revolute: bool
    dof: int
    multiplier: float
    offset: float


@dataclass(frozen=True, eq=False)
class KinematicTree:
    """Constants of the forward kinematics of a robot's whole tree of links.

    Attributes:
        joints: The moving joints, parents first; joint i drives frame i.
        mounts: For each joint (4, 4): rows give x, y, z and origin of its frame at value zero as combinations of its
            parent frame's x, y, z and origin.
        links: For each link: the frame it is fixed to (−1: the base), and rows (4, 4) as in `mounts` that give its
            own frame.
        tool: The link at the end of the chain.
        path: Frames from the base to the tool.
        n: Degrees of freedom.
    """

    joints: tuple[MovingJoint, ...]
    mounts: tuple[Tensor, ...]
    links: Mapping[str, tuple[int, Tensor]]
    tool: str
    path: tuple[int, ...]
    n: int

    def above(self, frame: int) -> Iterator[int]:
        """The frame, and those that it is mounted on, up to the base, which is left out."""
        while frame >= 0:
            yield frame
            frame = self.joints[frame].parent

    def frames(self, q: Tensor, workspace: Tensor | None = None) -> Tensor:
        """Poses (F, 4, 3, N) of all frames for configurations q (n, N); the last two are the tool and the base.

        Args:
            q: (n, N) configurations.
            workspace: From `workspace`: where the result may be put, so that the next call with it overwrites it.
        """
        if torch.is_grad_enabled() and q.requires_grad:
            return _Frames.apply(q, self)  # type: ignore[no-untyped-call]
        if are_few(q):
            return torch.from_numpy(self.few.frames(q.detach().numpy()))
        return self._frames_of_many(q, self.workspace(q, q.shape[1]) if workspace is None else workspace)

    def workspace(self, like: Tensor, width: int) -> Tensor:
        """Memory for `frames` of up to `width` configurations; to ask the system for it each time takes longer."""
        return like.new_empty(12 * (len(self.joints) + 2) * width)

    def _frames_of_many(self, q: Tensor, workspace: Tensor) -> Tensor:
        """Joint by joint, parents first: 72 multiply-adds a joint and configuration, three passes, in place.

        What has yet to be turned is put where the next frame comes to lie.
        """
        width, count = q.shape[1], len(self.joints)
        values = self._joint_values(q)
        cosines, sine = values.cos().unbind(0), values.sin()
        sines = torch.stack([sine, -sine], 1)[:, :, None].unbind(0)
        frames = workspace[: 12 * (count + 2) * width].view(count + 2, 4, 3, width)
        frames[-1] = torch.eye(4, 3, dtype=q.dtype, device=q.device)[:, :, None]
        whole, turned = frames.view(count + 2, 4, -1).unbind(0), frames[:, :2].unbind(0)
        # rows z, origin, x, y, x at value zero, the first two in their place
        size = 3 * width
        mounted = frames.as_strided((count, 5, size), (4 * size, size, 1), frames.storage_offset() + 2 * size)
        xy, yx = (mounted[:, k : k + 2].view(count, 2, 3, width).unbind(0) for k in (2, 3))
        at_zero = mounted.unbind(0)
        for index, (joint, mount) in enumerate(zip(self.joints, self._turning_mounts, strict=True)):
            torch.mm(mount, whole[joint.parent], out=at_zero[index])
            if joint.revolute:
                # x' = c·x + s·y and y' = c·y − s·x, both at once
                torch.mul(xy[index], cosines[index], out=turned[index]).addcmul_(yx[index], sines[index])
            else:
                turned[index].copy_(xy[index])
                frames[index, 3].addcmul_(frames[index, 2], values[index])
        index, mount = self.links[self.tool]
        torch.mm(mount, whole[index], out=whole[-2])
        return frames

    def tool_pose(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Tool position (3, N) [m] and rotation (3, 3, N): second index counts the tool's axes."""
        axes, position = frames[-2].split_with_sizes((3, 1))
        return position[0], axes.transpose(0, 1)

    def link_pose(self, frames: Tensor, link: str) -> Tensor:
        """Pose (4, 3, N) of a link: rows x, y, z, origin."""
        index, pose = self.links[link]
        return place(frames[index], pose)

    def jacobian(self, frames: Tensor) -> Tensor:
        """(6, n, N) geometric Jacobian of the tool: linear rows first, base frame.

        Column of a revolute joint: (z × (p_tool − p), z); of a prismatic one: (z, 0). 9 multiply-adds a column.
        """
        if are_few(frames) and not (torch.is_grad_enabled() and frames.requires_grad):
            return torch.from_numpy(self.few.jacobian(frames.detach().numpy()))
        lines = frames[: self.n] if self._plain_path else frames[list(self.path)]
        axes = lines[:, 2]
        # torch's own cross product takes three times as long
        ax, ay, az = axes.unbind(1)
        rx, ry, rz = (frames[-2, 3] - lines[:, 3]).unbind(1)
        rows = torch.stack([ay * rz - az * ry, az * rx - ax * rz, ax * ry - ay * rx, ax, ay, az])
        if self._plain_path and self._sliding is None:
            return rows
        if self._sliding is not None:
            slides = self._sliding[list(self.path)][:, None]
            linear, angular = rows.split(3)
            rows = torch.cat([torch.where(slides, angular, linear), torch.where(slides, 0.0, angular)])
        # ∂/∂q sums over the joints that q drives
        drive = rows.new_zeros(self.n, len(self.path))
        for k, i in enumerate(self.path):
            drive[self.joints[i].dof, k] = self.joints[i].multiplier
        return torch.einsum("dk,rkN->rdN", drive, rows)

    def _joint_values(self, q: Tensor) -> Tensor:
        """(J, N) values of the joints."""
        values = q.index_select(0, self._dofs)
        if self._mimic is None:
            return values
        multipliers, offsets = self._mimic
        return values * multipliers + offsets

    def _joint_gradient(self, gradient: Tensor) -> Tensor:
        """(n, N) from (J, N): each entry of q takes what its joints give."""
        drive = gradient.new_zeros(self.n, len(self.joints))
        for index, joint in enumerate(self.joints):
            drive[joint.dof, index] = joint.multiplier
        return drive @ gradient

    @cached_property
    def _carried(self) -> Tensor:
        """(J, F) ones where a frame moves with a joint."""
        carried = torch.zeros(len(self.joints) + 2, len(self.joints) + 2)
        for index, parent in enumerate([joint.parent for joint in self.joints] + [self.links[self.tool][0]]):
            carried[:, index] = carried[:, parent]
            carried[index, index] = 1.0
        return carried[: len(self.joints)].to(self.mounts[0])

    @cached_property
    def _plain_path(self) -> bool:
        """Whether frame i of the path is frame i of the tree and follows q[i]."""
        figures = [(i, self.joints[i].dof, self.joints[i].multiplier) for i in self.path]
        return figures == [(i, i, 1.0) for i in range(self.n)]

    @cached_property
    def _turning_mounts(self) -> tuple[Tensor, ...]:
        """Mounts as (5, 4): rows z, origin, x, y, x."""
        return tuple(mount[[2, 3, 0, 1, 0]] for mount in self.mounts)

    @cached_property
    def _sliding(self) -> Tensor | None:
        """(F,) frames of joints that slide; None if none does."""
        sliding = [not joint.revolute for joint in self.joints]
        return torch.tensor([*sliding, False, False], device=self.mounts[0].device) if any(sliding) else None

    @cached_property
    def _mimic(self) -> tuple[Tensor, Tensor] | None:
        """(J, 1) multipliers and offsets of joint values; None if they are those of q."""
        figures = [(joint.multiplier, joint.offset) for joint in self.joints]
        if all(figure == (1.0, 0.0) for figure in figures):
            return None
        multipliers, offsets = self.mounts[0].new_tensor(figures).T[..., None]
        return multipliers, offsets

    @cached_property
    def few(self) -> FewKinematics:
        """The same for a few configurations on the CPU."""
        return FewKinematics(self)

    @cached_property
    def _dofs(self) -> Tensor:
        """(J,) the entry of q that drives each joint."""
        return torch.tensor([joint.dof for joint in self.joints], device=self.mounts[0].device)


def place(frame: Tensor, points: Tensor) -> Tensor:
    """Base-frame positions (S, 3, N) of points given as (S, 4) homogeneous coordinates in a frame (4, 3, N)."""
    width = frame.shape[2]
    return torch.mm(points, frame.reshape(4, 3 * width)).view(len(points), 3, width)


class _Frames(torch.autograd.Function):
    """`KinematicTree.frames` with its derivative by virtual work, itself differentiable.

    A gradient on the axes and origins of a frame is a force and a moment on it; each joint answers for those on all
    that it carries, along its axis.
    """

    @staticmethod
    def forward(ctx: Any, q: Tensor, tree: KinematicTree) -> Tensor:
        frames = tree.frames(q)
        ctx.tree = tree
        ctx.save_for_backward(frames)
        return frames

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (frames,), (gradient,), tree = ctx.saved_tensors, gradients, ctx.tree
        moments = torch.linalg.cross(frames, gradient, dim=2).sum(1)
        moments, forces = (torch.einsum("jf,fkN->jkN", tree._carried, part) for part in (moments, gradient[:, 3]))
        axes, origins = frames[:-2, 2], frames[:-2, 3]
        turning = (axes * (moments - torch.linalg.cross(origins, forces, dim=1))).sum(1)
        if tree._sliding is not None:
            turning = torch.where(tree._sliding[:-2, None], (axes * forces).sum(1), turning)
        return tree._joint_gradient(turning), None
