"""Which points of a task space a robot can reach at all."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from grr_torch.errors import ParameterError, check_seed
from grr_torch.progress import Progress, silent
from grr_torch.projection.project import DEFAULT_TOLERANCES, Tolerances, project_columns
from grr_torch.resolution.checkpoint import UNKEPT, Stage
from grr_torch.robots.robot import Robot
from grr_torch.spaces.task import TaskSpace

# random starts that a point gets before those that were reached are set aside
_ROUND = 4
# of a box: random configurations; of those farthest out to each side, how many are varied, how often, and in how many
# rounds: long arms are hardly ever stretched by chance
_DRAWN, _FARTHEST, _VARIED, _VARIATIONS = 10_000, 8, 32, 40
# metres below which a tool does not move
_STILL = 1e-5


def measure_reachability(
    robot: Robot,
    task: TaskSpace,
    points: Tensor,
    attempts: int,
    *,
    seed: int = 0,
    tolerances: Tolerances = DEFAULT_TOLERANCES,
    progress: Progress = silent,
    kept: Stage = UNKEPT,
) -> Tensor:
    """Which points some random-start projection reaches free of self-collision: (V,) bool, on the CPU.

    Args:
        robot: The robot.
        task: The task space.
        points: (V, width) points.
        attempts: Random starts for each point.
        seed: Of the random starts.
        tolerances: Of the projections.
        progress: Told how many starts were tried for each point.
        kept: Where it is kept how far that is.

    Raises:
        ParameterError: `attempts` is below 1.
    """
    if attempts < 1:
        raise ParameterError("reachability", attempts, "1 or more random starts a vertex")
    generator = torch.Generator().manual_seed(check_seed(seed))
    reached = torch.zeros(len(points), dtype=torch.bool)
    begin = 0
    if state := kept.state():
        reached, begin = state["reached"], int(state["done"])
        generator.set_state(state["generator"])
    left = (within_reach(robot, task, points) & ~reached).nonzero()[:, 0]
    for done in range(begin, attempts, _ROUND):
        progress("measuring reachability", done, attempts)
        starts = min(_ROUND, attempts - done)
        reached[left] = from_random_starts(robot, task, points[left], starts, generator, tolerances)[1].any(1)
        left = left[~reached[left]]
        end = done + starts
        state = {"reached": reached, "generator": generator.get_state(), "done": torch.tensor(end)}
        kept.keep(state, last=end == attempts)
    progress("measuring reachability", attempts, attempts)
    return reached


def from_random_starts(
    robot: Robot, task: TaskSpace, points: Tensor, starts: int, generator: torch.Generator, tolerances: Tolerances
) -> tuple[Tensor, Tensor]:
    """Projections of random configurations: (V, starts, n), NaN where not valid, and valid (V, starts); on the CPU."""
    guesses = robot.sample(len(points) * starts, generator)
    targets = points.repeat_interleave(starts, dim=0).to(guesses)
    solved, valid = project_columns(robot, task, targets.T.contiguous(), guesses.T.contiguous(), tolerances)
    return solved.T.cpu().reshape(len(points), starts, robot.n), valid.cpu().reshape(len(points), starts)


def within_reach(robot: Robot, task: TaskSpace, points: Tensor) -> Tensor:
    """Points (V,) no farther from the first joint than the arm is long: what lies beyond cannot be reached.

    Where rotation varies but is given, the last joint has to be within the reach of what comes before it as well.
    """
    centre, radius = reach(robot)
    d = task.dimension
    points = points.cpu()
    inside = (points[:, :d] - centre[:d]).norm(dim=1) <= radius + 1e-6
    tree = robot.tree
    turned = task.matrices(points.T) if task.rotations is not None else None
    if turned is None or tree.links[tree.tool][0] != tree.path[-1] or not tree.joints[tree.path[-1]].revolute:
        return inside
    # frames are stored with their axes as rows
    mount = tree.links[tree.tool][1].cpu().to(points)
    hand = mount[:3, :3] @ mount[3, :3]
    if d == 2 and bool((_some_poses(robot)[1][:, 2, 2] < 0.0).all()):
        # of a tool that points down, a yaw is what is left of a rotation that turns it over
        hand = hand * hand.new_tensor([1.0, -1.0, -1.0])
    wrist = points[:, :d] - torch.einsum("ijN,j->Ni", turned, hand)[:, :d]
    return inside & ((wrist - centre[:d]).norm(dim=1) <= radius - float(hand.norm()) + 1e-6)


def reach(robot: Robot) -> tuple[Tensor, float]:
    """A ball that holds every tool position: centre (3,) and radius [m], inf with unlimited sliding joints.

    The radius is the sum of the fixed distances between successive joints, and of the lengths that joints slide.
    """
    tree = robot.tree
    radius = 0.0
    for index in tree.path:
        joint, mount = tree.joints[index], tree.mounts[index]
        if index != tree.path[0]:
            radius += float(mount[3, :3].norm())
        if not joint.revolute:
            ends = torch.stack([robot.lower[joint.dof], robot.upper[joint.dof]])
            radius += float((joint.multiplier * ends + joint.offset).abs().max())
    radius += float(tree.links[tree.tool][1][3, :3].norm())
    return tree.mounts[tree.path[0]][3, :3].cpu(), radius


def stays_upright(robot: Robot) -> bool:
    """Whether the tool's z axis stays along that of the base, over random configurations."""
    rotation = _some_poses(robot)[1]
    return bool(((rotation[:, 2, 2].abs() - 1.0).abs() < 1e-5).all())


def stays_in_plane(robot: Robot) -> bool:
    """Whether the tool stays upright and at one z, over random configurations."""
    z = _some_poses(robot)[0][:, 2]
    return stays_upright(robot) and bool((z - z[0]).abs().max() < _STILL)


def _some_poses(robot: Robot) -> tuple[Tensor, Tensor]:
    return robot.forward_kinematics(robot.sample(64, torch.Generator().manual_seed(0)))


def reach_box(robot: Robot, axes: int) -> list[tuple[float, float]]:
    """A box that holds what the arm reaches: (low, high) of each axis [m], rounded outwards.

    From tool positions of random configurations, of which those farthest out are varied; the same each time.

    Args:
        robot: The robot.
        axes: 2 or 3.

    Raises:
        ParameterError: A sliding joint has no limits, or the tool does not move along an axis.
    """
    wanted = "(low, high) of each axis (--bounds)"
    if not math.isfinite(reach(robot)[1]):
        raise ParameterError("bounds", "nothing", f"{wanted}, as a sliding joint of {robot.name} has no limits")
    generator = torch.Generator().manual_seed(0)
    q = robot.sample(_DRAWN, generator)
    places = robot.forward_kinematics(q)[0][:, :axes]
    for _ in range(_VARIATIONS):
        farthest = torch.cat([side.topk(_FARTHEST, dim=0).indices for side in (places, -places)]).flatten()
        parents = q[farthest].repeat(_VARIED, 1)
        redrawn = torch.rand(parents.shape, dtype=q.dtype, generator=generator).to(q.device) < 1.0 / robot.n
        children = torch.where(redrawn, robot.sample(len(parents), generator), parents)
        q = torch.cat([q[farthest], children])
        places = robot.forward_kinematics(q)[0][:, :axes]
    low, high = places.amin(0).cpu().double(), places.amax(0).cpu().double()
    for name, extent in zip("xyz", (high - low).tolist(), strict=False):
        if extent < _STILL:
            raise ParameterError(
                "bounds", "nothing", f"{wanted}, as the tool of {robot.name} does not move along {name}"
            )
    digits = 1 - math.floor(math.log10(float((high - low).max())))
    scale = 10.0**digits
    # what is on the border but for rounding is not outside
    low, high = (low * scale + 1e-3).floor() / scale, (high * scale - 1e-3).ceil() / scale
    return [(round(a, digits), round(b, digits)) for a, b in zip(low.tolist(), high.tolist(), strict=True)]
