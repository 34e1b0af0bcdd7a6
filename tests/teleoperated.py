"""What tests of teleoperation share."""

from __future__ import annotations

import numpy as np
import torch

import grr_torch
from grr_torch import Teleoperator

# the most that a joint moves in a step, as in the paper's experiment [rad]
STEP = 0.04


def some_vertices(roadmap: grr_torch.Roadmap, count: int, seed: int = 0) -> torch.Tensor:
    """Resolved vertices, drawn at random."""
    resolved = roadmap.resolved.nonzero()[:, 0]
    order = torch.randperm(len(resolved), generator=torch.Generator().manual_seed(seed))
    return resolved[order[:count]]


def follow_targets(teleoperator: Teleoperator, targets: torch.Tensor) -> tuple[torch.Tensor, np.ndarray]:
    commands = [teleoperator.step(target) for target in targets]
    return torch.stack([c.configuration for c in commands]), np.stack([c.status for c in commands])
