"""The continuity check against a plain recursion, and on edges whose answer is known."""

from __future__ import annotations

import math

import pytest
import torch

import grr_torch
from grr_torch.errors import ParameterError
from grr_torch.projection.continuity import continuous_columns, is_continuous
from grr_torch.projection.project import DEFAULT_TOLERANCES, project
from grr_torch.spaces.configuration import distance, interpolate
from grr_torch.spaces.task import Position

TASK = Position(2)


def plain(robot, task, pa, pb, qa, qb, depth=0, deepest=20):
    """Algorithm 1 as the paper writes it, one edge, one call a bisection; a failed projection breaks the edge."""
    n = robot.n
    length = distance(qa, qb, robot.continuous)
    qm, valid = project(robot, task, task.interpolate(pa, pb, 0.5), interpolate(qa, qb, 0.5, robot.continuous))
    if length < 0.05 * math.sqrt(n):
        return bool(valid) if depth == 0 else True
    if not valid or depth == deepest:
        return False
    pm = task.interpolate(pa, pb, 0.5)
    worst = max(distance(qa, qm, robot.continuous), distance(qm, qb, robot.continuous))
    if worst > 0.5 * math.sqrt(n) * length:
        return False
    halves = (pa, pm, qa, qm), (pm, pb, qm, qb)
    return all(plain(robot, task, *half, depth + 1, deepest) for half in halves)


def edges(robot, task, count, generator, step):
    """Random edges: some short, some between unrelated configurations."""
    qa = robot.sample(4 * count, generator)
    qa = qa[~robot.in_self_collision(qa)][:count]
    pa = robot.forward_kinematics(qa)[0][:, : task.dimension]
    pb = pa + step * torch.randn(pa.shape, dtype=pa.dtype, generator=generator)
    near = qa + 0.8 * torch.rand(qa.shape, dtype=qa.dtype, generator=generator)
    qb, valid = project(robot, task, pb, near)
    return tuple(part[valid] for part in (pa, pb, qa, qb))


@pytest.mark.parametrize(("name", "dimension", "step"), [("planar_5", 2, 0.06), ("kinova", 3, 0.3)])
def test_agrees_with_the_plain_recursion(name, dimension, step, generator):
    robot, task = grr_torch.load_robot(name), Position(dimension)
    sample = edges(robot, task, 60, generator, step)
    found = is_continuous(robot, task, *sample)
    expected = [plain(robot, task, *edge) for edge in zip(*sample, strict=True)]
    assert found.tolist() == expected
    assert len(set(expected)) == 2  # both answers occur


@pytest.mark.parametrize("depth", [3, 5])
def test_what_is_not_joined_by_so_many_bisections_is_not_continuous(kinova, depth, generator):
    task, n = Position(3), kinova.n
    sample = edges(kinova, task, 60, generator, 0.3)
    columns = [part.T.contiguous() for part in sample]
    check = 0.5 * math.sqrt(n), 0.05 * math.sqrt(n), DEFAULT_TOLERANCES
    found = continuous_columns(kinova, task, columns[:2], columns[2:], *check, depth)
    expected = [plain(kinova, task, *edge, deepest=depth) for edge in zip(*sample, strict=True)]
    assert found.tolist() == expected
    assert 0 < sum(expected) < int(is_continuous(kinova, task, *sample).sum())


def test_an_edge_from_a_configuration_to_itself_is_continuous(planar_5, generator):
    q = planar_5.sample(20, generator)
    p = planar_5.forward_kinematics(q)[0][:, :2]
    assert bool(is_continuous(planar_5, TASK, p, p, q, q).all())


def test_elbow_up_and_elbow_down_are_not_joined():
    """Near full reach the two families are apart, and the straight line between the points joins no two of them."""
    robot = grr_torch.load_robot("planar_3")
    up = torch.tensor([0.0, 0.9, -0.2], dtype=torch.float64)
    down = torch.tensor([0.75, -0.9, 0.2], dtype=torch.float64)
    pa, pb = (robot.forward_kinematics(q)[0][:2] for q in (up, down))
    assert not bool(is_continuous(robot, TASK, pa, pb, up, down, c=0.6))


def test_a_colliding_middle_of_a_short_edge_breaks_it(kinova, generator):
    q = kinova.sample(20_000, generator)
    q = q[(kinova.self_collision_distance(q) - kinova.margin).abs() < 2e-3]
    shifted = q + 1e-4
    p, p_shifted = (kinova.forward_kinematics(part)[0] for part in (q, shifted))
    found = is_continuous(kinova, Position(3), p, p_shifted, q, shifted)
    collides = kinova.in_self_collision(0.5 * (q + shifted))
    assert found.tolist() == (~collides).tolist()
    assert len(set(found.tolist())) == 2


def test_a_recursion_that_does_not_end_is_broken(planar_5, generator):
    """With a large c nothing else stops it: what is unfinished is not passed, and memory stays bounded."""
    sample = edges(planar_5, TASK, 10, generator, 0.05)
    found = is_continuous(planar_5, TASK, *sample, c=50.0, epsilon=1e-6)
    assert not bool(found.any())


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (0,)])
def test_batch_axes_lead(planar_5, generator, batch):
    q = planar_5.sample(math.prod(batch), generator).reshape(*batch, 5)
    p = planar_5.forward_kinematics(q)[0][..., :2]
    assert is_continuous(planar_5, TASK, p, p, q, q).shape == batch


@pytest.mark.parametrize("option", [{"c": 0.5}, {"c": math.nan}, {"epsilon": 0.0}])
def test_bad_parameters_are_errors(planar_5, option):
    q, p = torch.zeros(1, 5), torch.tensor([[0.5, 0.0]])
    with pytest.raises(ParameterError):
        is_continuous(planar_5, TASK, p, p, q, q, **option)


def test_nan_is_an_error(planar_5):
    q, p = torch.zeros(1, 5), torch.tensor([[0.5, 0.0]])
    with pytest.raises(ParameterError, match="configurations: got NaN"):
        is_continuous(planar_5, TASK, p, p, q, q * torch.nan)
