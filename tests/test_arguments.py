"""Arguments of one kind are understood, and refused, alike wherever they are given."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch

from grr_torch.errors import ParameterError, check_seed, check_whole
from grr_torch.projection.project import Tolerances
from grr_torch.spaces.graph import TaskGraph, check_count, random_graph
from grr_torch.spaces.task import FixedRotation, make_task

WHOLE = {
    "seed": (check_seed, 0, (1 << 63) - 1),
    "points": (check_count, 1, 2_000_000),
    "iterations": (lambda value: Tolerances(iterations=value).iterations, 1, None),
    "k": (lambda value: len(random_graph([(0.0, 1.0)] * 2, 9, k=value).edges), 1, 8),
    "samples": (lambda value: check_whole("samples", value, 5, 2000), 5, 2000),
}


@pytest.mark.parametrize("name", WHOLE)
def test_whole_numbers_may_be_numpy_s(name):
    check, _, high = WHOLE[name]
    for value in (8, high or 1 << 70, np.int64(8), np.uint8(8)):
        found = check(value)
        assert type(found) is int
        assert name == "k" or found == value


@pytest.mark.parametrize("name", WHOLE)
def test_what_is_no_whole_number_within_its_range_is_told_as_it_was_given(name):
    check, low, high = WHOLE[name]
    valid = f"a whole number, {low} or more" if high is None else f"a whole number from {low} to {high:,}"
    for value in (low - 1, *([] if high is None else [high + 1]), 8.0, np.float64(2.5), True, "8", None, np.arange(2)):
        given = repr(value) if isinstance(value, str) else str(value)
        with pytest.raises(ParameterError, match=re.escape(f"{name}: got {given}; valid: {valid}") + "$"):
            check(value)


def test_a_rotation_may_be_an_array():
    for rpy in (np.array([0.1, 0.2, 0.3]), torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)):
        assert make_task("fixed-rotation", 3, rpy) == FixedRotation(3, (0.1, 0.2, 0.3))
        assert make_task("yaw", 3, rpy, np.array([0.0, 0.0, 2.0])) == make_task("yaw", 3, (0.1, 0.2, 0.3), (0, 0, 2.0))
    assert make_task("fixed-rotation", 3, np.zeros(3)) == make_task("fixed-rotation", 3)


def test_what_no_edge_joins_has_no_edge_between():
    graph = TaskGraph(torch.rand(4, 2, dtype=torch.float64), torch.tensor([[1, 3], [0, 2]]))
    assert graph.edge_between(torch.tensor([3, 0]), torch.tensor([1, 2])).tolist() == [0, 1]
    for other in ((0, 1), (2, 3), (1, 1)):
        first, second = torch.tensor([(1, 3), other]).T
        with pytest.raises(ParameterError, match=re.escape(f"vertices: got {other}; valid: two that an edge joins")):
            graph.edge_between(first, second)
    lonely = TaskGraph(graph.points, torch.empty(0, 2, dtype=torch.long))
    assert len(lonely.edge_between(*torch.empty(2, 0, dtype=torch.long))) == 0
    with pytest.raises(ParameterError, match="two that an edge joins"):
        lonely.edge_between(torch.tensor([0]), torch.tensor([1]))
