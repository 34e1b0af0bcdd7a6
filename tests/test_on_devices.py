"""Constants of task spaces: put on a device once, and as good as those that are made anew."""

from __future__ import annotations

import pickle

import pytest
import torch

from grr_torch.devices import OnDevices
from grr_torch.spaces.task import FixedRotation, make_task


@pytest.mark.parametrize("kind", ["fixed-rotation", "yaw", "axis"])
def test_what_was_asked_for_in_inference_mode_can_be_differentiated_with(kind):
    task = make_task(kind, 3)
    targets = torch.zeros(task.width, 5, dtype=torch.float64)
    targets[-1] = 1.0
    rotation = torch.linalg.qr(torch.eye(3, dtype=torch.float64) + 0.1)[0][..., None].repeat(1, 1, 5)
    with torch.inference_mode():
        expected = task.rotation_error(targets, rotation)
    rotation.requires_grad_(True)
    # errors of whole rotations are worked out in place, what they are of is not
    found = task.rotation_error(targets, rotation) if kind == "axis" else task.matrices(targets) * rotation
    found.sum().backward()
    assert bool(rotation.grad.isfinite().all())
    torch.testing.assert_close(task.rotation_error(targets, rotation.detach()), expected.clone(), atol=0, rtol=0)


def test_a_task_is_pickled_without_its_copies():
    task = FixedRotation(3, (0.1, 0.2, 0.3))
    used = FixedRotation(3, (0.1, 0.2, 0.3))
    for dtype in (torch.float32, torch.float64):
        used.matrices(torch.zeros(3, 1, dtype=dtype))
    again = pickle.loads(pickle.dumps(used))
    assert again == task
    assert len(pickle.dumps(again._rotation)) == len(pickle.dumps(OnDevices(task.rotation)))
    assert torch.equal(again.matrices(torch.zeros(3, 1, dtype=torch.float64))[..., 0], task.rotation)


def test_copies_are_made_once_for_each_dtype():
    constants = OnDevices(torch.tensor([1.5]), torch.tensor([2]))
    single = constants.like(torch.zeros(1))
    assert all(a is b for a, b in zip(single, constants.like(torch.ones(1)), strict=True))
    assert [tensor.dtype for tensor in constants.like(torch.zeros(1, dtype=torch.float64))] == [torch.float64] * 2
    assert [tensor.dtype for tensor in constants.at(torch.device("cpu"))] == [torch.float32, torch.int64]
