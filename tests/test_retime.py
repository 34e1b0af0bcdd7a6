"""Times of waypoints against profiles that are known."""

from __future__ import annotations

import pytest
import torch

from grr_torch.applications.retime import accelerations, retime


def test_a_straight_line_takes_the_time_of_a_trapezoidal_profile():
    q = torch.linspace(0.0, 3.0, 121, dtype=torch.float64)[:, None] * torch.tensor([1.0, -0.4], dtype=torch.float64)
    speed, acceleration = torch.tensor([1.5, 1.5]).double(), torch.tensor([2.0, 4.0]).double()
    times = retime(q, speed, acceleration)
    assert times[-1].item() == pytest.approx(3.0 / 1.5 + 1.5 / 2.0, rel=1e-3)
    assert retime(q, speed)[-1].item() == pytest.approx(2.0)
    two = retime(q[[0, -1]], speed, acceleration)
    assert bool((accelerations(q[[0, -1]], two).abs() <= acceleration * (1.0 + 1e-6)).all())
