"""What a refinement changed: as a roadmap's parameters hold it, and in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from grr_torch.progress import Progress
from grr_torch.resolution.checkpoint import Checkpoint
from grr_torch.resolution.objectives import OBJECTIVES
from grr_torch.resolution.quality import Quality
from grr_torch.resolution.slopes import edge_slopes, steep_edges

if TYPE_CHECKING:
    from grr_torch.resolution.roadmap import Roadmap

# what `parameters["refinement"]` keeps of the quality before
BEFORE = (
    *("resolved_vertices", "connected_edges", "smoothness", "smoothness_p99", "smoothness_max", "steep_edges"),
    *("triangles", "triangles_wound", "triangles_spread", "squares", "squares_wound", "squares_spread"),
)
# what is told of slopes: name, figure and digits
_SLOPES = (
    ("smoothness", "smoothness", ".3f"),
    ("99 % of slopes below", "smoothness_p99", ".1f"),
    ("largest", "smoothness_max", ".1f"),
)
# figures of a map without edges or vertices
_MAY_BE_NONE = {"smoothness", "smoothness_p99", "smoothness_max", "smoothest", "mean", "worst"}


def before_refinement(roadmap: Roadmap, progress: Progress, checkpoint: Checkpoint) -> dict[str, Any]:
    """The figures of a roadmap that `parameters["refinement"]` keeps; by name, as in `Quality`."""
    slopes = edge_slopes(roadmap)
    figures: list[int | float | None] = [int(roadmap.resolved.sum()), int(roadmap.connected.sum())]
    # torch's quantile takes no more than 2²⁴ values
    levels = [slopes.mean(), np.quantile(slopes.numpy(), 0.99), slopes.max()] if len(slopes) else []
    figures += [float(level) for level in levels] or [None] * 3
    figures.append(len(steep_edges(roadmap)))
    triangles = roadmap.triangles(progress, checkpoint.stage("triangles"))
    for cells in (triangles, roadmap.squares(progress, checkpoint.stage("squares"))):
        figures += [len(cells.corners), int(cells.wound.sum()), int(cells.spread_out.sum())]
    return dict(zip(BEFORE, figures, strict=True))


def check_refinement(parameters: Mapping[str, Any]) -> None:
    """Checks what a file says of a roadmap before its refinement.

    Raises:
        ValueError: A figure is missing or is no number.
    """
    before = parameters.get("refinement")
    if before is None:
        return
    objectives = before.get("objectives", {}) if isinstance(before, dict) else None
    if not isinstance(objectives, dict) or not set(objectives) <= set(OBJECTIVES):
        raise ValueError("'refinement' without known objectives")
    _demand_numbers("refinement", before, [*BEFORE, "seconds", *(["smoothest"] if objectives else [])])
    for name, told in objectives.items():
        _demand_numbers(name, told, ["weight"])
        for when in ("before", "after"):
            _demand_numbers(f"{name} {when}", told.get(when), ["mean", "worst"])


def _demand_numbers(owner: str, table: Any, names: Sequence[str]) -> None:
    for name in names:
        number = int | float | None if name in _MAY_BE_NONE else int | float
        if not isinstance(table, dict) or not isinstance(table.get(name, ""), number):
            raise ValueError(f"'{owner}' without a number '{name}'")


def summary(roadmap: Roadmap, quality: Quality) -> str:
    """What the refinement of a roadmap changed, in one line; empty if it was not refined."""
    before = roadmap.parameters.get("refinement")
    if before is None:
        return ""
    named = (
        ("vertices", "resolved_vertices"),
        ("edges", "connected_edges"),
        ("steep edges", "steep_edges"),
        ("windings", "triangles_wound"),
    )
    changes = [f"{name} {before[key]:,} → {getattr(quality, key):,}" for name, key in named]
    after = quality.to_dict()
    for cells in ("triangles", "squares"):
        if after[cells]:
            left = [f"{after[cells] - _certified(figures, cells):,}" for figures in (before, after)]
            changes.append(f"uncertified of {after[cells]:,} {cells} {' → '.join(left)}")
    if before["smoothness"] is not None and quality.smoothness is not None:
        slopes = [f"{name} {before[key]:{digits}} → {after[key]:{digits}}" for name, key, digits in _SLOPES]
        changes = [*slopes, *changes]
    return ", ".join(changes) + f", in {before['seconds']:.2f} s"


def _certified(figures: Mapping[str, Any], cells: str) -> int:
    return int(figures[cells] - figures[f"{cells}_wound"] - figures[f"{cells}_spread"])


def traded(roadmap: Roadmap, quality: Quality) -> dict[str, str]:
    """By objective, what was given for what against the map refined for smoothness alone; empty without objectives."""
    told = roadmap.parameters.get("refinement") or {}
    lines: dict[str, str] = {}
    for name, figures in told.get("objectives", {}).items():
        before, after = figures["before"], figures["after"]
        if None not in (*before.values(), *after.values()):
            values = [f"{which} {before[which]:.4g} → {after[which]:.4g}" for which in ("mean", "worst")]
            lines[name] = f"{', '.join(values)} (weight {figures['weight']:g}; {OBJECTIVES[name]})"
    if lines and told["smoothest"] is not None and quality.smoothness is not None:
        lines["at the price of"] = f"smoothness {told['smoothest']:.3f} → {quality.smoothness:.3f} rad/m"
    return lines
