"""The nearest point to a target that a roadmap can solve: what an arm goes to while the target cannot be reached."""

from __future__ import annotations

import math

import numpy as np
import torch

from grr_torch.applications.lines import Follower
from grr_torch.applications.solve import LAST_VALID, Solver
from grr_torch.pieces import LAST, NEXT, Array, Mask, norms
from grr_torch.spaces.task import TaskSpace

# metres around the last such point that are searched at most, and the share of it by level
_AROUND = 0.2
_SHARES = np.array([1.0, 0.2, 0.05])
LEVELS = len(_SHARES)
# directions across, in space, and how much they lean to the target
_SIDES = 6
_LEANS = (0.5, 0.0)
# a step between neighbouring points may change the configuration by so much a metre [rad/m], and so much in all [rad]
_SLOPE = 30.0
_LEAST = 0.05
# a radian of joint motion is made if it brings the tool so much nearer [m/rad]
_WORTH = 0.02
# a configuration farther than this from its neighbours' average is near full stretch [rad]
_STRETCHED = 0.5
# of the projections: what takes longer is no point to hold at
_ITERATIONS = 5
# a vertex is gone to instead when it is so much nearer, as a share of the distance
NEARER = 0.8
# of the directions across
_ANGLES = np.arange(_SIDES)[:, None] * (2.0 * math.pi / _SIDES)
_COSINES, _SINES = np.cos(_ANGLES), np.sin(_ANGLES)


def nearest_feasible(
    follower: Follower, solver: Solver, base: Array, base_q: Array, targets: Array, level: Array
) -> tuple[Array, Array, Mask]:
    """One step of a search for the solvable point nearest to each target.

    Points round the last one found are solved, towards the target and across. The nearest to the target is taken if the
    map leads there without a jump. Where a resolved vertex is much nearer to the target,
    as on the other side of a hole, that is taken.

    Args:
        follower: What arms follow lines with.
        solver: The roadmap's solver.
        base: (B, width) points found in the last step, or where the tools are.
        base_q: (B, n) configurations there; NaN where none is known.
        targets: (B, width) targets.
        level: (B,) how closely to the last one points are to lie, below `LEVELS`. To look far and ever more closely
            in turn, step by step, is enough for points that change little, and tries a third as many.

    Returns:
        Points (B, width), configurations (B, n), and which targets the map solves (B,).
    """
    gap = follower.task.gap_of_few
    around = _around(follower.task, base, targets, _SHARES[level].astype(base.dtype))
    points = np.concatenate([base[:, None], around, targets[:, None]], axis=1)
    # as long as the arm can stay where it is, only what is nearer to the target can be better
    known = norms(base_q) < np.inf
    left = gap(points, targets[:, None])
    tried = (left < left[:, :1]) | ~known[:, None]
    tried[:, [0, -1]] = True
    solved = np.zeros_like(tried)
    q = np.full((*tried.shape, base_q.shape[1]), np.nan, base.dtype)
    q[tried], solved[tried], strayed = solve_few(follower, solver, points[tried])
    # near full stretch, much joint motion brings little; no farther into it than where the arm is
    stretched = np.zeros(tried.shape, base.dtype)
    stretched[tried] = np.nan_to_num(strayed)
    fits = solved & (stretched <= np.maximum(_STRETCHED, stretched[:, :1]))
    reach = _SLOPE * gap(points, base[:, None]) + _LEAST
    moved = np.where(known[:, None], follower.distance(q, np.nan_to_num(base_q)[:, None]), 0.0)
    fits &= moved <= reach
    score = np.where(fits, left + _WORTH * moved, np.inf)
    rows, best = np.arange(len(base)), score.argmin(1)
    # a point that the map no longer solves is better than none
    kept = np.expand_dims(known & ~np.isfinite(score[rows, best]), 1)
    found, found_q = np.where(kept, base, points[rows, best]), np.where(kept, base_q, q[rows, best])
    nearer, vertices = much_nearer(follower, solver, found, targets)
    over = np.expand_dims(nearer | ~np.isfinite(found_q).all(1), 1)
    found = np.where(over, solver.points.numpy()[vertices], found)
    found_q = np.where(over, solver.configurations.numpy()[vertices], found_q)
    return found, found_q, solved[:, -1]


def much_nearer(follower: Follower, solver: Solver, points: Array, targets: Array) -> tuple[Mask, Array]:
    """Where a resolved vertex is much nearer to the target than a point (B, width), (B,), and the nearest one (B,)."""
    distances, vertices = (part[:, 0].numpy() for part in solver.nearest(torch.from_numpy(targets)))
    task = follower.task
    if task.rotations is not None:
        distances = task.gap_of_few(solver.points.numpy()[vertices], targets)
    return distances < NEARER * task.gap_of_few(points, targets), vertices


def solve_few(
    follower: Follower, solver: Solver, points: Array, iterations: int = _ITERATIONS
) -> tuple[Array, Mask, Array]:
    """Configurations (N, n) of the map at points (N, width), which are valid, and how far their guesses were off.

    `Solver.solve_from` for arrays, in at most so many `iterations`: what takes more is not valid.
    """
    guesses, codes = (
        part.numpy() for part in solver.guess(torch.from_numpy(points.astype(np.float64)), certified=False)
    )
    guesses, rows = guesses.astype(points.dtype), (codes <= LAST_VALID).nonzero()[0]
    q, strayed = np.full_like(guesses, np.nan), np.full(len(points), np.nan, points.dtype)
    solved, valid = follower.solved(points[rows].T, guesses[rows].T, iterations)
    rows, solved = rows[valid], solved.T[valid]
    kept = solver.on_map(torch.from_numpy(solved), torch.from_numpy(guesses[rows])).numpy()
    rows, solved = rows[kept], solved[kept]
    free = ~follower.robot.few.in_self_collision(np.ascontiguousarray(solved.T))
    rows = rows[free]
    q[rows] = solved[free]
    strayed[rows] = follower.distance(q[rows], guesses[rows])
    return q, np.isfinite(strayed), strayed


def _around(task: TaskSpace, base: Array, targets: Array, close: Array) -> Array:
    """Points (B, K, width) round others (B, width), towards targets and across, a share `close` (B,) of the usual way.

    Where rotation varies, each is tried in the rotation that there is and in one nearer to the target's; and turning
    on the spot is.
    """
    d = task.dimension
    towards = (targets - base)[:, :d]
    apart = np.minimum(norms(towards), _AROUND) * close
    places = base[:, None, :d] + apart[:, None, None] * _directions(towards)
    if task.rotations is None:
        return places
    share = close * np.minimum(_AROUND / np.maximum(task.gap_of_few(base, targets), 1e-12), 1.0)
    turned = task.interpolate_few(base, targets, share[:, None])
    places = np.concatenate([places, places, base[:, None, :d]], axis=1)
    count = len(_LEANS) * (2 if d == 2 else _SIDES) + 1
    rotations = np.repeat(np.stack([base[:, d:], turned[:, d:]], axis=1), [count, count + 1], axis=1)
    return np.concatenate([places, rotations], axis=2).astype(base.dtype)


def _directions(towards: Array) -> Array:
    """Unit directions (B, K, d): towards a target, and across, leaning to and from it."""
    ahead = _unit(towards)
    if towards.shape[1] == 2:
        side = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
        sides = np.stack([side, -side], axis=1)
    else:
        # any axis that is not parallel
        axis = np.eye(3)[np.abs(ahead).argmin(1)]
        first = _unit(_cross(ahead, axis))
        second = _cross(ahead, first)
        sides = _COSINES * first[:, None] + _SINES * second[:, None]
    leaning = [_unit(sides + lean * ahead[:, None]) for lean in _LEANS]
    return np.concatenate([ahead[:, None], *leaning], axis=1).astype(towards.dtype)


def _cross(first: Array, second: Array) -> Array:
    """Cross products (…, 3) of vectors; numpy.cross takes three times as long for a few."""
    return first[..., NEXT] * second[..., LAST] - first[..., LAST] * second[..., NEXT]


def _unit(vectors: Array) -> Array:
    """Vectors (…, d) of length one; those without a length as they are."""
    return vectors / np.maximum(norms(vectors), 1e-12)[..., None]
