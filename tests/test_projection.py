"""Projection: it arrives, near its guess, within limits; and says so where it does not."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from random_robots import random_urdf

import grr_torch
from grr_torch.errors import ParameterError
from grr_torch.projection.columns import damped_least_squares, damped_least_squares_of_few, solve_spd
from grr_torch.projection.project import Tolerances, project
from grr_torch.spaces.configuration import distance
from grr_torch.spaces.rotation import quaternion_from_matrix, rotation_error
from grr_torch.spaces.task import FixedRotation, Position

DOWN = FixedRotation(3, (-math.pi, 0.0, math.pi / 2))


@pytest.mark.parametrize("m", [1, 2, 3, 6])
@pytest.mark.parametrize("condition", [1e0, 1e4, 1e8])
def test_column_solver_agrees_with_torch_linalg(m, condition, generator):
    basis = torch.linalg.qr(torch.randn(50, m, m, dtype=torch.float64, generator=generator)).Q
    spectrum = torch.logspace(0, -math.log10(condition), m, dtype=torch.float64)
    matrix = basis @ (spectrum[:, None] * basis.transpose(1, 2))
    right = torch.randn(50, m, dtype=torch.float64, generator=generator)
    expected = torch.linalg.solve(matrix, right)
    found = solve_spd(matrix.permute(1, 2, 0).contiguous(), right.T[:, None])[:, 0].T
    # both are as accurate as the condition allows
    torch.testing.assert_close(found, expected, rtol=1e-14 * condition * 100, atol=1e-12 * condition)


@pytest.mark.parametrize("count", [0, 1, 2, 6, 7, 16, 20, 65])
@pytest.mark.parametrize("solve", ["tensors", "arrays"])
def test_damped_least_squares_is_the_regularised_minimum(generator, count, solve):
    jacobian = torch.randn(6, 7, count, dtype=torch.float64, generator=generator)
    jacobian[:, :, :1] = 0.0  # fully singular
    jacobian[3:, :, 1:2] = jacobian[:3, :, 1:2]  # rank 3
    error = torch.randn(6, count, dtype=torch.float64, generator=generator)
    damping = torch.rand(count, dtype=torch.float64, generator=generator) + 1e-3
    if solve == "tensors":
        step = damped_least_squares(jacobian, error, damping)
    else:
        arrays = (tensor.numpy().copy() for tensor in (jacobian, error, damping))
        step = torch.from_numpy(damped_least_squares_of_few(*arrays))
    assert step.shape == (7, count)
    for k in range(count):
        j, e = jacobian[:, :, k], error[:, k]
        expected = torch.linalg.solve(j.T @ j + damping[k] * torch.eye(7, dtype=torch.float64), j.T @ e)
        torch.testing.assert_close(step[:, k], expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("count", [1, 6, 7, 20])
def test_a_system_that_damping_does_not_mend_gives_nan_and_harms_no_other(generator, count):
    jacobian = torch.randn(6, 7, count, dtype=torch.float64, generator=generator)
    jacobian[:, :, 0] = 1e6  # equal rows beside which the damping is lost
    error = torch.randn(6, count, dtype=torch.float64, generator=generator)
    damping = torch.full((count,), 1e-7, dtype=torch.float64)
    step = damped_least_squares_of_few(*(tensor.numpy() for tensor in (jacobian, error, damping)))
    others = damped_least_squares(*(tensor[..., 1:] for tensor in (jacobian, error, damping)))
    assert np.allclose(step[:, 1:], others.numpy(), rtol=1e-6, atol=1e-9)
    assert np.isnan(step[:, 0]).all() or np.abs(step[:, 0]).max() < 1e-3


class AnyPose(Position):
    """Poses as rows of position and rotation matrix, to project to many rotations at once."""

    @property
    def constraints(self):
        return 6

    def rotation_error(self, targets, rotation):
        return rotation_error(targets[3:].reshape(3, 3, -1), rotation)


def test_random_kinova_poses_are_reached_from_a_third_of_a_radian(kinova, generator):
    from grr_torch.projection.project import project_columns

    wide = torch.where(kinova.lower.isfinite(), 0.9 * kinova.upper, math.pi)
    q = wide * (2.0 * torch.rand(4000, 7, dtype=torch.float64, generator=generator) - 1.0)
    guess = q + 0.3 * (2.0 * torch.rand(q.shape, dtype=torch.float64, generator=generator) - 1.0)
    position, rotation = kinova.forward_kinematics(q)
    targets = torch.cat([position.T, rotation.reshape(-1, 9).T])
    solved, valid = project_columns(kinova, AnyPose(3), targets, guess.T.contiguous(), check_collision=False)
    assert valid.double().mean() >= 0.995
    found_position, found_rotation = kinova.forward_kinematics(solved.T[valid])
    assert (found_position - position[valid]).norm(dim=1).max() <= 1e-4
    cosine = (quaternion_from_matrix(found_rotation) * quaternion_from_matrix(rotation[valid])).sum(1).abs()
    angle = 2.0 * torch.acos(cosine.clamp(max=1.0))
    assert angle.max() <= 1.1e-3
    assert bool(kinova.within_limits(solved.T[valid]).all())
    # it lands near its guess: hardly farther than the configuration that the pose came from
    moved = distance(guess[valid], solved.T[valid], kinova.continuous)
    assert (moved <= 1.5 * distance(guess, q, kinova.continuous)[valid]).double().mean() > 0.99


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1000))
def test_what_is_valid_is_there_and_within_limits_on_random_robots(tmp_path_factory, seed):
    path = tmp_path_factory.mktemp("urdf") / "random.urdf"
    path.write_text(random_urdf(np.random.default_rng(seed), 6, mimic=bool(seed % 2)))
    robot = grr_torch.load_robot(path, tool="tool")
    generator = torch.Generator().manual_seed(seed)
    points = robot.forward_kinematics(robot.sample(60, generator))[0]
    q, valid = project(robot, Position(3), points, robot.sample(60, generator))
    assert bool(q[~valid].isnan().all())
    assert bool(robot.within_limits(q[valid]).all())
    left = (robot.forward_kinematics(q[valid])[0] - points[valid]).norm(dim=1)
    assert bool((left <= 1e-4).all())


@pytest.mark.parametrize("together", [2, 7, 300, 1000])
def test_what_else_is_projected_changes_nothing(kinova, generator, together):
    """From far off, many steps meet limits; by arrays of a few at a time, and pieces of many."""
    points = kinova.forward_kinematics(kinova.sample(1000, generator))[0]
    guesses = kinova.sample(1000, generator)
    whole, valid = project(kinova, Position(3), points, guesses)
    pairs = zip(points.split(together), guesses.split(together), strict=True)
    parts = [project(kinova, Position(3), *pair) for pair in pairs]
    assert torch.equal(torch.cat([part[1] for part in parts]), valid)
    apart = distance(torch.cat([part[0] for part in parts])[valid], whole[valid], kinova.continuous)
    # but for the last digits, which Newton's method brings back where it converges
    assert float(apart.max()) < 1e-6


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (0,)])
def test_batch_axes_lead(planar_5, generator, batch):
    guesses = planar_5.sample(math.prod(batch), generator).reshape(*batch, 5)
    points = 0.2 * torch.ones(*batch, 2, dtype=torch.float64)
    q, valid = project(planar_5, Position(2), points, guesses)
    assert q.shape == guesses.shape
    assert valid.shape == batch


def test_the_straight_arm_is_left_in_every_direction(kinova):
    up = kinova.forward_kinematics(torch.zeros(7))[0]
    points = up + torch.tensor([[0, 0, -0.3], [0, 0, -1e-3], [0.2, 0, -0.3], [0, 0.3, -0.5]], dtype=torch.float64)
    q, valid = project(kinova, Position(3), points, torch.zeros(4, 7))
    assert bool(valid.all())
    assert bool(q.isfinite().all())


def test_a_configuration_already_there_is_not_moved(kinova, generator):
    q = kinova.sample(20, generator)
    found, valid = project(kinova, Position(3), kinova.forward_kinematics(q)[0], q, check_collision=False)
    assert bool(valid.all())
    assert distance(found, q, kinova.continuous).max() < 1e-12


def test_what_cannot_be_reached_is_invalid_and_nan(kinova):
    q, valid = project(kinova, DOWN, torch.tensor([[3.0, 0.0, 0.0], [0.5, 0.1, 0.2]]), torch.zeros(2, 7))
    assert valid.tolist() == [False, True]
    assert bool(q[0].isnan().all())


def test_a_colliding_result_is_invalid_unless_collisions_are_not_asked_about(kinova, generator):
    q = kinova.sample(3000, generator)
    q = q[kinova.in_self_collision(q)]
    points = kinova.forward_kinematics(q)[0]
    assert not bool(project(kinova, Position(3), points, q)[1].any())
    assert bool(project(kinova, Position(3), points, q, check_collision=False)[1].all())


def test_limits_hold_without_flipping(kinova, generator):
    """From guesses at the limits, the other joints take over: no joint leaps to the far side of its range."""
    q = kinova.sample(500, generator)
    limited = kinova.lower.isfinite()
    guess = torch.where(limited, 0.999 * kinova.upper * q.sign(), q)
    points = kinova.forward_kinematics(guess)[0] + 0.05 * torch.randn(500, 3, dtype=torch.float64, generator=generator)
    found, valid = project(kinova, Position(3), points, guess, check_collision=False)
    assert valid.double().mean() > 0.8
    assert bool(kinova.within_limits(found[valid]).all())
    moved = (found - guess)[valid][:, limited].abs()
    assert moved.quantile(0.99) < 1.0


@pytest.mark.parametrize(
    ("points", "guesses", "complaint"),
    [
        (torch.zeros(2, 2), torch.zeros(2, 7), "point shape"),
        (torch.zeros(2, 3), torch.zeros(2, 6), "configuration shape"),
        (torch.zeros(2, 3), torch.zeros(3, 7), "equal batch shapes"),
        (torch.full((2, 3), torch.nan), torch.zeros(2, 7), "points: got NaN"),
        (torch.zeros(2, 3), torch.full((2, 7), torch.inf), "guesses: got NaN or infinite"),
    ],
)
def test_bad_input_is_an_error(kinova, points, guesses, complaint):
    with pytest.raises(ParameterError, match=complaint):
        project(kinova, Position(3), points, guesses)


@pytest.mark.parametrize("field", [{"position": 0.0}, {"rotation": math.nan}, {"iterations": 0}])
def test_bad_tolerances_are_errors(field):
    with pytest.raises(ParameterError):
        Tolerances(**field)
