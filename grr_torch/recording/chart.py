"""Three joints of an arm as axes on which its configurations are shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from grr_torch.applications.self_motion import SelfMotionManifold
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import embed, wrap


@dataclass(frozen=True)
class Chart:
    """A map from configurations to points of space.

    Attributes:
        robot: The robot.
        joints: The three joints that are its axes.
        centres: (C, 3) values in whose middle turn continuous joints of each component are shown, 0 for others; one row
            for all components of several manifolds.
        low: (3,) where what is shown begins.
        high: (3,) where it ends.
    """

    robot: Robot
    joints: tuple[int, ...]
    centres: Tensor
    low: np.ndarray
    high: np.ndarray

    @staticmethod
    def of(manifolds: Sequence[SelfMotionManifold]) -> Chart:
        """The joints that move most, one that tells components apart, and the turns that cut least."""
        robot = manifolds[0].robot
        joints = _joints(manifolds)
        parts = [m.configurations[m.component == c] for m in manifolds for c in range(m.components)]
        groups = parts if len(manifolds) == 1 else [torch.cat(parts)]
        centres = torch.stack([_opposite_of_the_largest_gap(q[:, joints]) for q in groups])
        centres = torch.where(robot.continuous.cpu()[joints], centres, 0.0)
        chart = Chart(robot, tuple(joints), centres, np.empty(0), np.empty(0))
        shown = np.concatenate([chart.place(q, k) for k, q in enumerate(parts)])
        margin = 0.06 * float(np.ptp(shown, axis=0).max()) + 1e-3
        return Chart(robot, tuple(joints), centres, shown.min(0) - margin, shown.max(0) + margin)

    @property
    def names(self) -> list[str]:
        """Names of the three axes."""
        return [self.robot.joint_names[joint] for joint in self.joints]

    def place(self, configurations: Tensor, component: int) -> np.ndarray:
        """Points (S, 3) of configurations (S, n) of a component."""
        shown = configurations[:, list(self.joints)]
        turns = self.robot.continuous.cpu()[list(self.joints)]
        centre = self.centres[component % len(self.centres)]
        return torch.where(turns, centre + wrap(shown - centre), shown).numpy().astype(np.float64)

    def segments(self, starts: Tensor, ends: Tensor, component: int) -> np.ndarray:
        """Lines (K, 2, 3) from configurations (E, n) to others near them; those cut by the chart's end are left out."""
        a, b = self.place(starts, component), self.place(ends, component)
        return np.stack([a, b], axis=1)[(np.abs(b - a) < np.pi).all(1)]


def _joints(manifolds: Sequence[SelfMotionManifold]) -> list[int]:
    """Three joints: the two that move most within components, and of the others the one that differs most between."""
    robot = manifolds[0].robot
    if robot.n == 3:
        return [0, 1, 2]
    wide = torch.cat([manifold.ranges().diff(dim=2)[..., 0] for manifold in manifolds]).mean(0)
    chosen = wide.argsort(descending=True)[:2].tolist()
    rows = [
        embed(m.configurations[m.component == c], robot.continuous.cpu())
        for m in manifolds
        for c in range(m.components)
    ]
    within = torch.stack([part.var(0, correction=0) for part in rows]).mean(0)
    between = torch.stack([part.mean(0) for part in rows]).var(0, correction=0)
    within, between = (part[: robot.n] + part[robot.n :] for part in (within, between))
    apart = (between + 1e-6 * wide) / (within + 0.05)
    apart[chosen] = -1.0
    return sorted([*chosen, int(apart.argmax())])


def _opposite_of_the_largest_gap(values: Tensor) -> Tensor:
    """(k,) angles farthest from what no values (S, k) come near: a turn round them cuts least."""
    values = values.sort(dim=0).values
    gap, before = (torch.cat([values[1:], values[:1] + 2.0 * torch.pi]) - values).max(0)
    return wrap(values.gather(0, before[None])[0] + 0.5 * gap + torch.pi)
