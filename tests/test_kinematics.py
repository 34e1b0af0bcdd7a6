"""Forward kinematics and Jacobians against pytorch-kinematics, Pinocchio, finite differences and stored truth."""

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

BATCHES = [(), (1,), (5,), (3, 1, 2), (0,)]


def load(tmp_path_factory, text, **options):
    path = tmp_path_factory.mktemp("urdf") / "random.urdf"
    path.write_text(text)
    return grr_torch.load_robot(path, **options)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), joints=st.integers(1, 9))
def test_agrees_with_pytorch_kinematics_on_random_robots(tmp_path_factory, seed, joints):
    robot = load(tmp_path_factory, random_urdf(np.random.default_rng(seed), joints), tool="tool")
    # few and many configurations are computed in different ways
    q = robot.sample(3 if seed % 2 else 40, torch.Generator().manual_seed(seed))
    expected, matrix = robot.chain.jacobian(q, ret_eef_pose=True)
    position, rotation, jacobian = robot.pose_and_jacobian(q)
    torch.testing.assert_close(position, matrix[:, :3, 3], atol=1e-9, rtol=0)
    torch.testing.assert_close(rotation, matrix[:, :3, :3], atol=1e-9, rtol=0)
    torch.testing.assert_close(jacobian, expected, atol=1e-9, rtol=0)


@pytest.mark.parametrize("mimic", [False, True])
@pytest.mark.parametrize("seed", range(8))
def test_agrees_with_pinocchio_on_random_trees(tmp_path_factory, seed, mimic):
    pinocchio = pytest.importorskip("pinocchio")
    text = random_urdf(np.random.default_rng(seed), 7, branches=True, mimic=mimic)
    robot = load(tmp_path_factory, text, tool="tool")
    model = pinocchio.buildModelFromXML(text, mimic=True)
    data = model.createData()
    for q in robot.sample(5, torch.Generator().manual_seed(seed)):
        pinocchio_q = pinocchio.neutral(model)
        for name, value in zip(robot.joint_names, q.tolist(), strict=True):
            place = model.joints[model.getJointId(name)]
            entry = [value] if place.nq == 1 else [math.cos(value), math.sin(value)]
            pinocchio_q[place.idx_q : place.idx_q + place.nq] = entry
        pinocchio.framesForwardKinematics(model, data, pinocchio_q)
        poses = robot.link_poses(q)
        for link in robot.urdf.links:
            expected = data.oMf[model.getFrameId(link)].homogeneous
            np.testing.assert_allclose(poses[link].numpy(), expected, atol=1e-9)
        if not mimic:
            frame = model.getFrameId("tool")
            world = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
            full = pinocchio.computeFrameJacobian(model, data, pinocchio_q, frame, world)
            columns = [model.joints[model.getJointId(name)].idx_v for name in robot.joint_names]
            np.testing.assert_allclose(robot.jacobian(q).numpy(), full[:, columns], atol=1e-9)


@pytest.mark.parametrize("mimic", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_jacobian_is_the_derivative_of_the_pose(tmp_path_factory, seed, mimic):
    robot = load(tmp_path_factory, random_urdf(np.random.default_rng(seed), 6, mimic=mimic), tool="tool")
    q, h = robot.sample(4, torch.Generator().manual_seed(seed)), 1e-6
    jacobian = robot.jacobian(q)
    _, rotation = robot.forward_kinematics(q)
    for column in range(robot.n):
        step = torch.zeros(robot.n, dtype=q.dtype)
        step[column] = h
        (ahead, turned_ahead), (behind, turned_behind) = (robot.forward_kinematics(q + s) for s in (step, -step))
        torch.testing.assert_close(jacobian[:, :3, column], (ahead - behind) / (2 * h), atol=1e-7, rtol=0)
        spin = (turned_ahead - turned_behind) / (2 * h) @ rotation.transpose(1, 2)
        turned = torch.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], dim=1)
        torch.testing.assert_close(jacobian[:, 3:, column], turned, atol=1e-7, rtol=0)


@pytest.mark.parametrize("batch", BATCHES)
def test_batch_axes_lead(kinova, generator, batch):
    q = kinova.sample(math.prod(batch), generator).reshape(*batch, 7)
    position, rotation, jacobian = kinova.pose_and_jacobian(q)
    assert position.shape == (*batch, 3)
    assert rotation.shape == (*batch, 3, 3)
    assert jacobian.shape == (*batch, 6, 7)
    assert kinova.self_collision_distance(q).shape == batch
    assert kinova.in_self_collision(q).shape == batch
    assert all(pose.shape == (*batch, 4, 4) for pose in kinova.link_poses(q).values())
    if batch == (3, 1, 2):
        torch.testing.assert_close(position[2, 0, 1], kinova.forward_kinematics(q[2, 0, 1])[0])


def test_stored_poses_of_the_kinova(kinova):
    q = torch.tensor(
        [[0.0] * 7, [0, 1, 0, 1, 0, math.pi - 2, -math.pi / 2], [0.3, -0.5, 0.7, 1.1, -0.4, 0.9, 0.2]],
        dtype=torch.float64,
    )
    position, rotation = kinova.forward_kinematics(q)
    expected = [[0, -0.02486, 1.30738], [0.63990, -0.02485, 0.09387], [0.08381, -0.33828, 0.90670]]
    torch.testing.assert_close(position, torch.tensor(expected, dtype=torch.float64), atol=1e-5, rtol=0)
    down = torch.tensor([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]], dtype=torch.float64)
    torch.testing.assert_close(rotation[1], down, atol=1e-9, rtol=0)
    turned = [[0.2838, 0.5341, 0.7964], [0.2217, 0.7715, -0.5964], [-0.9329, 0.3458, 0.1005]]
    torch.testing.assert_close(rotation[2], torch.tensor(turned, dtype=torch.float64), atol=1e-4, rtol=0)
    # the straight arm is singular three times over
    assert int((torch.linalg.svdvals(kinova.jacobian(q[0])) < 1e-9).sum()) == 3


def test_everything_is_differentiable(kinova, generator):
    q = kinova.sample(2, generator).requires_grad_()

    def outputs(q):
        return (*kinova.pose_and_jacobian(q), kinova.link_poses(q)["bracelet_link"])

    assert torch.autograd.gradcheck(outputs, (q,))


@pytest.mark.parametrize("seed", range(6))
def test_poses_are_twice_differentiable_on_random_trees(tmp_path_factory, seed):
    text = random_urdf(np.random.default_rng(seed), 3, branches=True, mimic=seed % 2 == 0)
    robot = load(tmp_path_factory, text, tool="tool")
    q = robot.sample(2, torch.Generator().manual_seed(seed)).requires_grad_()

    def outputs(q):
        return (*robot.pose_and_jacobian(q), *robot.link_poses(q).values())

    assert torch.autograd.gradcheck(outputs, (q,))
    assert torch.autograd.gradgradcheck(lambda q: robot.forward_kinematics(q), (q,))


@pytest.mark.parametrize("seed", range(6))
def test_few_and_many_configurations_give_the_same_frames(tmp_path_factory, kinova, seed):
    text = random_urdf(np.random.default_rng(seed), 6, branches=True, mimic=seed % 2 == 0)
    for robot in (kinova, load(tmp_path_factory, text, tool="tool")):
        q = robot.columns(torch.cat([torch.zeros(1, robot.n), robot.sample(40, torch.Generator().manual_seed(seed))]))
        many = robot.tree.frames(q)
        few = torch.cat([robot.tree.frames(column) for column in q.split(1, dim=1)], dim=-1)
        torch.testing.assert_close(few, many, atol=1e-13, rtol=0)


def test_a_configuration_of_the_wrong_length_is_an_error(kinova):
    with pytest.raises(ParameterError, match=r"\(\*batch, 7\)") as caught:
        kinova.forward_kinematics(torch.zeros(3, 6))
    assert caught.value.value == (3, 6)


def test_samples_lie_within_limits_and_follow_the_generator(kinova):
    first, again = (kinova.sample(500, torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(first, again)
    assert bool(kinova.within_limits(first).all())
    spread = first.amax(0) - first.amin(0)
    assert bool((spread > 0.9 * torch.where(kinova.continuous, 2 * math.pi, kinova.upper - kinova.lower)).all())


def test_float32_is_used_where_it_is_asked_for(generator):
    robot = grr_torch.load_robot("kinova", dtype=torch.float32)
    exact = grr_torch.load_robot("kinova")
    q = exact.sample(100, generator)
    position = robot.forward_kinematics(q)[0]
    assert position.dtype == torch.float32
    torch.testing.assert_close(position.double(), exact.forward_kinematics(q)[0], atol=1e-5, rtol=0)
