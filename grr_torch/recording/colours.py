"""Colours for points and edges."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Colours = npt.NDArray[np.uint8]

CONNECTED = (41, 47, 58, 255)
BROKEN = (235, 70, 50, 255)
WOUND = (225, 60, 190, 150)
SPREAD = (240, 150, 40, 110)
UNRESOLVED = (255, 176, 0, 255)
GRID = (40, 43, 50, 255)
TOUR = (235, 235, 235, 255)
# of a teleoperation
STATUS = {
    "tracking": (70, 200, 120),
    "detouring": (70, 150, 255),
    "holding": (245, 175, 50),
    "unreachable": (240, 85, 75),
}

# dark blue over green to yellow, of about even steps in lightness
_SCALE = np.array([[59, 28, 92], [52, 94, 141], [33, 145, 140], [94, 201, 98], [253, 231, 37]], dtype=np.float64)


def scale(values: Array) -> Colours:
    """Colours (N, 3) of values between their smallest and largest."""
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    share = (values - low) / max(high - low, 1e-12) * (len(_SCALE) - 1)
    return np.stack([np.interp(share, np.arange(len(_SCALE)), _SCALE[:, c]) for c in range(3)], axis=1).astype(np.uint8)


def circle(angles: Array) -> Colours:
    """Colours (N, 3) of angles [rad] that run once round the hues."""
    shifts = angles[:, None] - np.array([0.0, 2.0, 4.0]) * np.pi / 3.0
    return (255.0 * (0.55 + 0.4 * np.cos(shifts))).astype(np.uint8)
