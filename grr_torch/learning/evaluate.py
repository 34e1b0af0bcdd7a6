"""How good an inverse kinematics that is a function of the point is: a network, or the roadmap itself."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from grr_torch.errors import ParameterError, check_whole
from grr_torch.learning.refine import newton_steps
from grr_torch.learning.region import Region, certified_region
from grr_torch.learning.split import SPLITS, Split
from grr_torch.projection.project import Tolerances, point_columns
from grr_torch.spaces.configuration import difference

if TYPE_CHECKING:
    from grr_torch.learning.neural_ik import NeuralIK
    from grr_torch.resolution.roadmap import Roadmap

# gives configurations (N, n) for points (N, d)
Solver = Callable[[Tensor], Tensor]

# what counts as exact [m, rad]
_EXACT_POSITION, _EXACT_ROTATION = 1e-4, math.radians(0.1)
# waypoints of a line in a centimetre, and lines and loops drawn
_PER_CENTIMETRE = 10
_LINES, _LOOPS, _LOOP_POINTS = 200, 64, 100
# points drawn at once to find some of a part, and how often
_DRAWN, _MOST_DRAWS = 1 << 14, 200
# poses at once for the speed of a batch, and calls of which medians are taken
_BATCH, _CALLS = 100_000, 5


@dataclass(frozen=True)
class Statistics:
    """Of a sample."""

    mean: float
    median: float
    p95: float
    p99: float
    largest: float

    @staticmethod
    def of(values: Tensor) -> Statistics:
        """Those of values (N,)."""
        median, p95, p99 = np.quantile(values.cpu().numpy(), [0.5, 0.95, 0.99]).tolist()
        return Statistics(float(values.mean()), median, p95, p99, float(values.max()))


@dataclass(frozen=True)
class PoseErrors:
    """Where the tool is after some Newton steps.

    Attributes:
        steps: How many.
        millimetres: Distance from tool to point [mm].
        degrees: Rotation error [°]; zero where rotation is free.
        exact: Share within 0.1 mm and 0.1°.
    """

    steps: int
    millimetres: Statistics
    degrees: Statistics
    exact: float


@dataclass(frozen=True)
class Continuity:
    """How far the arm moves where its tool moves a little.

    Attributes:
        step: Largest change of a joint over a centimetre of random lines in the certified cells [rad or m].
        p999: What 99.9 % of such changes stay below.
        closure: Largest difference of a joint between the end and the start of closed loops [rad or m].
    """

    step: float
    p999: float
    closure: float


@dataclass(frozen=True)
class Evaluation:
    """What is measured of a network.

    Attributes:
        points: How many held-out points the errors are of.
        errors: After 0, 1 and 2 Newton steps.
        continuity: Of the network alone.
        roadmap: Of the roadmap on the same lines and loops.
        newton_closure: Difference after the same loops where each point is solved by Newton steps from the one before.
        beyond_limits: Share of held-out points where the network alone gives a joint beyond its limits.
        in_self_collision: Share where it gives a self-collision.
        from_map: Largest joint difference to the roadmap's configuration, mean over the held-out points [rad or m].
        poses_per_second: Of the network in a large batch.
        one_pose: Time for one [s].
    """

    points: int
    errors: tuple[PoseErrors, ...]
    continuity: Continuity
    roadmap: Continuity
    newton_closure: float
    beyond_limits: float
    in_self_collision: float
    from_map: float
    poses_per_second: float
    one_pose: float

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def evaluate_ik(ik: NeuralIK, roadmap: Roadmap, *, points: int = 20_000, seed: int = 1) -> Evaluation:
    """Measures a network on points that it was not trained on.

    Args:
        ik: The network.
        roadmap: The roadmap that it learned.
        points: How many points of the test part of its split are drawn.
        seed: Of points, lines and loops.

    Raises:
        ParameterError: The network learned another roadmap, or there are no such points.
    """
    check_origin(ik, roadmap)
    generator = torch.Generator().manual_seed(seed)
    region = certified_region(roadmap)
    held_out = draw_part(roadmap, region, split_of(ik), "test", points, generator)
    q = ik(held_out)
    lines, loops = draw_lines(region, generator), draw_loops(region, generator)
    solved = roadmap.solve(held_out)
    apart = difference(q, solved.configurations, roadmap.robot.continuous).abs().amax(1)
    batch = held_out.repeat(-(-_BATCH // len(held_out)), 1)[:_BATCH]
    return Evaluation(
        points=points,
        errors=tuple(pose_errors(roadmap, held_out, q, steps) for steps in (0, 1, 2)),
        continuity=continuity(roadmap, ik, lines, loops),
        roadmap=continuity(roadmap, lambda p: roadmap.solve(p).configurations, lines, loops),
        newton_closure=newton_closure(roadmap, ik(loops[:, 0]), loops),
        beyond_limits=float((~roadmap.robot.within_limits(q)).double().mean()),
        in_self_collision=float(roadmap.robot.in_self_collision(q).double().mean()),
        from_map=float(apart[solved.valid].mean()),
        poses_per_second=_BATCH / median_time(lambda: ik(batch)),
        one_pose=median_time(lambda: ik(held_out[0]), 200),
    )


def check_origin(ik: NeuralIK, roadmap: Roadmap) -> None:
    """Finds out whether a network learned a roadmap.

    Raises:
        ParameterError: It learned another one.
    """
    from grr_torch.resolution.roadmap_file import roadmap_hash

    if roadmap_hash(roadmap) != ik.origin.roadmap_hash:
        raise ParameterError("roadmap", roadmap, f"the one that the weights were trained on, {ik.origin.roadmap_hash}")


def split_of(ik: NeuralIK) -> Split:
    """How the samples of a network were parted."""
    return Split(**ik.origin.training["options"]["split"])


def draw_part(
    roadmap: Roadmap, region: Region, split: Split, part: str, count: int, generator: torch.Generator
) -> Tensor:
    """Points (count, d) of one part of a split.

    Raises:
        ParameterError: The part has none, or the count is not valid.
    """
    count = check_whole("points", count, 1)
    splitter = split.of(roadmap)
    found: list[Tensor] = []
    for _ in range(_MOST_DRAWS + count // _DRAWN):
        points = region.draw(_DRAWN, generator)
        found.append(points[splitter(points) == SPLITS.index(part)])
        if sum(map(len, found)) >= count:
            return torch.cat(found)[:count]
    raise ParameterError("split", f"one whose {part} part has no {count:,} points", "a larger share, or smaller blocks")


def pose_errors(roadmap: Roadmap, points: Tensor, q: Tensor, steps: int = 0) -> PoseErrors:
    """Errors of configurations (N, n) at points (N, d) after some Newton steps."""
    robot, task = roadmap.robot, roadmap.task
    if steps:
        q = newton_steps(robot, task, points, q, steps, Tolerances())[0]
    position, rotation = robot.forward_kinematics(q)
    targets = point_columns(robot, task, points)
    errors = task.residuals(task.error(targets, position.T, rotation.permute(1, 2, 0)))
    exact = (errors[0] <= _EXACT_POSITION) & (errors[1] <= _EXACT_ROTATION)
    return PoseErrors(
        steps,
        Statistics.of(1e3 * errors[0]),
        Statistics.of(errors[1].rad2deg()),
        float(exact.double().mean()),
    )


def draw_lines(region: Region, generator: torch.Generator) -> Tensor:
    """(W, 11, d) windows of a centimetre, every millimetre of random lines, that lie in the region."""
    ends = region.draw(2 * _LINES, generator).reshape(_LINES, 2, -1)
    windows: list[Tensor] = [region.corners.new_empty(0, _PER_CENTIMETRE + 1, region.corners.shape[2])]
    for start, end in ends:
        count = int((end - start).norm() * 100.0 * _PER_CENTIMETRE)
        direction = (end - start) / max(float((end - start).norm()), 1e-12)
        line = start + 0.01 / _PER_CENTIMETRE * torch.arange(count + 1)[:, None] * direction
        if len(line) > _PER_CENTIMETRE:
            whole = region.contains(line).unfold(0, _PER_CENTIMETRE + 1, 1).all(1)
            windows.append(line.unfold(0, _PER_CENTIMETRE + 1, 1).mT[whole])
    return torch.cat(windows)


def draw_loops(region: Region, generator: torch.Generator) -> Tensor:
    """(L, waypoints, d) circles in the region that end where they begin; the largest that fit of a few radii."""
    d = region.corners.shape[2]
    size = float(region.volumes.sum()) ** (1.0 / d)
    turns = torch.linspace(0.0, 2.0 * math.pi, _LOOP_POINTS, dtype=torch.float64)
    ring = torch.stack([turns.cos(), turns.sin()], dim=1)
    ring[-1] = ring[0]
    found: list[Tensor] = []
    for share in (0.2, 0.1, 0.05, 0.02, 0.005):
        centres = region.draw(4 * _LOOPS, generator)
        planes = torch.linalg.qr(torch.randn(len(centres), d, 2, dtype=torch.float64, generator=generator))[0]
        loops = centres[:, None] + share * size * ring @ planes.mT
        inside = region.contains(loops.reshape(-1, d)).reshape(len(loops), -1).all(1)
        found.append(loops[inside])
        if sum(map(len, found)) >= _LOOPS:
            break
    return torch.cat(found)[:_LOOPS]


def continuity(roadmap: Roadmap, solver: Solver, lines: Tensor, loops: Tensor) -> Continuity:
    """Measures a solver on windows (W, 11, d) of lines and on loops (L, waypoints, d)."""
    wraps = roadmap.robot.continuous
    first, last = solver(lines[:, 0]), solver(lines[:, -1])
    # a jump within the window shows at its ends, but for one there and back
    steps = difference(first, last, wraps).abs().amax(1)
    turned = difference(solver(loops[:, 0]), solver(loops[:, -1]), wraps).abs()
    return Continuity(_quantile(steps, 1.0), _quantile(steps, 0.999), _quantile(turned, 1.0))


def _quantile(values: Tensor, share: float) -> float:
    """Of the values that are finite; NaN if none is."""
    kept = values[values.isfinite()]
    return float(np.quantile(kept.cpu().numpy(), share)) if kept.numel() else math.nan


def newton_closure(roadmap: Roadmap, start: Tensor, loops: Tensor) -> float:
    """Largest joint difference [rad or m] after following loops (L, W, d) by Newton steps from where the arm stands."""
    q = start
    first = newton_steps(roadmap.robot, roadmap.task, loops[:, 0], start, 3, Tolerances())[0]
    q = first
    for points in loops[:, 1:].unbind(1):
        q = newton_steps(roadmap.robot, roadmap.task, points, q, 3, Tolerances())[0]
    turned = difference(first, q, roadmap.robot.continuous).abs()
    return _quantile(turned, 1.0)


def median_time(call: Callable[[], Any], calls: int = _CALLS) -> float:
    """Median time of a call [s]."""
    call()
    times = []
    for _ in range(calls):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return sorted(times)[len(times) // 2]
