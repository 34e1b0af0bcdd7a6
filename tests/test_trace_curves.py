"""Curves: which configurations lie on them, without all of them beside all samples."""

from __future__ import annotations

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from grr_torch import Position, load_robot
from grr_torch.applications.trace_curves import Tracer
from grr_torch.projection.project import Tolerances, project_columns
from grr_torch.spaces.configuration import difference

CLOSE = Tolerances(position=1e-6, rotation=1e-5)


class Largest(TorchDispatchMode):
    """Notes how many numbers the largest tensor has that an operator gives."""

    def __init__(self):
        super().__init__()
        self.numbers = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        sizes = [leaf.numel() for leaf in tree_leaves(result) if isinstance(leaf, torch.Tensor)]
        self.numbers = max([self.numbers, *sizes])
        return result


def traced(count, generator):
    robot = load_robot("planar_3")
    target = torch.tensor([[0.05], [0.02]], dtype=torch.float64)
    guesses = robot.sample(count, generator).T.contiguous()
    q, valid = project_columns(robot, Position(2), target.expand(-1, count).contiguous(), guesses, CLOSE, False)
    tracer = Tracer(robot, Position(2), target, 0.05, CLOSE)
    return tracer, q[:, valid.nonzero()[:, 0]]


def test_each_configuration_lies_on_the_curves_that_pass_it(generator):
    tracer, q = traced(200, generator)
    curves = tracer.both_ways(q[:, :6])
    on = tracer.lie_on(q, curves)
    assert on[torch.arange(6), torch.arange(6)].all()
    for number in range(6):
        samples = curves.configurations[:, curves.curve == number]
        gaps = difference(samples[:, :, None], q[:, None], tracer.robot.continuous[:, None, None]).norm(dim=0).amin(0)
        # samples are at most a step apart, and the other curve is far
        assert torch.equal(on[:, number], gaps <= tracer.step)
    # two curves, and each start is on one of them
    assert len(on.unique(dim=1).T) == 2
    assert bool((on.unique(dim=1).sum(1) == 1).all())


def test_many_configurations_beside_long_curves_take_memory_in_proportion(generator):
    tracer, q = traced(2000, generator)
    curves = tracer.both_ways(q[:, :2])
    with Largest() as largest:
        tracer.lie_on(q, curves)
    # a Jacobian is the largest thing that there is of a configuration
    assert largest.numbers <= 40 * q.shape[1] < len(curves.curve) * q.shape[1]
