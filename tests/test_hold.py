"""The search for the nearest point to a target that a roadmap can solve."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import grr_torch
from grr_torch.applications.hold import LEVELS, nearest_feasible
from grr_torch.applications.lines import Follower
from grr_torch.projection.project import DEFAULT_TOLERANCES

STEPS = 30


@pytest.fixture(scope="module")
def roadmap(kinova_roadmap) -> grr_torch.Roadmap:
    return kinova_roadmap


@pytest.fixture(scope="module")
def follower(roadmap) -> Follower:
    return Follower(roadmap.robot, roadmap.task, DEFAULT_TOLERANCES, torch.full((7,), 0.04, dtype=torch.float64))


def _starts(roadmap, count, seed):
    """Points and configurations (count, …) of resolved vertices."""
    resolved = roadmap.resolved.nonzero()[:, 0]
    order = torch.randperm(len(resolved), generator=torch.Generator().manual_seed(seed))[:count]
    return tuple(part[resolved[order]].numpy() for part in (roadmap.points, roadmap.configurations))


def _search(roadmap, follower, base, base_q, targets):
    """Points (STEPS, B, 3) found one after the other, looking ever more closely in turn, and the last step's rest."""
    points = []
    for step in range(STEPS):
        level = np.full(len(base), step % LEVELS)
        base, base_q, solved = nearest_feasible(follower, roadmap.solver, base, base_q, targets, level)
        points.append(base)
    return np.stack(points), base_q, solved


def test_points_come_ever_nearer_to_a_target_out_of_reach(roadmap, follower):
    base, base_q = _starts(roadmap, 12, 0)
    targets = 3.0 * base / np.linalg.norm(base, axis=1, keepdims=True)
    points, q, solved = _search(roadmap, follower, base, base_q, targets)
    left = np.linalg.norm(points - targets, axis=2)
    # a little joint motion is not made for next to nothing, but no step leads away
    assert bool((np.diff(left, axis=0) <= 1e-9).all())
    # nearer than any vertex in the end, where there is one beyond which nothing is reached, and by more than that
    vertices = roadmap.points[roadmap.resolved].numpy()
    nearest = np.linalg.norm(vertices[None] - targets[:, None], axis=2).min(1)
    assert bool((left[-1] <= nearest / 0.8 + 1e-9).all())
    assert float(np.median(left[0] - left[-1])) > 0.03
    assert not solved.any()
    # what is found is the arm's: its tool is there, free of self-collision and within limits
    robot, found = roadmap.robot, torch.from_numpy(q)
    assert float((robot.forward_kinematics(found)[0] - torch.from_numpy(points[-1])).norm(dim=1).max()) < 1e-3
    assert not bool(robot.in_self_collision(found).any())
    assert bool(robot.within_limits(found).all())


def test_a_target_that_the_map_solves_is_noticed(roadmap, follower):
    base, base_q = _starts(roadmap, 8, 1)
    targets = _starts(roadmap, 8, 2)[0]
    _, _, solved = nearest_feasible(follower, roadmap.solver, base, base_q, targets, np.zeros(8, dtype=np.int64))
    assert solved.all()


@pytest.mark.parametrize("level", range(LEVELS))
def test_a_close_look_goes_a_fifth_or_a_twentieth_as_far(roadmap, follower, level):
    base, base_q = _starts(roadmap, 40, 3)
    # so far away that no vertex is a fifth nearer
    targets = 4.0 * base / np.linalg.norm(base, axis=1, keepdims=True)
    found, _, _ = nearest_feasible(follower, roadmap.solver, base, base_q, targets, np.full(40, level))
    gone = np.linalg.norm(found - base, axis=1)
    farthest = (0.2, 0.04, 0.01)[level]
    assert float(gone.max()) <= farthest + 1e-9
    assert int((gone > 0.9 * farthest).sum()) > 10


def test_what_is_much_nearer_on_the_other_side_is_gone_to(roadmap, follower):
    """Across the base, where points on the way are not solved."""
    vertices = roadmap.points[roadmap.resolved].numpy()
    base, base_q = _starts(roadmap, 40, 5)
    targets = base * np.array([-0.2, -0.2, 1.0])
    lost = ~roadmap.solve(torch.from_numpy(targets)).valid.numpy()
    assert lost.any()
    far = np.zeros(int(lost.sum()), dtype=np.int64)
    found, q, _ = nearest_feasible(follower, roadmap.solver, base[lost], base_q[lost], targets[lost], far)
    nearest = np.linalg.norm(vertices[None] - targets[lost, None], axis=2).min(1)
    assert bool((np.linalg.norm(found - targets[lost], axis=1) <= nearest / 0.8 + 1e-9).all())
    assert np.isfinite(q).all()
    assert bool((np.linalg.norm(found - base[lost], axis=1) > 0.2).any())


def test_without_a_known_configuration_one_is_found(roadmap, follower):
    base, base_q = _starts(roadmap, 6, 4)
    targets, unknown = 3.0 * base, np.full_like(base_q, np.nan)
    found, q, _ = nearest_feasible(follower, roadmap.solver, base, unknown, targets, np.zeros(6, dtype=np.int64))
    assert np.isfinite(q).all()
    closer = np.linalg.norm(base - targets, axis=1) - np.linalg.norm(found - targets, axis=1)
    assert bool((closer >= -1e-9).all())
    assert float(closer.max()) > 0.05
