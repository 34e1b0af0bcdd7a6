"""How a network is trained, and how far its training is."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

from grr_torch.errors import ParameterError, check_seed, check_whole
from grr_torch.learning.network import Architecture
from grr_torch.learning.split import Split


@dataclass(frozen=True)
class TrainingOptions:
    """How a network is trained.

    Attributes:
        samples: Points drawn and solved, those for validation and test among them.
        epochs: Times that each training sample is seen.
        batch: Samples of a step.
        learning_rate: Of Adam, at its highest; it falls along a cosine to a thousandth.
        joint_weight: Of the loss in joint space. At 0 the map's configurations do not count.
        pose_weight: Of the tool's part. At 0 it is the configurations alone that count.
        patience: Epochs without a better validation loss after which training stops.
        seed: Of samples, split, weights and batches.
        split: Training, validation and test; None: by region, of the same seed.
        architecture: How large the network is.
    """

    samples: int = 500_000
    epochs: int = 80
    batch: int = 2048
    learning_rate: float = 3e-3
    joint_weight: float = 1.0
    pose_weight: float = 1.0
    patience: int = 30
    seed: int = 0
    split: Split | None = None
    architecture: Architecture = field(default_factory=Architecture)

    def __post_init__(self) -> None:
        for name in ("samples", "epochs", "batch", "patience"):
            object.__setattr__(self, name, check_whole(name, getattr(self, name), 1))
        if not 0.0 < self.learning_rate < math.inf:
            raise ParameterError("learning rate", self.learning_rate, "above 0 and finite")
        for name in ("joint_weight", "pose_weight"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ParameterError(name.replace("_", " "), getattr(self, name), "0 or more and finite")
        if self.joint_weight == self.pose_weight == 0.0:
            raise ParameterError("joint weight and pose weight", "both 0", "at least one of them above 0")
        object.__setattr__(self, "seed", check_seed(self.seed))

    def parted(self) -> Split:
        """The split that is meant."""
        return self.split or Split(seed=self.seed)

    def to_dict(self) -> dict[str, Any]:
        """For metadata."""
        return {**asdict(self), "split": self.parted().to_dict()}


@dataclass(frozen=True)
class Epoch:
    """How far training is.

    Attributes:
        epoch: Epochs done.
        epochs: Epochs in all.
        loss: Mean training loss of the last one.
        validation: Mean validation loss, the pose's part whole.
        millimetres: Mean position error on the validation part [mm].
        degrees: Mean rotation error there [°].
        best: The epoch with the least validation loss so far.
        seconds: Since training began, or was taken up again.
        seconds_left: Until the last epoch is done.
    """

    epoch: int
    epochs: int
    loss: float
    validation: float
    millimetres: float
    degrees: float
    best: int
    seconds: float
    seconds_left: float
