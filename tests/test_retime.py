"""Times of waypoints against profiles that are known."""

from __future__ import annotations

import pytest
import torch

from grr_torch.applications.retime import accelerations, per_joint, retime
from grr_torch.errors import ParameterError


def test_a_straight_line_takes_the_time_of_a_trapezoidal_profile():
    q = torch.linspace(0.0, 3.0, 121, dtype=torch.float64)[:, None] * torch.tensor([1.0, -0.4], dtype=torch.float64)
    speed, acceleration = torch.tensor([1.5, 1.5]).double(), torch.tensor([2.0, 4.0]).double()
    times = retime(q, speed, acceleration)
    assert times[-1].item() == pytest.approx(3.0 / 1.5 + 1.5 / 2.0, rel=1e-3)
    assert retime(q, speed)[-1].item() == pytest.approx(2.0)
    two = retime(q[[0, -1]], speed, acceleration)
    assert bool((accelerations(q[[0, -1]], two).abs() <= acceleration * (1.0 + 1e-6)).all())


def test_times_grow_as_limits_shrink_by_the_same_law_everywhere():
    """With accelerations alone, times go with one over the root of the limit, however small that is."""
    generator = torch.Generator().manual_seed(0)
    q = torch.randn(80, 3, dtype=torch.float64, generator=generator).cumsum(0)
    fast, one = torch.full((3,), 1e4).double(), torch.ones(3).double()
    known = float(retime(q, fast, one)[-1])
    for limit in (1e-2, 1e-5, 1e-9):
        assert float(retime(q, fast, limit * one)[-1]) == pytest.approx(known / limit**0.5, rel=1e-3)


def test_limits_that_no_joint_has_are_refused():
    for wrong in (0.0, -1.0, 1e-300, float("nan")):
        with pytest.raises(ParameterError, match="one finite number, 1e-09 or more"):
            per_joint("velocity_limits", wrong, torch.zeros(3))
