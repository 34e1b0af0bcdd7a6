"""Holding a roadmap file against itself: everything recomputed from its tensors."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from grr_torch.errors import UrdfError
from grr_torch.progress import Progress, silent
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.edges import check_edges
from grr_torch.resolution.quality import quality_differences
from grr_torch.resolution.roadmap_file import load_roadmap, metadata_hash, read_file, solving_tables
from grr_torch.resolution.slopes import without_steep_edges
from grr_torch.robots.read_urdf import parse_urdf
from grr_torch.robots.urdf_json import urdf_to_json
from grr_torch.tensor_file import tensor_hash

# angles are wrapped after they were found good
_ROUNDING = 1.0 + 1e-6


@dataclass(frozen=True)
class Check:
    """One thing that was verified.

    Attributes:
        name: What was checked.
        passed: Whether it holds.
        detail: What was found.
    """

    name: str
    passed: bool
    detail: str


def verify_file(path: str | os.PathLike[str], *, progress: Progress = silent) -> list[Check]:
    """Recomputes hashes, tables, quality, residuals and the continuity of every edge of a roadmap file.

    Where a tensor's content contradicts another's, nothing can be computed from them, and no more is checked.

    Args:
        path: The file.
        progress: Told how many cells and edges are checked.

    Raises:
        FileFormatError: The file cannot be loaded at all.
    """
    metadata, tensors = read_file(path)
    roadmap = replace(load_roadmap(path))  # without what the file says of it
    checks = [_check_hashes(metadata, tensors), _check_robot(metadata["robot"])]
    checks.append(
        Check("metadata", metadata_hash(metadata) == metadata.get("metadata_sha256"), "SHA-256 of all entries")
    )
    reason = _contradiction(tensors)
    checks.append(Check("contents", not reason, reason or "agree with each other"))
    if reason:
        return checks
    quality = roadmap.quality(progress)
    tolerances = Tolerances(**roadmap.parameters["tolerances"])
    differing = quality_differences(metadata["quality"], quality.to_dict())
    tables = [name for name, table in solving_tables(roadmap).items() if not torch.equal(table, tensors[name])]
    if not math.isclose(roadmap.longest_edge, metadata["longest_edge"], rel_tol=1e-9):
        tables.append("longest_edge")
    position, rotation = quality.max_position_error or 0.0, quality.max_rotation_error or 0.0
    found = without_steep_edges(replace(roadmap, connected=check_edges(roadmap, tolerances, progress))).connected
    changed = int((found != roadmap.connected).sum())
    return [
        *checks,
        Check("tables", not tables, f"differ: {', '.join(tables)}" if tables else "as stored"),
        Check("quality", not differing, f"differs in {', '.join(differing)}" if differing else "as stored"),
        Check(
            "residuals",
            position <= _ROUNDING * tolerances.position and rotation <= _ROUNDING * tolerances.rotation,
            f"at most {position:.2e} m and {rotation:.2e} rad",
        ),
        Check("joint limits", not quality.joint_limit_violations, f"{quality.joint_limit_violations} violations"),
        Check(
            "self-collision",
            not quality.self_collisions,
            "no sphere model" if quality.self_collisions is None else f"{quality.self_collisions} collisions",
        ),
        Check("edges", changed == 0, f"{changed} of {len(found)} judged otherwise"),
    ]


def _check_hashes(metadata: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Check:
    stored = metadata.get("tensors_sha256")
    stored = stored if isinstance(stored, dict) else {}
    names = sorted({*stored, *tensors})
    differing = [name for name in names if name not in tensors or tensor_hash(tensors[name]) != stored.get(name)]
    detail = f"SHA-256 differs: {', '.join(differing)}" if differing else f"SHA-256 of {len(tensors)} tensors"
    return Check("tensors", not differing, detail)


def _check_robot(robot: Mapping[str, Any]) -> Check:
    """Whether the URDF's text is what was stored, and says what was read from it."""
    same = hashlib.sha256(robot["urdf"].encode()).hexdigest() == robot.get("urdf_sha256")
    try:
        same &= urdf_to_json(parse_urdf(robot["urdf"].encode(), source=robot["name"])) == robot["parsed"]
    except UrdfError:
        same = False
    return Check("URDF", same, f"SHA-256 {str(robot.get('urdf_sha256'))[:12]}…")


def _contradiction(tensors: Mapping[str, Tensor]) -> str:
    """What in the tensors does not fit the rest; empty if all does."""
    edges, resolved, vertices = tensors["edges"], tensors["resolved"], len(tensors["points"])
    finite = tensors["configurations"].isfinite().all(1)
    faults = {
        "points that are not finite": not bool(tensors["points"].isfinite().all()),
        "resolved vertices without a finite configuration, or the reverse": not torch.equal(finite, resolved),
        "waves later than there are vertices": bool((tensors["wave"] >= vertices).any()),
        "waves that do not fit what is resolved": not torch.equal(tensors["wave"] >= 0, resolved),
        "resolved vertices not reachable": bool((resolved & ~tensors.get("reachable", resolved)).any()),
        "connected edges to unresolved vertices": not bool(resolved[edges[tensors["connected"]]].all()),
    }
    return ", ".join(name for name, wrong in faults.items() if wrong)
