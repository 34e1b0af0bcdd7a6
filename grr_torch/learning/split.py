"""Which samples a network learns from, which choose the best network, and which it is tested on."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from grr_torch.errors import ParameterError, UnknownNameError, check_seed

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap

SPLITS = ("train", "validation", "test")
WAYS = ("region", "random")
# blocks that a roadmap's bounds are cut into at most
_MOST_BLOCKS = 10_000_000


@dataclass(frozen=True)
class Split:
    """How samples are parted into training, validation and test.

    By region, the task space is cut into cubes (squares in the plane), and each is of one part as a whole, so that
    no test point has training points next to it but those at the side of its block. Unless given, a block is as long
    as the task graph's edges, about a cell. The test then says what a network makes of cells of which it has seen
    nothing, between others that it knows; it says nothing of what lies beyond all that it knows.

    At random, each sample is of a part by itself, and has training points next to it.

    Attributes:
        way: "region" or "random".
        validation: Share of blocks, or of samples, that choose the best network.
        test: Share that the network is tested on.
        block: Edge of a block [m]; None: the median edge of the task graph.
        seed: Of the draw.
    """

    way: str = "region"
    validation: float = 0.1
    test: float = 0.1
    block: float | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.way not in WAYS:
            raise UnknownNameError("split", self.way, WAYS)
        for name in ("validation", "test"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ParameterError(f"{name} share", getattr(self, name), "0 or more and below 1")
        if not self.validation + self.test < 1.0:
            raise ParameterError("validation and test shares", (self.validation, self.test), "less than 1 together")
        if self.block is not None and not 0.0 < self.block < math.inf:
            raise ParameterError("block", self.block, "above 0, in metres")
        if self.block is not None and self.way != "region":
            raise ParameterError("block", self.block, f"none for a split that is {self.way}")
        object.__setattr__(self, "seed", check_seed(self.seed))

    def of(self, roadmap: Roadmap) -> Splitter:
        """The parting of a roadmap's task space.

        Raises:
            ParameterError: The blocks are too small, or there is no edge that says how large they should be.
        """
        return Splitter(self, roadmap)

    def to_dict(self) -> dict[str, Any]:
        """For metadata."""
        return asdict(self)


class Splitter:
    """A `Split` of a roadmap's bounds, the same for any points.

    Attributes:
        block: Edge of a block [m].
    """

    def __init__(self, split: Split, roadmap: Roadmap) -> None:
        points = roadmap.points[:, : roadmap.task.dimension]
        self._split, self._low = split, points.amin(0)
        lengths = (points[roadmap.edges[:, 0]] - points[roadmap.edges[:, 1]]).norm(dim=1)
        if split.block is None and len(lengths) == 0:
            raise ParameterError("block", "none for a roadmap without edges", "a length in metres")
        self.block = split.block or float(lengths.median())
        self._generator = torch.Generator().manual_seed(split.seed)
        self._counts = ((points.amax(0) - self._low) / self.block).floor().long() + 1
        if split.way == "region":
            if math.prod(self._counts.tolist()) > _MOST_BLOCKS:
                raise ParameterError("block", self.block, f"so long that there are {_MOST_BLOCKS:,} blocks at most")
            self._of_block = self._drawn(math.prod(self._counts.tolist()))

    def __call__(self, points: Tensor) -> Tensor:
        """(N,) indices into `SPLITS` for points (N, d); at random, new draws with every call."""
        if self._split.way == "random":
            return self._drawn(len(points))
        place = ((points[:, : len(self._low)] - self._low) / self.block).floor().long()
        place = torch.minimum(place.clamp_min(0), self._counts - 1)
        index = place[:, 0]
        for axis in range(1, place.shape[1]):
            index = index * self._counts[axis] + place[:, axis]
        return self._of_block[index]

    def _drawn(self, count: int) -> Tensor:
        """(count,) uint8 parts in their shares, to the nearest whole number, in random order."""
        test, validation = round(self._split.test * count), round(self._split.validation * count)
        parts = torch.zeros(count, dtype=torch.uint8)
        order = torch.randperm(count, generator=self._generator)
        parts[order[:test]] = SPLITS.index("test")
        parts[order[test : test + validation]] = SPLITS.index("validation")
        return parts
