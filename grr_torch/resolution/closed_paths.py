"""Candidates for seeds: configurations on closed paths round the base.

A path starts from one configuration, a medoid of the self-motion manifold of some point, and is led once round the
axis of the first joint. Turned rigidly with that joint and projected, a posture that the task allows all round closes
on itself, as repeatable inverse kinematics asks.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from grr_torch.errors import SeedError
from grr_torch.projection.project import Tolerances, project_columns
from grr_torch.resolution.reachability import from_random_starts, within_reach
from grr_torch.resolution.seeds import in_the_middle
from grr_torch.robots.crowding import crowding
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import distance, wrap
from grr_torch.spaces.graph import TaskGraph
from grr_torch.spaces.task import TaskSpace

# of each point's self-motion manifold, random starts and medoids; each medoid gives two paths
_STARTS = 48
_MEDOIDS = 3
# points that are tried, as a multiple of those that are kept
_TRIED = 3
# of random configurations in self-collision, the share above which they may be why no point was reached
_TELLING = 0.5
# configurations on a closed path
_STATIONS = 12


def closed_paths(
    robot: Robot, task: TaskSpace, graph: TaskGraph, count: int, generator: torch.Generator, tolerances: Tolerances
) -> tuple[list[Tensor], float]:
    """Closed paths from random points of a task graph.

    Args:
        robot: The robot.
        task: The task space.
        graph: The task graph.
        count: How many paths are looked for.
        generator: Of the random draws.
        tolerances: Of the projections.

    Returns:
        About so many tables of configurations (S, n), near the middle of the limits, and the share of the graph that is
        reachable, by a sample of it.

    Raises:
        SeedError: No point was reached from random starts.
    """
    anchors = -(-count // (2 * _MEDOIDS))
    points, medoids, share = _medoids(robot, task, graph, anchors, generator, tolerances)
    paths = _led_round(robot, task, points, medoids, tolerances)
    return [in_the_middle(robot, path) for path in paths], share


def _medoids(
    robot: Robot, task: TaskSpace, graph: TaskGraph, anchors: int, generator: torch.Generator, tolerances: Tolerances
) -> tuple[Tensor, Tensor, float]:
    """Points (K, width), at each a configuration (K, n) far from others found there, and what share was reached.

    Raises:
        SeedError: No point was reached.
    """
    inside = within_reach(robot, task, graph.points).nonzero()[:, 0]
    chosen = inside[torch.randperm(len(inside), generator=generator)[: _TRIED * anchors]]
    configurations, valid = from_random_starts(robot, task, graph.points[chosen], _STARTS, generator, tolerances)
    configurations = configurations.to(robot.device)
    # where most starts succeed the arm has room
    best = valid.sum(1).argsort(descending=True, stable=True)[:anchors].tolist()
    points: list[Tensor] = []
    medoids: list[Tensor] = []
    for anchor in best:
        found = configurations[anchor][valid[anchor]]
        if len(found) == 0:
            continue
        apart = distance(found[:, None], found[None], robot.continuous)
        picked = [int(apart.sum(1).argmin())]
        while len(picked) < min(_MEDOIDS, len(found)):
            picked.append(int(apart[:, picked].amin(1).argmax()))
        medoids.append(found[picked])
        points.append(graph.points[chosen[anchor]].to(found).expand(len(picked), -1))
    if not medoids:
        crowded = crowding(robot, _TELLING)
        why = f", free of self-collision: {crowded}" if crowded else ""
        tried = f"none of {len(chosen)} points was reached from {_STARTS} random starts"
        raise SeedError(f"no seeds were found: {tried}{why}")
    share = len(inside) / len(graph.points) * float(valid.any(1).double().mean())
    return torch.cat(points), torch.cat(medoids), share


def _led_round(
    robot: Robot, task: TaskSpace, points: Tensor, configurations: Tensor, tolerances: Tolerances
) -> list[Tensor]:
    """For each configuration (K, n), the valid ones (S, n) on a closed path round the first joint's axis.

    The next station is guessed in two ways: turned rigidly with the first joint, or as it is.
    """
    tree = robot.tree
    first = tree.path[0]
    joint, mount = tree.joints[first], tree.mounts[first]
    if not joint.revolute:
        return [q[None] for q in configurations]
    axis, origin = mount[2, :3], mount[3, :3]
    angles = [2.0 * math.pi * k / _STATIONS for k in range(_STATIONS)]
    stations = torch.stack([_turned(task, points, axis, origin, angle) for angle in angles])
    stations = torch.cat([stations, stations], dim=1)
    turn = configurations.new_tensor([2.0 * math.pi / _STATIONS, 0.0]).repeat_interleave(len(configurations))
    q = torch.cat([configurations, configurations])
    found: list[Tensor] = []
    reached: list[Tensor] = []
    for k, station in enumerate(stations):
        guess = q.clone()
        if k:
            guess[:, joint.dof] = wrap(guess[:, joint.dof] + turn)
        guess = guess.clamp(robot.lower, robot.upper)
        solved, valid = project_columns(robot, task, station.T.contiguous(), guess.T.contiguous(), tolerances)
        q = torch.where(valid[:, None], solved.T, guess)
        found.append(q)
        reached.append(valid)
    rings, there = torch.stack(found, dim=1), torch.stack(reached, dim=1)
    paths = [ring[mask] for ring, mask in zip(rings, there, strict=True) if int(mask.sum()) > _STATIONS // 2]
    return paths or [q[None] for q in configurations]


def _turned(task: TaskSpace, points: Tensor, axis: Tensor, origin: Tensor, angle: float) -> Tensor:
    """Points (K, width) turned about an axis in space; in the plane, about where it crosses."""
    d = task.dimension
    arms = torch.zeros(len(points), 3, dtype=points.dtype, device=points.device)
    arms[:, :d] = points[:, :d] - origin[:d]
    along = (arms @ axis)[:, None] * axis
    across = arms - along
    turned = along + math.cos(angle) * across + math.sin(angle) * torch.linalg.cross(axis.expand_as(across), across)
    moved = origin[:d] + turned[:, :d]
    if task.rotations is None:
        return moved
    return torch.cat([moved, task.rotations.turned(points[:, d:], axis, angle)], dim=1)
