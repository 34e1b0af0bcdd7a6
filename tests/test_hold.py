"""The search for the nearest point to a target that a roadmap can solve."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import grr_torch
from grr_torch.applications.hold import nearest_feasible
from grr_torch.applications.lines import Follower
from grr_torch.projection.project import DEFAULT_TOLERANCES

STEPS = 30


@pytest.fixture(scope="module")
def roadmap(kinova) -> grr_torch.Roadmap:
    return grr_torch.build(kinova, "fixed-rotation")


@pytest.fixture(scope="module")
def follower(roadmap) -> Follower:
    return Follower(roadmap.robot, roadmap.task, DEFAULT_TOLERANCES, torch.full((7,), 0.04, dtype=torch.float64))


def _starts(roadmap, count, seed):
    """Points and configurations (count, …) of resolved vertices."""
    resolved = roadmap.resolved.nonzero()[:, 0]
    order = torch.randperm(len(resolved), generator=torch.Generator().manual_seed(seed))[:count]
    return tuple(part[resolved[order]].numpy() for part in (roadmap.points, roadmap.configurations))


def _search(roadmap, follower, base, base_q, targets):
    """Points (STEPS, B, 3) found one after the other, looking far and closely in turn, and the last step's rest."""
    points = []
    for step in range(STEPS):
        closely = np.full(len(base), step % 2 == 1)
        base, base_q, solved = nearest_feasible(follower, roadmap.solver, base, base_q, targets, closely)
        points.append(base)
    return np.stack(points), base_q, solved


def test_points_come_ever_nearer_to_a_target_out_of_reach(roadmap, follower):
    base, base_q = _starts(roadmap, 12, 0)
    targets = 3.0 * base / np.linalg.norm(base, axis=1, keepdims=True)
    points, q, solved = _search(roadmap, follower, base, base_q, targets)
    left = np.linalg.norm(points - targets, axis=2)
    # a little joint motion is not made for next to nothing, but no step leads away
    assert bool((np.diff(left, axis=0) <= 1e-9).all())
    vertices = roadmap.points[roadmap.resolved].numpy()
    nearest = np.linalg.norm(vertices[None] - targets[:, None], axis=2).min(1)
    assert bool((left[-1] <= nearest / 0.8 + 1e-9).all())
    assert not solved.any()
    # what is found is the arm's: its tool is there, free of self-collision and within limits
    robot, found = roadmap.robot, torch.from_numpy(q)
    assert float((robot.forward_kinematics(found)[0] - torch.from_numpy(points[-1])).norm(dim=1).max()) < 1e-3
    assert not bool(robot.in_self_collision(found).any())
    assert bool(robot.within_limits(found).all())


def test_a_target_that_the_map_solves_is_noticed(roadmap, follower):
    base, base_q = _starts(roadmap, 8, 1)
    targets = _starts(roadmap, 8, 2)[0]
    _, _, solved = nearest_feasible(follower, roadmap.solver, base, base_q, targets, np.zeros(8, dtype=bool))
    assert solved.all()


def test_looking_closely_finds_only_near_points_unless_a_vertex_is_much_nearer(roadmap, follower):
    base, base_q = _starts(roadmap, 40, 3)
    targets = base + 0.1 * np.random.default_rng(0).normal(size=base.shape)
    closely = np.ones(len(base), dtype=bool)
    found, _, _ = nearest_feasible(follower, roadmap.solver, base, base_q, targets, closely)
    gone = np.linalg.norm(found - base, axis=1)
    vertices = roadmap.points[roadmap.resolved].numpy()
    at_vertex = np.linalg.norm(vertices[None] - found[:, None], axis=2).min(1) < 1e-12
    near = gone <= 0.2 * np.minimum(np.linalg.norm(targets - base, axis=1), 0.2) + 1e-9
    solved_target = np.linalg.norm(found - targets, axis=1) < 1e-9
    assert bool((near | at_vertex | solved_target).all())
    assert near.any()
    assert at_vertex.any() or solved_target.any()


def test_without_a_known_configuration_one_is_found(roadmap, follower):
    base, base_q = _starts(roadmap, 6, 4)
    targets = 3.0 * base
    found, q, _ = nearest_feasible(
        follower, roadmap.solver, base, np.full_like(base_q, np.nan), targets, np.zeros(6, dtype=bool)
    )
    assert np.isfinite(q).all()
    assert bool((np.linalg.norm(found - targets, axis=1) <= np.linalg.norm(base - targets, axis=1) + 1e-9).all())
