"""The cells of a roadmap: whether the map is continuous inside the smallest cycles of its graph, not only along edges.

A map that is continuous inside a cell has winding zero round it: what its joints turn on the way along its edges adds
up to nothing. The converse does not hold, so the corners' configurations are also led to the cell's centre and
compared there. Neither asks where the configurations came from.

Some windings cannot be removed. At full reach a planar arm is straight and its first joint turns with the target: once
round the boundary it makes a full turn. The boundary's winding is the sum of its cells', so no map of the whole disc
has none, and a planar roadmap has at least one cell with a winding.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from grr_torch.pieces import together
from grr_torch.processes import at_once
from grr_torch.progress import Progress, silent
from grr_torch.projection.project import Tolerances, project_columns
from grr_torch.resolution.checkpoint import UNKEPT, Stage
from grr_torch.spaces.cliques import are_closed, draw
from grr_torch.spaces.configuration import difference, distance

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap
    from grr_torch.robots.robot import Robot
    from grr_torch.spaces.task import TaskSpace

# a cell is certified if its corners lead to configurations no farther apart than this [rad]
LARGEST_SPREAD = 1.0
# projections on the way from a corner to the centre
_STEPS = 8
CELLS_AT_ONCE = 8192
# cells of a space in which rotation varies that are measured: those of a product are too many
_MOST_MEASURED = 20_000


@dataclass(frozen=True)
class Cells:
    """Cells of one shape, all of whose corners are resolved and edges connected.

    Attributes:
        corners: (C, k) vertices, in their order round the cell; k = 3 or 4.
        winding: (C, n) turns that each joint makes once round; only continuous joints can make any.
        spread: (C,) largest distance D_q [rad] of the configurations that its corners lead to at its centre; inf where
            a corner leads to none.
    """

    corners: Tensor
    winding: Tensor
    spread: Tensor

    @property
    def wound(self) -> Tensor:
        """(C,) cells with a winding."""
        return (self.winding != 0).any(1)

    @property
    def spread_out(self) -> Tensor:
        """(C,) cells without winding whose spread is above 1 rad."""
        return ~self.wound & ~(self.spread <= LARGEST_SPREAD)

    @property
    def certified(self) -> Tensor:
        """(C,) all the others."""
        return ~self.wound & ~self.spread_out


def measure_cells(roadmap: Roadmap, corners: Tensor, progress: Progress = silent, kept: Stage = UNKEPT) -> Cells:
    """Winding and spread of cells given by their corners (C, k); where rotation varies, of at most 20,000 of them."""
    if roadmap.task.rotations is not None:
        corners = corners[draw(len(corners), _MOST_MEASURED)]
    robot, tolerances = roadmap.robot, Tolerances(**roadmap.parameters["tolerances"])
    points, q = (part.to(robot.lower) for part in (roadmap.points, roadmap.configurations))
    spread = spreads(robot, roadmap.task, points, q, corners, tolerances, progress, kept)
    return Cells(corners, windings(roadmap, corners), spread.cpu())


def doubtful_cells(roadmap: Roadmap) -> tuple[Tensor, Tensor]:
    """Corners (C, 3) and (C, 4): cells that are not certified, and what would be cells if no edge were broken."""
    graph, between = roadmap.graph, roadmap.resolved[roadmap.edges].all(1)
    found: list[Tensor] = []
    for cells, around in zip(roadmap.cells(), (graph.triangles, graph.faces), strict=True):
        corners = around(between) if bool((between & ~roadmap.connected).any()) else cells.corners[:0]
        broken = ~are_closed(corners, roadmap.edges[roadmap.connected], len(roadmap.points))
        found.append(torch.cat([cells.corners[~cells.certified], corners[broken]]))
    return found[0], found[1]


def windings(roadmap: Roadmap, corners: Tensor) -> Tensor:
    """(C, n) turns that each joint makes once round cells (C, k); only continuous joints can make any."""
    wraps = roadmap.robot.continuous.cpu()
    turns = torch.empty(len(corners), roadmap.robot.n, dtype=torch.int8)
    for start in range(0, len(corners), CELLS_AT_ONCE):
        part = slice(start, start + CELLS_AT_ONCE)
        q = roadmap.configurations[corners[part]]
        angles = difference(q, q.roll(-1, dims=1), wraps).sum(1)
        turns[part] = torch.where(wraps, (angles / (2.0 * math.pi)).round(), 0.0).to(torch.int8)
    return turns


def spreads(
    robot: Robot,
    task: TaskSpace,
    points: Tensor,
    q: Tensor,
    corners: Tensor,
    tolerances: Tolerances,
    progress: Progress = silent,
    kept: Stage = UNKEPT,
) -> Tensor:
    """The spread (C,) of cells, as in `Cells`.

    Args:
        robot: The robot.
        task: The task space.
        points: (V, width) points.
        q: (V, n) configurations there.
        corners: (C, k) cells.
        tolerances: Of the projections.
        progress: Told how many cells are done.
        kept: Where it is kept how far that is.
    """
    count = len(corners)
    spread = q.new_empty(count)
    state = kept.state()
    done = int(state["done"]) if state else 0
    spread[:done] = state["spread"].to(spread) if state else spread[:0]
    pairs = torch.combinations(torch.arange(corners.shape[1], device=q.device))
    batches = corners[done:].split(together(CELLS_AT_ONCE, q.device)) if done < count else ()

    def measured(part: Tensor) -> tuple[Tensor]:
        part = part.to(q.device)
        ends, followed = lead_to_centres(robot, task, points[part], q[part], tolerances)
        apart = distance(ends[:, pairs[:, 0]], ends[:, pairs[:, 1]], robot.continuous).amax(1)
        return (torch.where(followed, apart, torch.inf),)

    progress("measuring cells", done, count)
    for (found,) in at_once(measured, batches, q.device):
        spread[done : done + len(found)] = found
        done += len(found)
        kept.keep({"spread": spread[:done], "done": torch.tensor(done)}, last=done == count)
        progress("measuring cells", done, count)
    progress("measuring cells", count, count)
    return spread


def lead_to_centres(
    robot: Robot, task: TaskSpace, points: Tensor, q: Tensor, tolerances: Tolerances
) -> tuple[Tensor, Tensor]:
    """Follows the straight lines from the corners of cells to their centres.

    Args:
        robot: The robot.
        task: The task space.
        points: (C, k, width) corners.
        q: (C, k, n) configurations there.
        tolerances: Of the projections.

    Returns:
        Configurations (C, k, n) at the centres, and where all corners of a cell led to one (C,).
    """
    count, sides, _ = points.shape
    centre = task.centre(points)[:, None].expand_as(points)
    columns = q.reshape(-1, robot.n).T.contiguous()
    followed = torch.ones(columns.shape[1], dtype=torch.bool, device=columns.device)
    for step in range(1, _STEPS + 1):
        targets = task.interpolate(points, centre, step / _STEPS).reshape(-1, task.width).T.contiguous()
        solved, valid = project_columns(robot, task, targets, columns, tolerances, check_collision=False)
        followed &= valid
        columns = torch.where(valid, solved, columns)
    return columns.T.reshape(count, sides, robot.n), followed.reshape(count, sides).all(1)
