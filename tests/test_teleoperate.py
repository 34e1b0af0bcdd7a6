from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from teleoperated import follow_targets, some_vertices

import grr_torch
from grr_torch.applications.braking import limit_acceleration
from grr_torch.applications.lines import Follower
from grr_torch.applications.steps import STATUSES, Steps
from grr_torch.applications.straight import Straight
from grr_torch.applications.teleoperate import Teleoperator
from grr_torch.experiments.paths import draw_paths
from grr_torch.projection.project import Tolerances


@pytest.fixture(scope="module")
def roadmap(kinova_roadmap) -> grr_torch.Roadmap:
    return kinova_roadmap


def _hostile(roadmap: grr_torch.Roadmap, arms: int, steps: int, seed: int) -> torch.Tensor:
    """Targets (steps, arms, width) that wander, leap, leave the reach and pass through the base."""
    generator = torch.Generator().manual_seed(seed)
    low, high = roadmap.points.amin(0) - 0.3, roadmap.points.amax(0) + 0.3
    leaps = low + (high - low) * torch.rand(steps, arms, len(low), dtype=torch.float64, generator=generator)
    held = leaps[torch.arange(steps) // 15 * 15]
    walk = 0.02 * torch.randn(steps, arms, len(low), dtype=torch.float64, generator=generator)
    return held + walk.cumsum(0)


def _between(q: torch.Tensor, count: int = 8) -> torch.Tensor:
    """Configurations (steps − 1, count, …) between successive ones."""
    fractions = torch.arange(1, count + 1, dtype=q.dtype).reshape(-1, *[1] * (q.ndim - 1)) / count
    return q[:-1, None] + fractions * (q[1:] - q[:-1])[:, None]


@pytest.mark.parametrize("seed", [0, 1])
def test_no_step_is_too_long_or_through_a_collision_whatever_the_targets(roadmap, seed):
    robot = roadmap.robot
    start = roadmap.configurations[some_vertices(roadmap, 8, seed)]
    teleoperator = Teleoperator(roadmap, start=start)
    q, status = follow_targets(teleoperator, _hostile(roadmap, 8, 90, seed))
    q = torch.cat([start[None], q])
    assert bool((q.diff(dim=0).abs() <= robot.velocity_limits / 50.0).all())
    assert not bool(robot.in_self_collision(_between(q)).any())
    assert bool(robot.within_limits(q).all())
    assert set(np.unique(status)) <= set(STATUSES)


def test_a_reachable_target_is_reached_and_held(roadmap):
    vertices = some_vertices(roadmap, 24, 3)
    start, goals = roadmap.configurations[vertices[:12]], roadmap.points[vertices[12:]]
    teleoperator = Teleoperator(roadmap, start=start, max_step=0.1)
    q, status = follow_targets(teleoperator, goals.expand(150, -1, -1))
    apart = (roadmap.robot.forward_kinematics(q[-1])[0] - goals).norm(dim=1)
    assert float(apart.max()) < 1e-3
    assert (status[-1] == "tracking").all()
    assert float((q[-1] - q[-2]).abs().max()) < 1e-4


def test_the_arm_ends_at_the_maps_configuration_whatever_way_it_came(roadmap):
    vertices = some_vertices(roadmap, 7, 5)
    goal = roadmap.points[vertices[0]]
    teleoperator = Teleoperator(roadmap, start=roadmap.configurations[vertices[1:]], max_step=0.1)
    q, _ = follow_targets(teleoperator, goal.expand(150, 6, -1))
    apart = grr_torch.spaces.configuration.distance(q[-1], q[-1, :1], roadmap.robot.continuous)
    assert float(apart.max()) < 1e-3


def test_an_arm_on_its_task_keeps_it_while_it_tracks(roadmap):
    vertices = some_vertices(roadmap, 10, 7)
    teleoperator = Teleoperator(roadmap, start=roadmap.configurations[vertices[:5]])
    q, status = follow_targets(teleoperator, roadmap.points[vertices[5:]].expand(120, -1, -1))
    position, rotation = roadmap.robot.forward_kinematics(q.reshape(-1, 7))
    error = roadmap.task.error(position.T, position.T, rotation.permute(1, 2, 0))
    turned = roadmap.task.residuals(error)[1].reshape(status.shape)
    assert float(turned[torch.from_numpy(status == "tracking")].max()) < 0.01


@pytest.mark.parametrize("seed", [0, 1])
def test_any_measured_start_comes_back_to_the_map(roadmap, seed):
    """Off the map, off the task, outside a limit; those in self-collision are another test's."""
    robot = roadmap.robot
    start = robot.sample(40, torch.Generator().manual_seed(seed))
    start[:5, 1] = 2.6
    start = start[~robot.in_self_collision(start)][:10]
    goal = roadmap.points[some_vertices(roadmap, 1, seed)[0]]
    teleoperator = Teleoperator(roadmap, start=start, max_step=0.1)
    q, _ = follow_targets(teleoperator, goal.expand(220, len(start), -1))
    assert bool((torch.cat([start[None], q]).diff(dim=0).abs() <= 0.1).all())
    assert not bool(robot.in_self_collision(_between(torch.cat([start[None], q]))).any())
    apart = (robot.forward_kinematics(q[-1])[0] - goal).norm(dim=1)
    assert float((apart < 1e-3).double().mean()) >= 0.8


def test_from_a_contact_it_never_goes_deeper(roadmap):
    robot = roadmap.robot
    start = robot.sample(4000, torch.Generator().manual_seed(3))
    start = start[robot.in_self_collision(start)][:8]
    teleoperator = Teleoperator(roadmap, start=start)
    q, _ = follow_targets(teleoperator, roadmap.points[some_vertices(roadmap, 8, 3)].expand(120, -1, -1))
    clearance = robot.self_collision_distance(torch.cat([start[None], q])) - robot.margin
    deepest = clearance.clamp_max(0.0)
    assert bool((deepest.diff(dim=0) >= -1e-6).all())
    assert float((deepest[-1] >= 0.0).double().mean()) > 0.5


def test_acceleration_limits_hold_and_arms_still_arrive(roadmap):
    vertices = some_vertices(roadmap, 12, 11)
    start, goals = roadmap.configurations[vertices[:6]], roadmap.points[vertices[6:]]
    teleoperator = Teleoperator(roadmap, start=start, acceleration_limits=3.0)
    q, _ = follow_targets(teleoperator, goals.expand(400, -1, -1))
    q = torch.cat([start[None], start[None], q])
    speed = q.diff(dim=0) * 50.0
    assert bool((speed.abs() <= roadmap.robot.velocity_limits * (1.0 + 1e-9)).all())
    assert float(speed.diff(dim=0).abs().max()) * 50.0 <= 3.0 * (1.0 + 1e-6)
    assert not bool(roadmap.robot.in_self_collision(_between(q)).any())
    apart = (roadmap.robot.forward_kinematics(q[-1])[0] - goals).norm(dim=1)
    assert float((apart < 1e-2).double().mean()) >= 0.8


def test_with_acceleration_limits_a_joint_that_need_not_move_keeps_no_other(kinova):
    """The last joint does not move the tool, so it stands where it is to stop."""
    roadmap = grr_torch.build(kinova, "position", points=1200, refine=False)
    vertices = some_vertices(roadmap, 20, 5)
    start, goals = roadmap.configurations[vertices[:10]], roadmap.points[vertices[10:]]
    q, _ = follow_targets(Teleoperator(roadmap, start=start, acceleration_limits=4.0), goals.expand(400, -1, -1))
    apart = (roadmap.robot.forward_kinematics(q[-1])[0] - goals).norm(dim=1)
    assert float((apart < 1e-2).double().mean()) >= 0.8


@pytest.mark.parametrize("max_step", [None, 0.3, 1.0])
def test_many_arms_are_the_same_as_one_at_a_time(roadmap, max_step):
    vertices = some_vertices(roadmap, 6, 13)
    targets = _hostile(roadmap, 6, 40, 4)
    start = roadmap.configurations[vertices]
    together = Teleoperator(roadmap, start=start.reshape(3, 1, 2, 7), max_step=max_step)
    q, status = follow_targets(together, targets.reshape(40, 3, 1, 2, 3))
    assert q.shape == (40, 3, 1, 2, 7)
    assert status.shape == (40, 3, 1, 2)
    for arm in range(6):
        alone = Teleoperator(roadmap, start=start[arm], max_step=max_step)
        single, _ = follow_targets(alone, targets[:8, arm])
        assert torch.allclose(single, q.reshape(40, 6, 7)[:8, arm], atol=1e-6)


def test_arms_that_track_do_as_they_would_if_they_looked_at_everything(roadmap, monkeypatch):
    start = roadmap.configurations[some_vertices(roadmap, 20, 5)]
    lines = [draw_paths(roadmap, kind, 10, seed=7).transpose(0, 1) for kind in ("line_random", "circle_out")]
    targets = torch.cat(lines, dim=1)
    found, status = follow_targets(Teleoperator(roadmap, start=start, max_step=0.04), targets)

    def never(straight, arms, which, goals):
        return Steps.none_yet(arms, which), np.zeros(len(which), dtype=bool)

    monkeypatch.setattr(Straight, "track", never)
    expected, expected_status = follow_targets(Teleoperator(roadmap, start=start, max_step=0.04), targets)
    assert (status == "tracking").mean() > 0.5
    assert (status != "tracking").mean() > 0.1
    assert (status == expected_status).all()
    # how many are solved at once decides on the last digits
    assert torch.allclose(found, expected, rtol=0.0, atol=1e-9)


def test_ways_that_are_ruled_out_change_nothing(roadmap, monkeypatch):
    start, targets = roadmap.configurations[some_vertices(roadmap, 24, 2)], _hostile(roadmap, 24, 60, 3)
    q = []
    for many in (1, 10**9):
        monkeypatch.setattr("grr_torch.applications.motions._MANY", many)
        q.append(follow_targets(Teleoperator(roadmap, start=start), targets)[0])
    assert torch.equal(*q)


def test_joints_are_not_wrapped(planar_roadmap):
    """Round the base, joint values go on beyond π."""
    angles = torch.linspace(0.0, 4.0 * torch.pi, 400, dtype=torch.float64)
    targets = 0.6 * torch.stack([angles.cos(), angles.sin()], dim=1)
    q, _ = follow_targets(Teleoperator(planar_roadmap, max_step=0.2), targets)
    assert float(q.diff(dim=0).abs().max()) <= 0.2
    assert float((q[-1, 0] - q[0, 0]).abs()) > 6.0


@pytest.mark.parametrize("count", [1, 50, 320])
def test_any_number_of_arms_in_single_precision_track(count):
    robot = grr_torch.load_robot("kinova", dtype=torch.float32)
    roadmap = grr_torch.build(robot, "fixed-rotation", points=1200, refine=False)
    vertex = int(roadmap.resolved.nonzero()[roadmap.points[roadmap.resolved][:, 2].argmax()])
    way = torch.linspace(0.0, -0.03, 20, dtype=roadmap.points.dtype)[:, None, None] * torch.eye(3)[2]
    targets = (roadmap.points[vertex] + way).expand(-1, count, -1)
    teleoperator = Teleoperator(roadmap, start=roadmap.configurations[vertex].expand(count, -1))
    q, status = follow_targets(teleoperator, targets)
    assert q.dtype == torch.float32
    assert (status == "tracking").mean() > 0.8
    assert (roadmap.robot.forward_kinematics(q)[0] - targets).norm(dim=2).max() < 0.02


def test_no_step_is_longer_than_the_limits_in_single_precision_either(kinova_roadmap):
    roadmap = replace(kinova_roadmap, robot=grr_torch.load_robot("kinova", dtype=torch.float32))
    vertices = roadmap.resolved.nonzero()[:6, 0]
    start = roadmap.configurations[vertices].float()
    teleoperator = Teleoperator(roadmap, start=start)
    targets = roadmap.points[roadmap.resolved][-6:].float().expand(80, -1, -1)
    q, _ = follow_targets(teleoperator, targets)
    moved = torch.cat([start[None], q]).double().diff(dim=0).abs() * 50.0 / roadmap.robot.velocity_limits
    assert 0.9 < float(moved.max()) <= 1.0


@pytest.mark.parametrize("again", [False, True], ids=["built", "loaded"])
def test_a_robot_in_single_precision_is_solved_for_and_teleoperated(tmp_path, again):
    roadmap = grr_torch.build(
        grr_torch.load_robot("planar_5", dtype=torch.float32), "position", points=200, refine=False
    )
    if again:
        roadmap.save(tmp_path / "single.grr")
        roadmap = grr_torch.Roadmap.load(tmp_path / "single.grr")
    points = roadmap.points[roadmap.resolved]
    solution = roadmap.solve(points)
    assert solution.configurations.dtype == torch.float32
    assert bool(solution.valid.all())
    arm = Teleoperator(roadmap)
    for target in (points[0], points[1], points[1] * 3.0, points[2]):
        for _ in range(5):
            assert bool(arm.step(target).configuration.isfinite().all())


def test_routes_leave_out_the_edges_that_are_avoided(roadmap):
    routes = roadmap.routes
    goal, start = some_vertices(roadmap, 2, 17).tolist()
    cost, following = routes.towards(goal)
    avoided: frozenset[tuple[int, int]] = frozenset()
    for _ in range(3):
        avoided |= {(start, int(following[start]))}
        longer, following = routes.towards(goal, avoided)
        assert (start, int(following[start])) not in avoided
        assert longer[start] >= cost[start]
        assert (longer >= cost - 1e-12).all()
        cost = longer
    assert routes.towards(goal)[0][start] < cost[start], "others still take them"


def test_beside_a_joint_beyond_its_limit_the_others_keep_theirs(kinova):
    """Of a way to a standstill, whatever one joint is at."""
    robot, task = kinova, grr_torch.Position(3)
    follower = Follower(robot, task, Tolerances(), torch.full((7,), 0.04, dtype=torch.float64))
    gain = torch.full((7,), 1e-3, dtype=torch.float64)
    joints = (robot.upper.isfinite() & ~robot.continuous).nonzero()[:2, 0].tolist()
    q = robot.sample(200, torch.Generator().manual_seed(0))
    q[:, joints[1]] = robot.upper[joints[1]] - 0.01
    motion = torch.zeros_like(q)
    motion[:, joints[1]] = 0.02
    for outside in (0.0, 1e-3):
        q[:, joints[0]] = robot.upper[joints[0]] + outside
        nowhere = torch.full_like(q, torch.nan)
        moved = limit_acceleration(follower, gain, q, motion, q + motion, nowhere)
        assert bool((moved[:, joints[1]] < 0.02).all())
        back = motion.clone()
        back[:, joints[1]], back[:, joints[0]] = 0.0, -1e-3
        inward = limit_acceleration(follower, gain, q, torch.zeros_like(q), q + back, nowhere)
        assert bool((inward[:, joints[0]] < 0.0).any())


def test_a_reset_forgets_the_target_and_not_the_speed(roadmap):
    vertices = some_vertices(roadmap, 2, 11)
    start, goal = roadmap.configurations[vertices[0]], roadmap.points[vertices[1]]
    teleoperator = Teleoperator(roadmap, start=start, acceleration_limits=2.0)
    q = [start] + [teleoperator.step(goal).configuration for _ in range(25)]
    teleoperator.reset()
    q += [teleoperator.step(roadmap.points[vertices[0]]).configuration for _ in range(25)]
    accelerations = torch.stack(q).diff(dim=0).diff(dim=0).abs() * 50.0**2
    assert float(accelerations.max()) <= 2.0 * (1.0 + 1e-6)
    teleoperator.reset(q[-1])
    still = teleoperator.step(torch.full((3,), torch.nan, dtype=torch.float64))
    assert torch.equal(still.configuration, q[-1])
