"""Self-motion manifolds: all configurations whose tool is at one point, and the families they fall into."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from grr_torch.applications.components import joint_ranges, places
from grr_torch.applications.sample_manifold import Sampler
from grr_torch.applications.trace_curves import Curves, End, Tracer
from grr_torch.errors import ParameterError, check_kind, check_seed, check_whole
from grr_torch.progress import Progress, silent
from grr_torch.projection.continuity import is_continuous
from grr_torch.projection.project import DEFAULT_TOLERANCES, Tolerances, point_columns, project, project_columns
from grr_torch.resolution.problem import check_task
from grr_torch.resolution.reachability import reach
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.robots.robot import Robot
from grr_torch.spaces.configuration import difference, distance
from grr_torch.spaces.task import TaskSpace

_MOST_SAMPLES = 100_000
# step [rad] along a curve, and on manifolds of more dimensions
_CURVE_STEP, _STEP = 0.05, 0.3
# samples are this close [m, rad], or as close as is asked for: curves are to be smooth
_POSITION, _ROTATION = 1e-6, 1e-5
# samples that a configuration is held against
_TRIED = 10


@dataclass(frozen=True, eq=False)
class SelfMotionManifold:
    """Samples of a self-motion manifold {q : FK(q) = p} within joint limits; tensors live on the CPU.

    Components are the sets between which no self-motion within limits leads, such as elbow up and elbow down. Whether
    the arm touches itself plays no part in this: samples in self-collision are kept, and `free` tells which are not.

    Attributes:
        robot: The robot.
        task: The task space.
        point: (width,) the point p.
        dimension: Joints to spare: n minus the equations of the task.
        configurations: (S, n) [rad or m], continuous joints in [−π, π]; one component after the other. On a curve they
            are in its order.
        component: (S,) which component each sample belongs to, from 0; numbered by where the components lie, so that
            the same ones come out in the same order from any random draw.
        free: (S,) bool, free of self-collision.
        edges: (E, 2) samples joined by a checked self-motion; on curves, each sample and the next.
        ends: (C, 2) for curves, the `End` at either end of each component; None in more dimensions.
    """

    robot: Robot
    task: TaskSpace
    point: Tensor
    dimension: int
    configurations: Tensor
    component: Tensor
    free: Tensor
    edges: Tensor
    ends: Tensor | None

    def __repr__(self) -> str:
        return (
            f"SelfMotionManifold({self.robot.name}, {self.task.kind}, dimension {self.dimension}, "
            f"{self.components} components, {len(self.configurations)} samples)"
        )

    @property
    def components(self) -> int:
        """How many components were found."""
        return int(self.component.max()) + 1

    @property
    def closed(self) -> Tensor:
        """Which components (C,) are closed curves; none where the dimension is not 1."""
        if self.ends is None:
            return torch.zeros(self.components, dtype=torch.bool)
        return (self.ends == End.CLOSED).all(1)

    def curve(self, component: int) -> Tensor:
        """Configurations (T, n) along a component in order, unwrapped: without jumps of 2π.

        A closed one ends with the configuration it began with, some joints perhaps full turns later.

        Raises:
            ParameterError: There is no such component, or the manifold has more than one dimension.
        """
        if self.ends is None:
            raise ParameterError("dimension", self.dimension, "1: only there components are curves")
        if not 0 <= component < self.components:
            raise ParameterError("component", component, f"0 to {self.components - 1}")
        q = self.configurations[self.component == component]
        if bool(self.closed[component]):
            q = torch.cat([q, q[:1]])
        steps = difference(q[:-1], q[1:], self.robot.continuous.cpu())
        return torch.cat([q[:1], q[:1] + steps.cumsum(0)])

    def ranges(self) -> Tensor:
        """The values (C, n, 2) that each joint takes on each component: lowest and highest, as far as sampled.

        Those of a continuous joint are the shortest arc that holds them, its lower end in [−π, π]; where no gap above
        0.3 rad is left, all of [−π, π].
        """
        turns = self.robot.continuous.cpu()
        return torch.stack(
            [joint_ranges(self.configurations[self.component == label], turns) for label in range(self.components)]
        )

    def component_of(self, configuration: Tensor) -> int | None:
        """The component that a configuration (n,) at the point lies on; None if no near sample is joined to it."""
        q = configuration.to(self.configurations)
        nearest = distance(self.configurations, q, self.robot.continuous.cpu()).argsort()[:_TRIED]
        points = self.point.expand(len(nearest), -1)
        bare = replace(self.robot, spheres=None)
        there = self.configurations[nearest]
        joined = is_continuous(bare, self.task, points, points, q.expand_as(there), there, c=0.8, epsilon=0.05).cpu()
        return int(self.component[nearest[joined][0]]) if bool(joined.any()) else None


def self_motion_manifold(
    robot: Robot,
    task: TaskSpace,
    point: Tensor | Sequence[float],
    *,
    samples: int = 1000,
    step: float | None = None,
    seed: int = 0,
    tolerances: Tolerances = DEFAULT_TOLERANCES,
    progress: Progress = silent,
) -> SelfMotionManifold:
    """Samples the self-motion manifold of a point and finds its connected components (Burdick 1989).

    With one joint to spare the manifold is curves. Random starts are projected onto it, and each curve that one of
    them falls on is traced along the null vector of the Jacobian until it closes, or to joint limits both ways.
    With more to spare, the samples are projected random starts and random steps from them along the manifold; near
    ones are joined where the continuity check at the one point passes, and what hangs together is a component.

    Args:
        robot: The robot.
        task: The task space; it must leave at least one joint to spare.
        point: (width,) the point of the task space.
        samples: Random starts; in more than one dimension how many samples there are at most, half as many starts
            among them. Components on which no start falls are missed.
        step: Longest step along a curve, 0.05 by default, or length of the random steps, 0.3 by default [rad].
        seed: Of all random draws.
        tolerances: When a configuration counts as being at the point; samples are within 1e-6 m and 1e-5 rad at least.
        progress: Told what is being done and how far it is.

    Returns:
        The samples and their components. On a point where the manifold is singular (one at the end of reach, or where
        curves cross), curves may be cut there, or be joined straight across; `ends` says where they are cut.

    Raises:
        ParameterError: The point is not one of the task, not finite, or not reached from any start; there is no joint
            to spare; `samples`, `step` or `seed` is out of its range.
    """
    check_kind("robot", robot, Robot, "load_robot('kinova')")
    check_kind("task", task, TaskSpace, "Position(3)")
    check_task(robot, task)
    dimension = robot.n - task.constraints
    if dimension < 1:
        given = f"{task.kind} with {task.constraints} equations for {robot.n} joints"
        raise ParameterError("task", given, "fewer equations than joints: no motion is left otherwise")
    step = (_CURVE_STEP if dimension == 1 else _STEP) if step is None else step
    if not 1e-3 <= step <= 0.5:
        raise ParameterError("step", step, "0.001 to 0.5 rad")
    samples = check_whole("samples", samples, 1, _MOST_SAMPLES)
    target = _target(robot, task, point)
    close = replace(
        tolerances, position=min(tolerances.position, _POSITION), rotation=min(tolerances.rotation, _ROTATION)
    )
    # components are those within limits, self-collision or not
    bare = replace(robot, spheres=None)
    generator = torch.Generator().manual_seed(check_seed(seed))
    with torch.no_grad():
        if dimension == 1:
            starts = _starts(bare, task, target, samples, generator, close)
            curves = Tracer(bare, task, target, float(step), close).all_curves(starts, progress)
            return _of_curves(robot, task, target, curves)
        starts = _starts(bare, task, target, -(-samples // 2), generator, close)
        sampler = Sampler(bare, task, target, float(step), close, generator)
        return _of_samples(robot, task, target, *sampler.components(starts, samples, progress))


def roadmap_choice(
    roadmap: Roadmap, point: Tensor | Sequence[float], *, tolerances: Tolerances = DEFAULT_TOLERANCES
) -> Tensor | None:
    """The configuration (n,) that a roadmap's nearest resolved vertex leads to at a point.

    That of the vertex itself where the point is one, else its projection onto the point. None where that fails.

    Args:
        roadmap: The roadmap.
        point: (width,) the point of the task space.
        tolerances: Of the projection.

    Raises:
        ParameterError: The point is not one of the roadmap's task, or not finite.
    """
    target = _target(roadmap.robot, roadmap.task, point)[:, 0].cpu()
    vertices = roadmap.resolved.nonzero()[:, 0]
    if len(vertices) == 0:
        return None
    gaps = roadmap.task.distance(roadmap.points[vertices].to(target), target)
    vertex = vertices[gaps.argmin()]
    if float(gaps.min()) == 0.0:
        return roadmap.configurations[vertex]
    solved, valid = project(roadmap.robot, roadmap.task, target, roadmap.configurations[vertex], tolerances=tolerances)
    return solved.cpu() if bool(valid) else None


def _target(robot: Robot, task: TaskSpace, point: Tensor | Sequence[float]) -> Tensor:
    """The point as a column (width, 1)."""
    try:
        row = point if isinstance(point, Tensor) else torch.tensor(point, dtype=torch.float64)
    except (ValueError, TypeError, RuntimeError) as error:
        raise ParameterError("point", point, f"{task.width} numbers") from error
    if row.shape != (task.width,):
        raise ParameterError("point shape", tuple(row.shape), f"({task.width},): one point")
    return point_columns(robot, task, row[None])


def _starts(
    robot: Robot, task: TaskSpace, target: Tensor, count: int, generator: torch.Generator, tolerances: Tolerances
) -> Tensor:
    """Configurations (n, K) at the point, projected from random ones.

    Raises:
        ParameterError: No projection succeeds.
    """
    guesses = robot.sample(count, generator).T.contiguous()
    solved, valid = project_columns(robot, task, target.expand(-1, count).contiguous(), guesses, tolerances, False)
    if not bool(valid.any()):
        centre, radius = reach(robot)
        given, middle = (", ".join(f"{value:.4g}" for value in row) for row in (target[:, 0].tolist(), centre.tolist()))
        gap = float((target[: task.dimension, 0].cpu() - centre[: task.dimension]).norm())
        why = (
            f"it lies {gap:.3g} m from the first joint" if gap > radius else f"none of {count} random starts led there"
        )
        valid_points = f"a point that {robot.name} reaches by {task.kind}, within {radius:.3g} m of ({middle})"
        raise ParameterError("point", f"({given}), which is not reachable: {why}", valid_points)
    return solved[:, valid.nonzero()[:, 0]]


def _of_curves(robot: Robot, task: TaskSpace, target: Tensor, curves: Curves) -> SelfMotionManifold:
    """The manifold made of curves."""
    q = curves.configurations.T
    last = torch.cat([curves.curve[1:] != curves.curve[:-1], torch.ones_like(curves.curve[:1], dtype=torch.bool)])
    # weights by length: the mean of a curve must not depend on where its samples fall
    onward = torch.where(last, 0.0, distance(q, q.roll(-1, 0), robot.continuous))
    weights = onward + onward.roll(1) + 1e-9
    rank = places(q, weights, curves.curve, robot.continuous).argsort()
    curves = curves.take(rank)
    samples = torch.arange(len(q), device=q.device)
    starts = torch.searchsorted(curves.curve, torch.arange(len(rank), device=q.device))
    last = torch.cat([curves.curve[1:] != curves.curve[:-1], last[-1:]])
    following = torch.where(last, starts[curves.curve], samples + 1)
    kept = ~last | (curves.ends == End.CLOSED).all(1)[curves.curve]
    edges = torch.stack([samples, following], 1)[kept & (samples != following)]
    return _manifold(robot, task, target, curves.configurations.T, curves.curve, edges, curves.ends)


def _of_samples(
    robot: Robot, task: TaskSpace, target: Tensor, q: Tensor, component: Tensor, edges: Tensor
) -> SelfMotionManifold:
    """The manifold made of samples (n, S), each in a component (S,), joined by edges (E, 2)."""
    where = places(q.T, torch.ones_like(q[0]), component, robot.continuous)
    component = where.argsort().argsort()[component]
    rank = component.argsort(stable=True)
    return _manifold(robot, task, target, q.T[rank], component[rank], rank.argsort()[edges], None)


def _manifold(
    robot: Robot, task: TaskSpace, target: Tensor, q: Tensor, component: Tensor, edges: Tensor, ends: Tensor | None
) -> SelfMotionManifold:
    return SelfMotionManifold(
        robot=robot,
        task=task,
        point=target[:, 0].cpu(),
        dimension=robot.n - task.constraints,
        configurations=q.contiguous().cpu(),
        component=component.cpu(),
        free=~robot.in_self_collision(q).cpu(),
        edges=edges.cpu(),
        ends=None if ends is None else ends.cpu(),
    )
