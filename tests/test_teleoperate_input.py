"""Input that teleoperation refuses, and the clutch."""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from teleoperated import some_vertices

import grr_torch
from grr_torch.applications.teleoperate import Teleoperator
from grr_torch.errors import GrrWarning, ParameterError


@pytest.fixture(scope="module")
def roadmap(kinova_roadmap) -> grr_torch.Roadmap:
    return kinova_roadmap


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_target_that_is_not_finite_is_refused_and_held(roadmap, bad):
    vertices = some_vertices(roadmap, 2, 1)
    teleoperator = Teleoperator(roadmap, start=roadmap.configurations[vertices])
    target = roadmap.points[vertices].clone()
    target[0, 1] = bad
    before = teleoperator.configuration
    command = teleoperator.step(target)
    assert command.status.tolist() == ["holding", "tracking"]
    assert torch.equal(command.configuration[0], before[0])
    assert bool(command.configuration.isfinite().all())


def test_a_far_jump_is_refused_until_reset(roadmap):
    first, second = some_vertices(roadmap, 2, 2)
    teleoperator = Teleoperator(roadmap, start=roadmap.configurations[first], max_jump=0.05)
    assert teleoperator.step(roadmap.points[first]).status == "tracking"
    held = teleoperator.step(roadmap.points[second])
    assert held.status == "holding"
    assert torch.equal(teleoperator.step(roadmap.points[second]).configuration, held.configuration)
    teleoperator.reset()
    assert teleoperator.step(roadmap.points[second]).status != "holding"


def test_old_input_is_refused(roadmap):
    vertex = some_vertices(roadmap, 1, 4)[0]
    teleoperator = Teleoperator(roadmap, start=roadmap.configurations[vertex], timeout=0.1)
    point = roadmap.points[vertex]
    for step in range(10):
        assert teleoperator.step(point, time=1000.0 + 0.02 * step).status == "tracking"
    stale = [str(teleoperator.step(point, time=1000.18).status) for _ in range(10)]
    assert stale[0] == "tracking"
    assert stale[-1] == "holding"
    assert teleoperator.step(point, time=float("nan")).status == "holding"
    teleoperator.reset()
    assert teleoperator.step(point, time=5.0).status == "tracking"


@pytest.mark.parametrize("fast", [1.02, 1.0, 0.9])
def test_clocks_that_differ_a_little_make_no_input_old(roadmap, fast):
    vertex = some_vertices(roadmap, 1, 4)[0]
    teleoperator = Teleoperator(roadmap, start=roadmap.configurations[vertex], timeout=0.1)
    for step in range(1500):
        assert teleoperator.step(roadmap.points[vertex], time=0.02 * step / fast).status == "tracking"


def test_a_delay_that_grows_is_noticed_and_fresh_input_is_taken_again(roadmap):
    vertex = some_vertices(roadmap, 1, 4)[0]
    teleoperator = Teleoperator(roadmap, start=roadmap.configurations[vertex], timeout=0.1)
    growing = [str(teleoperator.step(roadmap.points[vertex], time=0.9 * 0.02 * step).status) for step in range(200)]
    assert growing[0] == "tracking"
    assert growing[-1] == "holding"
    fresh = [str(teleoperator.step(roadmap.points[vertex], time=0.02 * (200 + step)).status) for step in range(5)]
    assert fresh[1:] == 4 * ["tracking"]


def test_one_stamp_from_the_future_makes_the_others_not_old(roadmap):
    vertex = some_vertices(roadmap, 1, 4)[0]
    teleoperator = Teleoperator(roadmap, start=roadmap.configurations[vertex], timeout=0.1)
    stamps = [0.02 * step for step in range(40)]
    stamps[20] = 3600.0
    found = [str(teleoperator.step(roadmap.points[vertex], time=stamp).status) for stamp in stamps]
    assert [k for k, status in enumerate(found) if status != "tracking"] == [20]
    # a clock that was put forward is believed the second time, and what is given by the old one is old
    later = [str(teleoperator.step(roadmap.points[vertex], time=50.0 + 0.02 * step).status) for step in range(10)]
    assert later == ["holding"] + 9 * ["tracking"]
    assert teleoperator.step(roadmap.points[vertex], time=1.0).status == "holding"


def test_after_the_clutch_it_starts_where_the_arm_is(roadmap):
    first, second = some_vertices(roadmap, 2, 6)
    teleoperator = Teleoperator(roadmap, start=roadmap.configurations[first])
    teleoperator.step(roadmap.points[first])
    teleoperator.reset(roadmap.configurations[second])
    command = teleoperator.step(roadmap.points[second])
    assert torch.allclose(command.configuration, roadmap.configurations[second], atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        ({"rate": 0.0}, "rate"),
        ({"rate": float("nan")}, "rate"),
        ({"rate": 1e9}, "rate: got 1000000000.0; valid: above 0 and up to"),
        ({"max_step": -0.1}, "max_step"),
        ({"max_step": torch.ones(3)}, "max_step"),
        ({"acceleration_limits": 0.0}, "acceleration_limits"),
        ({"max_jump": 0.0}, "max_jump"),
        ({"foresight": -0.1}, "foresight"),
        ({"foresight": math.nan}, "foresight"),
        ({"foresight": math.inf}, "foresight"),
        ({"timeout": -1.0}, "timeout"),
        ({"start": torch.zeros(6)}, "shape"),
        ({"start": torch.full((7,), float("nan"))}, "finite"),
    ],
)
def test_bad_parameters_are_refused(roadmap, arguments, what):
    with pytest.raises(ParameterError, match=what):
        Teleoperator(roadmap, **arguments)


def test_a_start_that_is_likely_to_be_in_degrees_is_warned_of_and_goes_back_all_the_same(roadmap):
    degrees = torch.tensor([0.0, 30.0, 0.0, -60.0, 0.0, 30.0, 0.0], dtype=torch.float64)
    with pytest.warns(GrrWarning, match="beyond its limits: is it in degrees"):
        teleoperator = Teleoperator(roadmap, start=degrees)
    moved = teleoperator.step(roadmap.points[some_vertices(roadmap, 1)[0]]).configuration
    assert float((moved - degrees).abs().max()) <= float(roadmap.robot.velocity_limits.max()) / 50.0 + 1e-9
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Teleoperator(roadmap, start=torch.deg2rad(degrees))


def test_what_is_no_roadmap_is_refused():
    with pytest.raises(ParameterError, match=r"roadmap: got 'kinova.grr'; valid: a Roadmap, such as"):
        Teleoperator("kinova.grr")


def test_a_first_target_that_is_not_valid_is_refused_where_nobody_knows_where_the_arm_is(roadmap):
    with pytest.raises(ParameterError, match="first target: got NaN"):
        Teleoperator(roadmap).step(torch.full((3,), math.nan))


@pytest.mark.parametrize("target", [torch.zeros(2), torch.zeros(5, 3), [0.1, 0.2, 0.3], torch.tensor(0.5)])
def test_targets_of_another_shape_are_refused(roadmap, target):
    teleoperator = Teleoperator(roadmap, start=roadmap.configurations[some_vertices(roadmap, 1)[0]])
    with pytest.raises(ParameterError, match="target"):
        teleoperator.step(target)


def test_no_arms_are_no_error_and_starts_may_have_gradients(roadmap):
    nobody = Teleoperator(roadmap, start=torch.zeros(0, 7, dtype=torch.float64))
    command = nobody.step(torch.zeros(0, 3, dtype=torch.float64))
    assert command.configuration.shape == (0, 7)
    assert command.status.shape == (0,)
    start = roadmap.configurations[some_vertices(roadmap, 1)].requires_grad_()
    assert not Teleoperator(roadmap, start=start).step(torch.zeros(1, 3)).configuration.requires_grad
