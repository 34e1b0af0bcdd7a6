"""Three axes to show configurations on: the joints of an arm with three, the principal directions of others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from grr_torch.recording.colours import Array
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import embed, wrap


@dataclass(frozen=True)
class Chart:
    """A map from configurations to points of space.

    Attributes:
        robot: The robot.
        names: What the three axes are.
        centre: Joint values (3,) in whose middle turn continuous joints are shown, or the mean of the embedding.
        directions: (2n, 3) principal directions of the embedding; None where the joints are the axes.
    """

    robot: Robot
    names: tuple[str, str, str]
    centre: Tensor
    directions: Tensor | None

    @staticmethod
    def of(robot: Robot, configurations: Tensor) -> Chart:
        """A chart in which configurations (S, n) are spread well."""
        turns = robot.continuous.cpu()
        if robot.n == 3:
            first, second, third = robot.joint_names
            middle = torch.where(turns, _opposite_of_the_largest_gap(configurations), 0.0)
            return Chart(robot, (first, second, third), middle, None)
        rows = embed(configurations, turns)
        centre = rows.mean(0)
        _, sizes, directions = torch.linalg.svd(rows - centre, full_matrices=False)
        shares = (100.0 * sizes[:3].square() / sizes.square().sum().clamp_min(1e-12)).tolist()
        first, second, third = (f"principal direction {k + 1} ({share:.0f} %)" for k, share in enumerate(shares))
        return Chart(robot, (first, second, third), centre, directions[:3].T)

    def place(self, configurations: Tensor) -> Array:
        """Points (S, 3) of configurations (S, n)."""
        turns = self.robot.continuous.cpu()
        if self.directions is None:
            shown = torch.where(turns, self.centre + wrap(configurations - self.centre), configurations)
        else:
            shown = (embed(configurations, turns) - self.centre) @ self.directions
        return shown.numpy().astype(np.float64)

    def segments(self, starts: Tensor, ends: Tensor) -> Array:
        """Lines (K, 2, 3) from configurations (E, n) to others near them; those that leave the chart are left out."""
        a, b = self.place(starts), self.place(ends)
        lines = np.stack([a, b], axis=1)
        return lines if self.directions is not None else lines[(np.abs(b - a) < np.pi).all(1)]


def _opposite_of_the_largest_gap(configurations: Tensor) -> Tensor:
    """(n,) angles farthest from what no configuration (S, n) comes near: a turn round them cuts least."""
    values = configurations.sort(dim=0).values
    gap, before = (torch.cat([values[1:], values[:1] + 2.0 * torch.pi]) - values).max(0)
    return wrap(values.gather(0, before[None])[0] + 0.5 * gap + torch.pi)
