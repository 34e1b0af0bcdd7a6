"""The nearest point to a target that a roadmap can solve: what an arm goes to while the target cannot be reached."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from grr_torch.applications.solve import Solver
from grr_torch.spaces.configuration import distance

# metres around the last such point that are searched in a step, and the shares of it that are tried
_AROUND = 0.2
_SHARES = (1.0, 0.2)
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
_NEARER = 0.8


def nearest_feasible(solver: Solver, base: Tensor, base_q: Tensor, targets: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """One step of a search for the solvable point nearest to each target.

    Points round the last one found are solved, towards the target and across. The nearest to the target is taken if the
    map leads there without a jump. Where a resolved vertex is much nearer to the target,
    as on the other side of a hole, that is taken.

    Args:
        solver: The roadmap's solver.
        base: (B, width) points found in the last step, or where the tools are.
        base_q: (B, n) configurations there; NaN where none is known.
        targets: (B, width) targets.

    Returns:
        Points (B, width), configurations (B, n), and which targets the map solves (B,).
    """
    count = len(base)
    apart = (targets - base).norm(dim=1).clamp_max(_AROUND)
    directions = apart[:, None, None] * _directions(targets - base)
    steps = torch.cat([share * directions for share in _SHARES], dim=1)
    points = torch.cat([base[:, None], base[:, None] + steps, targets[:, None]], dim=1)
    # as long as the arm can stay where it is, only what is nearer to the target can be better
    known = base_q.isfinite().all(1)
    left = (points - targets[:, None]).norm(dim=2)
    tried = (left < left[:, :1]) | ~known[:, None]
    tried[:, [0, -1]] = True
    flat = points[tried]
    guesses, codes = solver.guess(flat.to(torch.float64), certified=False)
    guesses = guesses.to(flat)
    columns, codes = solver.solve_from(
        flat.T.contiguous(), guesses, codes, replace(solver.tolerances, iterations=_ITERATIONS)
    )
    q = points.new_full((*points.shape[:2], solver.robot.n), torch.nan)
    q[tried] = columns.T
    fits, solved = torch.zeros_like(tried), torch.zeros_like(tried)
    solved[tried] = codes <= 1
    # near full stretch, much joint motion brings little
    fits[tried] = solved[tried] & (distance(columns.T, guesses, solver.robot.continuous) <= _STRETCHED)
    reach = _SLOPE * (points - base[:, None]).norm(dim=2) + _LEAST
    moved = torch.where(known[:, None], distance(q, base_q[:, None].nan_to_num(), solver.robot.continuous), 0.0)
    fits &= moved <= reach
    score = torch.where(fits, left + _WORTH * moved, torch.inf)
    best = score.argmin(1)
    rows = torch.arange(count, device=base.device)
    found, found_q = points[rows, best], q[rows, best]
    # a point that the map no longer solves is better than none
    kept = ~score[rows, best].isfinite() & known
    found, found_q = torch.where(kept[:, None], base, found), torch.where(kept[:, None], base_q, found_q)
    distances, vertices = solver.nearest(targets)
    lost = ~found_q.isfinite().all(1)
    over = lost | (distances[:, 0] < _NEARER * (found - targets).norm(dim=1))
    found = torch.where(over[:, None], solver.points[vertices[:, 0]], found)
    found_q = torch.where(over[:, None], solver.configurations[vertices[:, 0]], found_q)
    return found, found_q, solved[:, -1]


def _directions(towards: Tensor) -> Tensor:
    """Unit directions (B, K, d): towards a target, and across, leaning to and from it."""
    ahead = torch.nn.functional.normalize(towards, dim=1)
    if towards.shape[1] == 2:
        side = torch.stack([-ahead[:, 1], ahead[:, 0]], dim=1)
        sides = torch.stack([side, -side], dim=1)
    else:
        # any axis that is not parallel
        axis = torch.nn.functional.one_hot(ahead.abs().argmin(1), 3).to(ahead)
        first = torch.nn.functional.normalize(torch.linalg.cross(ahead, axis), dim=1)
        second = torch.linalg.cross(ahead, first)
        angles = torch.arange(_SIDES, dtype=ahead.dtype, device=ahead.device)[:, None] * (2.0 * math.pi / _SIDES)
        sides = angles.cos() * first[:, None] + angles.sin() * second[:, None]
    leaning = [torch.nn.functional.normalize(sides + lean * ahead[:, None], dim=2) for lean in _LEANS]
    return torch.cat([ahead[:, None], *leaning], dim=1)
