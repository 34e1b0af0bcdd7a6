"""Refinement of a roadmap: repair, then relaxation, without losing what was connected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from grr_torch.progress import Progress, silent
from grr_torch.projection.continuity import is_continuous
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.blend import blended
from grr_torch.resolution.certify import certify
from grr_torch.resolution.checkpoint import Checkpoint
from grr_torch.resolution.edges import EdgeCheck
from grr_torch.resolution.losses import is_large
from grr_torch.resolution.objectives import Objective, check_objectives, measure_objective
from grr_torch.resolution.relax import Network, relax
from grr_torch.resolution.repair import repair
from grr_torch.resolution.report import before_refinement
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.resolution.slopes import edge_slopes, with_raised_bound, without_steep_edges

# of an objective's scale: no arm is at a singularity or a limit everywhere
_LEAST_SCALE = 1e-9


def refine(
    roadmap: Roadmap,
    *,
    objectives: Mapping[str, float] | None = None,
    seed: int = 0,
    check: EdgeCheck = is_continuous,
    progress: Progress = silent,
    checkpoint: Checkpoint | None = None,
) -> Roadmap:
    """Improves a roadmap: more vertices, edges and certified cells, and as small a mean of D_q / D_p as may be.

    Unresolved vertices and the ends of broken edges are tried again from all their neighbours and from random starts;
    then all configurations move along their self-motion manifolds at once. No vertex and no connected edge is lost:
    where the relaxed map breaks an edge, its ends go back part of the way, or to where they were. Edges that are broken
    then are tried once more, in all but large maps; what joins them may be steep. A map that is as smooth as it gets
    becomes a little less so for the cells that are certified. With objectives, the smoothest map is then relaxed once
    more, for the sum that `grr_torch.resolution.objectives` gives. At last, edges steeper than the roadmap's parameter
    `max_slope`, if it has one, are left out, but for those that its parameter `connectivity`, if it has that, takes.

    Args:
        roadmap: The roadmap.
        objectives: Weights of "clearance", "manipulability" and "limits"; one with weight 0 is only reported.
        seed: Of the random starts.
        check: What checks batches of edges.
        progress: Told what is being done and how far it is.
        checkpoint: Where it is kept what is done; nowhere by default.

    Returns:
        The refined roadmap; its `build_seconds` include the refinement, and `parameters["refinement"]` tells what it
        was before; of objectives, their means and worst over the vertices, for the smoothest map and for this one.

    Raises:
        UnknownNameError: No such objective.
        ParameterError: A weight is not valid, or the robot has no such objective.
    """
    weights = check_objectives(roadmap.robot, objectives)
    checkpoint = checkpoint or Checkpoint()
    told = before_refinement(roadmap, progress, checkpoint)
    tolerances = Tolerances(**roadmap.parameters["tolerances"])
    with checkpoint.timed("refinement"):
        repaired = repair(roadmap, tolerances, seed, check, progress, checkpoint)
        smoothest = _relaxed(repaired, {}, tolerances, check, progress, checkpoint)
        if not is_large(smoothest):
            smoothest = repair(smoothest, tolerances, seed, check, progress, checkpoint, at_last=True)
        wanted = {name: weight for name, weight in weights.items() if weight > 0.0}
        refined = _relaxed(smoothest, wanted, tolerances, check, progress, checkpoint) if wanted else smoothest
    seconds = told["seconds"] = checkpoint.seconds("refinement")
    if weights:
        slopes = edge_slopes(smoothest)
        told["smoothest"] = float(slopes.mean()) if len(slopes) else None
        told["objectives"] = {
            name: {"weight": weight, "before": _figures(smoothest, name), "after": _figures(refined, name)}
            for name, weight in weights.items()
        }
    parameters = {**roadmap.parameters, "refinement": told}
    refined = replace(refined, parameters=parameters, build_seconds=roadmap.build_seconds + seconds)
    return with_raised_bound(without_steep_edges(refined))


def _figures(roadmap: Roadmap, objective: str) -> dict[str, float | None]:
    """Mean and worst of an objective over the resolved vertices; None if there are none."""
    q = roadmap.configurations[roadmap.resolved]
    if len(q) == 0:
        return {"mean": None, "worst": None}
    values = measure_objective(roadmap.robot, roadmap.task, objective, q)
    return {"mean": float(values.mean()), "worst": float(values.min())}


def _relaxed(
    roadmap: Roadmap,
    weights: Mapping[str, float],
    tolerances: Tolerances,
    check: EdgeCheck,
    progress: Progress,
    checkpoint: Checkpoint,
) -> Roadmap:
    """The relaxed and certified map, but for the surroundings of edges that it would break."""
    edges = roadmap.edges[roadmap.connected]
    if len(edges) == 0:
        return roadmap
    vertices = roadmap.resolved.nonzero()[:, 0]
    rank = torch.full((len(roadmap.points),), -1).index_put_((vertices,), torch.arange(len(vertices)))
    network = _network(roadmap, vertices, rank[edges], weights)
    old = roadmap.configurations[vertices].to(roadmap.robot.lower)
    new = relax(network, old.T.contiguous(), tolerances, progress, kept=checkpoint.stage("relaxation"))
    cells = rank[roadmap.graph.triangles(roadmap.connected)].to(roadmap.robot.device)
    new = certify(network, cells, new, tolerances, progress, checkpoint).T
    configurations = roadmap.configurations.clone()
    # files hold double precision, whatever the robot computes in
    configurations[vertices] = new.cpu().to(configurations)
    return blended(roadmap, configurations, tolerances, check, progress, checkpoint.stage("edges-again"))


def _network(roadmap: Roadmap, vertices: Tensor, edges: Tensor, weights: Mapping[str, float]) -> Network:
    """The resolved vertices, joined by edges (E, 2) between their ranks."""
    robot, task = roadmap.robot, roadmap.task
    points = roadmap.points[vertices].to(robot.lower)
    lengths = task.distance(points[edges[:, 0]], points[edges[:, 1]])
    slope_share = float(edge_slopes(roadmap).sum()) / len(vertices)
    objectives = tuple(
        Objective(robot, task, name, weight * slope_share, max(mean, _LEAST_SCALE))
        for name, weight in weights.items()
        if (mean := _figures(roadmap, name)["mean"]) is not None
    )
    return Network(robot, task, points.T.contiguous(), edges.T.contiguous().to(robot.device), lengths, objectives)
