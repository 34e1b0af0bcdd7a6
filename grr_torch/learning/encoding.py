"""What a network reads and writes in place of points and configurations."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap


class Encoding(nn.Module):
    """Points scaled to about [−1, 1], and configurations without the jump of a joint that turns on.

    A continuous joint is the pair (cos q, sin q); another one is scaled so that its limits are −1 and 1, or left as it
    is where it has none. An encoded configuration holds, in the joints' order, the cosines or scaled values, and
    behind them the sines of the continuous joints.

    Attributes:
        continuous: For each of the n joints whether it is a pair.
        width: Entries of an encoded configuration: n, and one more for each continuous joint.
        centre: (d,) the point that becomes 0 [m].
        scale: () what becomes 1 [m].
        middle: (n,) values that become 0; 0 for continuous joints.
        reach: (n,) what becomes 1; 1 for continuous joints.
    """

    centre: Tensor
    scale: Tensor
    middle: Tensor
    reach: Tensor

    def __init__(self, continuous: Sequence[bool], dimension: int) -> None:
        """An encoding that scales nothing yet: `of` makes a roadmap's, and a saved state replaces the figures.

        Args:
            continuous: For each of the n joints whether it is continuous.
            dimension: Entries of a point.
        """
        super().__init__()
        self.continuous = tuple(bool(wraps) for wraps in continuous)
        self.width = len(self.continuous) + sum(self.continuous)
        self.register_buffer("centre", torch.zeros(dimension))
        self.register_buffer("scale", torch.ones(()))
        self.register_buffer("middle", torch.zeros(len(self.continuous)))
        self.register_buffer("reach", torch.ones(len(self.continuous)))

    @staticmethod
    def of(roadmap: Roadmap) -> Encoding:
        """The encoding of a roadmap's resolved points and its robot's joints, in float64."""
        robot = roadmap.robot
        encoding = Encoding(robot.continuous.tolist(), roadmap.task.width).double()
        points = roadmap.points[roadmap.resolved]
        low, high = points.amin(0), points.amax(0)
        encoding.centre.copy_(0.5 * (low + high))
        encoding.scale.copy_(0.5 * (high - low).amax())
        lower, upper = robot.lower.cpu().double(), robot.upper.cpu().double()
        scaled = lower.isfinite() & upper.isfinite() & (upper > lower) & ~robot.continuous.cpu()
        encoding.middle.copy_(torch.where(scaled, 0.5 * (lower + upper), 0.0))
        encoding.reach.copy_(torch.where(scaled, 0.5 * (upper - lower), 1.0))
        return encoding

    def normalise(self, points: Tensor) -> Tensor:
        """What a network reads (*batch, d) for points (*batch, d) [m]."""
        return (points - self.centre) / self.scale

    def encode(self, configurations: Tensor) -> Tensor:
        """(*batch, width) for configurations (*batch, n) [rad or m]."""
        q, pairs = configurations, list(self._pairs)
        first = torch.where(torch.tensor(self.continuous, device=q.device), q.cos(), (q - self.middle) / self.reach)
        return torch.cat([first, q[..., pairs].sin()], dim=-1)

    def decode(self, encoded: Tensor) -> Tensor:
        """Configurations (*batch, n) from (*batch, width); continuous joints in [−π, π].

        A pair counts by its direction alone, whatever its length.
        """
        n = len(self.continuous)
        values = encoded[..., :n] * self.reach + self.middle
        if not self._pairs:
            return values
        angles = torch.atan2(encoded[..., n:], values[..., list(self._pairs)])
        return torch.cat([values, angles], dim=-1)[..., self._order]

    @cached_property
    def _pairs(self) -> tuple[int, ...]:
        """The continuous joints."""
        return tuple(joint for joint, wraps in enumerate(self.continuous) if wraps)

    @cached_property
    def _order(self) -> list[int]:
        """Where each joint stands in the scaled values with the angles behind them."""
        n, rank = len(self.continuous), {joint: k for k, joint in enumerate(self._pairs)}
        return [n + rank[joint] if joint in rank else joint for joint in range(n)]
