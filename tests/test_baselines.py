"""Newton IK and Relaxed IK: never too fast, within limits, batched as one by one; they arrive where they can."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from random_robots import random_urdf

import grr_torch
from grr_torch.baselines.newton_ik import NewtonIk
from grr_torch.baselines.relaxed_ik import RelaxedIk, _bounded_step
from grr_torch.baselines.relaxed_objective import Past, RelaxedObjective, Weights, groove_loss
from grr_torch.errors import ParameterError
from grr_torch.spaces.task import FixedRotation, Position, make_task

STEP = 0.04
BOTH = pytest.mark.parametrize("kind", [NewtonIk, RelaxedIk])


@pytest.fixture(scope="module")
def down(kinova):
    return make_task("fixed-rotation", 3, kinova.preset.problems["fixed-rotation"].rotation)


@pytest.fixture(scope="module")
def starts(kinova, down):
    """Sixteen configurations with the gripper down."""
    seeds = torch.tensor(kinova.preset.problems["fixed-rotation"].seeds, dtype=torch.float64)
    found, valid = grr_torch.project(kinova, down, kinova.forward_kinematics(seeds)[0], seeds)
    assert bool(valid.all())
    return found


def random_robot(directory, seed: int) -> grr_torch.Robot:
    path = directory / f"{seed}.urdf"
    path.write_text(random_urdf(np.random.default_rng(seed), 6, mimic=seed % 2 == 1))
    return grr_torch.load_robot(path)


def random_task(seed: int) -> grr_torch.TaskSpace:
    return Position(3) if seed % 3 else FixedRotation(3, (0.3, -0.2, 0.5))


@BOTH
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 1000))
def test_steps_and_limits_are_kept_whatever_the_targets(kind, tmp_path_factory, seed):
    robot = random_robot(tmp_path_factory.mktemp("urdf"), seed)
    generator = torch.Generator().manual_seed(seed)
    most = 0.01 + 0.1 * torch.rand(robot.n, dtype=torch.float64, generator=generator)
    follower = kind(robot, random_task(seed), max_step=most)
    arms = robot.sample(12, generator)
    follower.reset(arms)
    scales = torch.tensor([0.0, 0.3, 1.0, 10.0, 1e6, 1e200], dtype=torch.float64).repeat(2)[:, None]
    for _ in range(10):
        moved = follower.step(scales * torch.randn(12, 3, dtype=torch.float64, generator=generator))
        assert bool(((moved - arms).abs() <= most + 1e-12).all())
        assert bool(robot.within_limits(moved).all())
        arms = moved


@BOTH
def test_an_arm_outside_its_limits_comes_back_no_faster(kind, kinova, down, starts):
    arms = starts[:1].clone()
    arms[0, 1] = float(kinova.upper[1]) + 0.1
    target = kinova.forward_kinematics(starts[:1])[0]
    follower = kind(kinova, down, max_step=STEP)
    follower.reset(arms)
    for _ in range(100):
        moved = follower.step(target)
        assert float((moved - arms).abs().max()) <= STEP + 1e-12
        assert float(moved[0, 1]) <= max(float(arms[0, 1]), float(kinova.upper[1]))
        arms = moved
    assert bool(kinova.within_limits(arms).all())


# what Relaxed IK gives up of a target for its other goals
@pytest.mark.parametrize(("kind", "metres", "radians"), [(NewtonIk, 1.001e-4, 1.001e-3), (RelaxedIk, 2e-3, 1e-2)])
def test_near_targets_are_reached(kind, metres, radians, kinova, down, starts, generator):
    offsets = 0.05 * torch.randn(len(starts), 3, dtype=torch.float64, generator=generator).clamp(-2.0, 2.0)
    targets = kinova.forward_kinematics(starts)[0] + offsets
    reachable = grr_torch.project(kinova, down, targets, starts)[1]
    assert int(reachable.sum()) >= 12
    follower = kind(kinova, down, max_step=STEP)
    follower.reset(starts)
    for _ in range(60):
        arms = follower.step(targets)
    position, rotation = kinova.forward_kinematics(arms[reachable])
    assert float((position - targets[reachable]).norm(dim=-1).max()) < metres
    error = down.rotation_error(targets.T, rotation.movedim(0, -1))
    assert float(error.norm(dim=0).max()) < radians


@BOTH
def test_planar_arms_follow_too(kind, planar_5):
    follower = kind(planar_5, Position(2), max_step=STEP)
    start = torch.linspace(0.2, 0.6, 5, dtype=torch.float64)
    follower.reset(start)
    target = planar_5.forward_kinematics(start + 0.1)[0][:2]
    for _ in range(30):
        q = follower.step(target)
    assert q.shape == (5,)
    assert float((planar_5.forward_kinematics(q)[0][:2] - target).norm()) < 3e-3


@BOTH
def test_targets_inside_the_base_do_not_lead_into_collision(kind, kinova, down, starts):
    follower = kind(kinova, down, max_step=STEP)
    follower.reset(starts)
    target = torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64).expand(len(starts), 3)
    for _ in range(40):
        assert not bool(kinova.with_margin(0.0).in_self_collision(follower.step(target)).any())


@BOTH
@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (0,)])
def test_batch_axes_lead(kind, batch, kinova, down, starts, generator):
    count = math.prod(batch)
    arms = starts[:count].reshape(*batch, 7)
    here = kinova.forward_kinematics(starts[:count])[0]
    targets = here + 0.1 * torch.randn(4, count, 3, dtype=torch.float64, generator=generator)
    together = kind(kinova, down, max_step=STEP)
    together.reset(arms)
    moved = [together.step(points.reshape(*batch, 3)) for points in targets]
    assert all(q.shape == (*batch, 7) for q in moved)
    for index in range(count):
        alone = kind(kinova, down, max_step=STEP)
        alone.reset(starts[index])
        for points, q in zip(targets, moved, strict=True):
            torch.testing.assert_close(alone.step(points[index]), q.reshape(-1, 7)[index], rtol=0, atol=1e-7)


def test_newton_stays_where_there_is_no_solution(kinova, down, starts):
    follower = NewtonIk(kinova, down, max_step=STEP)
    follower.reset(starts)
    assert torch.equal(follower.step(torch.full((len(starts), 3), 2.0)), starts)


def test_newton_goes_the_short_way_round_and_counts_turns(planar_5):
    start = torch.tensor([math.pi - 0.02, 0.5, 0.4, 0.3, 0.2], dtype=torch.float64)
    robot = replace(planar_5, continuous=torch.ones(5, dtype=torch.bool))
    robot = replace(robot, lower=torch.full_like(robot.lower, -math.inf), upper=torch.full_like(robot.upper, math.inf))
    follower = NewtonIk(robot, Position(2), max_step=STEP)
    follower.reset(start)
    radius = robot.forward_kinematics(start)[0][:2].norm()
    first = math.atan2(*robot.forward_kinematics(start)[0][:2].flip(0).tolist())
    for turn in torch.linspace(0.0, 0.5, 30, dtype=torch.float64):
        q = follower.step(radius * torch.stack([(first + turn).cos(), (first + turn).sin()]))
    assert float(q[0]) > math.pi


@BOTH
def test_a_reset_forgets_the_past(kind, kinova, down, starts):
    target = kinova.forward_kinematics(starts)[0] + 0.05
    follower = kind(kinova, down, max_step=STEP)
    follower.reset(starts)
    first = follower.step(target)
    follower.step(target)
    follower.reset(starts)
    assert torch.equal(follower.step(target), first)


@BOTH
def test_bad_input_is_an_error_and_moves_nothing(kind, kinova, down, starts):
    follower, untroubled = (kind(kinova, down, max_step=STEP) for _ in range(2))
    target = kinova.forward_kinematics(starts[:2])[0] + 0.05
    with pytest.raises(ParameterError, match="reset"):
        follower.step(target)
    for wrong in (starts[:2, :6], torch.full((2, 7), math.nan), "here"):
        with pytest.raises(ParameterError, match="configuration"):
            follower.reset(wrong)
    follower.reset(starts[:2])
    untroubled.reset(starts[:2])
    for wrong in (target * math.nan, target * math.inf, target[:1], target[0], target[:, :2], target[None]):
        with pytest.raises(ParameterError):
            follower.step(wrong)
    assert torch.equal(follower.step(target).fill_(0.0), torch.zeros(2, 7, dtype=torch.float64))
    untroubled.step(target)
    # what was done to the returned tensor is not done to the arms
    assert torch.equal(follower.step(target), untroubled.step(target))


@BOTH
@pytest.mark.parametrize("most", [0.0, -1.0, math.nan, math.inf, torch.ones(3), torch.zeros(7)])
def test_bad_step_lengths_are_errors(kind, most, kinova, down):
    with pytest.raises(ParameterError, match="max_step"):
        kind(kinova, down, max_step=most)


@pytest.mark.parametrize("weight", [-1.0, math.nan, math.inf])
def test_bad_weights_are_errors(weight):
    with pytest.raises(ParameterError, match="jerk"):
        Weights(jerk=weight)


@given(st.floats(-2, 2), st.floats(0.05, 1), st.floats(0, 10), st.floats(-3, 3))
def test_a_groove_is_deepest_at_its_goal_and_the_same_on_both_sides(s, c, r, offset):
    at, left, right = groove_loss(torch.tensor([s, s - offset, s + offset], dtype=torch.float64), s, c, r)
    assert float(at) == -1.0
    assert float(left) >= -1.0
    torch.testing.assert_close(left, right)
    if abs(offset) > 1e-3:
        assert float(right) > -1.0


@pytest.mark.parametrize(
    "weights",
    [
        Weights(),
        Weights(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),  # manipulability alone
        Weights(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0),  # limits alone
        Weights(0.0, 0.0, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0),
    ],
)
@pytest.mark.parametrize("seed", [0, 1, 4])
def test_the_gradient_is_the_objective_s_and_the_curvature_positive(weights, seed, tmp_path):
    robot, task = random_robot(tmp_path, seed), random_task(seed)
    check_gradient(robot, task, weights, robot.sample(20, torch.Generator().manual_seed(seed)))


def test_the_gradient_near_self_collision(kinova, down, generator):
    q = kinova.sample(4000, generator)
    distance = kinova.self_collision_distance(q)
    q = q[(distance > 0.005) & (distance < 0.05)][:20]
    assert len(q) == 20
    check_gradient(kinova, down, Weights(0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0), q)


def check_gradient(robot, task, weights, q):
    objective = RelaxedObjective(robot, task, weights)
    targets = robot.forward_kinematics(q.flip(0))[0].T
    past = Past(*(q.T + offset for offset in (0.01, 0.03, -0.02)))
    _, gradient, curvature = objective(q.T, targets, past)
    h = 1e-6
    for joint in range(robot.n):
        step = h * torch.eye(robot.n, dtype=torch.float64)[joint][:, None]
        rise = objective(q.T + step, targets, past)[0] - objective(q.T - step, targets, past)[0]
        # the closest pair of links may change within a difference: there is no derivative then
        close = torch.isclose(gradient[joint], rise / (2 * h), rtol=1e-4, atol=1e-5 * float(gradient.abs().max()))
        assert int((~close).sum()) <= (1 if weights.self_collision else 0)
    torch.testing.assert_close(curvature, curvature.transpose(0, 1))
    assert float(torch.linalg.eigvalsh(curvature.permute(2, 0, 1)).min()) > -1e-9 * float(curvature.abs().max())


def test_bounded_steps_keep_their_bounds_and_go_down(generator):
    factor = torch.randn(5, 4, 200, dtype=torch.float64, generator=generator)
    curvature = torch.einsum("kiN,kjN->ijN", factor, factor)
    gradient = torch.randn(4, 200, dtype=torch.float64, generator=generator)
    lower, upper = (
        -torch.rand(2, 4, 200, dtype=torch.float64, generator=generator) * torch.tensor([1.0, -1.0])[:, None, None]
    )
    for damping in (1e-4, 1.0, 1e4):
        step = _bounded_step(gradient, curvature, torch.full((200,), damping, dtype=torch.float64), lower, upper)
        assert bool(((step >= lower) & (step <= upper)).all())
        if damping > 1.0:
            assert bool(((gradient * step).sum(0) < 0.0).all())
    wide = torch.full_like(lower, 1e6)
    step = _bounded_step(gradient, curvature, torch.zeros(200, dtype=torch.float64), -wide, wide)
    expected = torch.linalg.solve(curvature.permute(2, 0, 1), -gradient.T)
    torch.testing.assert_close(step.T, expected, rtol=1e-5, atol=1e-8)
