"""A roadmap as a data set: points and the one configuration that the map gives each of them."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.utils.data import Dataset

from grr_torch.errors import ParameterError, UnknownNameError
from grr_torch.learning.encoding import Encoding
from grr_torch.learning.sample import check_learnable, draw_samples
from grr_torch.learning.split import SPLITS, Split
from grr_torch.progress import Progress, silent
from grr_torch.resolution.roadmap_file import roadmap_hash

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap


class RoadmapDataset(Dataset[tuple[Tensor, Tensor]]):
    """Inputs and targets of a network that learns a roadmap.

    An item is a normalised point (d,) and an encoded configuration (width,), both float32; `encoding` gives back
    metres and radians. Samples are the map's vertices, or points drawn uniformly in its certified cells and solved;
    those that the map does not solve are left out.

    Attributes:
        encoding: `Encoding`, in float64: normalise, encode and decode.
        points: (N, d) [m].
        configurations: (N, n) [rad or m].
        split: (N,) uint8, indices into ("train", "validation", "test").
        inputs: (N, d) float32.
        targets: (N, width) float32.
        roadmap_hash: SHA-256 of the roadmap's tensors.
    """

    def __init__(
        self,
        roadmap: Roadmap,
        samples: int | None = None,
        *,
        split: Split | None = None,
        seed: int = 0,
        progress: Progress = silent,
    ) -> None:
        """Takes or draws the samples.

        Args:
            roadmap: The roadmap.
            samples: How many points to draw; None: the resolved vertices.
            split: Training, validation and test; by default by region, a tenth each for validation and test.
            seed: Of the points.
            progress: Told how many points are solved.

        Raises:
            ParameterError: No vertex is resolved, no cell is certified, or a number is not valid.
        """
        check_learnable(roadmap)
        self.roadmap_hash = roadmap_hash(roadmap)
        split = split or Split(seed=seed)
        if samples is None:
            if not bool(roadmap.resolved.any()):
                raise ParameterError("roadmap", "one without a resolved vertex", "one with resolved vertices")
            points, q = roadmap.points[roadmap.resolved], roadmap.configurations[roadmap.resolved]
            parts = split.of(roadmap)(points)
        else:
            pieces = list(draw_samples(roadmap, samples, split, seed=seed, progress=progress))
            points, q, parts = (
                torch.cat([getattr(piece, name)[piece.valid] for piece in pieces])
                for name in ("points", "configurations", "split")
            )
        self.encoding = Encoding.of(roadmap)
        self.points, self.configurations, self.split = points, q.to(points), parts
        self.inputs = self.encoding.normalise(self.points).float()
        self.targets = self.encoding.encode(self.configurations).float()

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index: Any) -> tuple[Tensor, Tensor]:
        """Inputs and targets of a sample, or of as many as a slice or tensor of indices takes."""
        return self.inputs[index], self.targets[index]

    def indices(self, part: str) -> Tensor:
        """(M,) the samples of "train", "validation" or "test".

        Raises:
            UnknownNameError: No such part.
        """
        if part not in SPLITS:
            raise UnknownNameError("part", part, SPLITS)
        return (self.split == SPLITS.index(part)).nonzero()[:, 0]

    def relabelled(self, configurations: Tensor, valid: Tensor) -> RoadmapDataset:
        """The same points and split with other configurations (N, n); those that are not valid (N,) are left out."""
        other = copy.copy(self)
        other.points, other.split, other.inputs = self.points[valid], self.split[valid], self.inputs[valid]
        other.configurations = configurations[valid]
        other.targets = self.encoding.encode(other.configurations).float()
        return other

    def encode(self, configurations: Tensor) -> Tensor:
        """Encoded (*batch, width) of configurations (*batch, n) [rad or m]."""
        return self.encoding.encode(configurations)

    def decode(self, encoded: Tensor) -> Tensor:
        """Configurations (*batch, n) of encoded ones (*batch, width)."""
        return self.encoding.decode(encoded)
