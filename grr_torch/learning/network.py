"""The network: from points straight to configurations, with its encoding inside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import silu

from grr_torch.errors import check_whole
from grr_torch.learning.encoding import Encoding

# standard deviation of the waves' first wave numbers, where the roadmap's longest side is 2
_WAVE_NUMBER = 1.8


@dataclass(frozen=True)
class Architecture:
    """How large a network is.

    Attributes:
        width: Units of a hidden layer.
        depth: Hidden layers.
        waves: Learned waves of which sine and cosine stand beside the coordinates.
    """

    width: int = 128
    depth: int = 3
    waves: int = 32

    def __post_init__(self) -> None:
        for name, least in (("width", 1), ("depth", 1), ("waves", 0)):
            object.__setattr__(self, name, check_whole(name, getattr(self, name), least, 1 << 14))

    def to_dict(self) -> dict[str, Any]:
        """For metadata."""
        return asdict(self)


class IkNetwork(nn.Module):
    """A multilayer perceptron over the coordinates and learned waves of them.

    Its input is points (N, d) [m], its output configurations (N, n) [rad or m], both float32: normalising and decoding
    are part of it. It is smooth in the points, so that near points get near configurations.
    """

    def __init__(self, continuous: Sequence[bool], dimension: int, architecture: Architecture) -> None:
        """A network with weights drawn from torch's generator, and an encoding that is yet to be loaded.

        Args:
            continuous: For each joint whether it is continuous.
            dimension: Entries of a point.
            architecture: How large it is.
        """
        super().__init__()
        self.architecture = architecture
        self.encoding = Encoding(continuous, dimension)
        width = architecture.width
        self.waves = nn.Linear(dimension, architecture.waves, bias=False)
        nn.init.normal_(self.waves.weight, std=_WAVE_NUMBER)
        self.first = nn.Linear(dimension + 2 * architecture.waves, width)
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in range(architecture.depth - 1))
        self.last = nn.Linear(width, self.encoding.width)

    def forward(self, points: Tensor) -> Tensor:
        """Configurations (N, n) of points (N, d); continuous joints in [−π, π]."""
        return self.encoding.decode(self.encoded(self.encoding.normalise(points)))

    def encoded(self, inputs: Tensor) -> Tensor:
        """Encoded configurations (N, width) of normalised points (N, d)."""
        phases = self.waves(inputs)
        # in place, a third less time goes into memory; but a gradient needs what would be overwritten
        in_place = not torch.is_grad_enabled()
        x = silu(self.first(torch.cat([inputs, phases.sin(), phases.cos()], dim=-1)), inplace=in_place)
        for layer in self.hidden:
            x = silu(layer(x), inplace=in_place)
        return self.last(x)
