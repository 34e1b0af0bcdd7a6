"""Holding a roadmap file against itself: everything recomputed from its tensors."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass

from grr_torch.progress import Progress, silent
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.edges import check_edges
from grr_torch.resolution.quality import quality_differences
from grr_torch.resolution.roadmap_file import load_roadmap, metadata_hash, read_file, tensors_hash

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
    """Recomputes hashes, quality, residuals and the continuity of every edge of a roadmap file.

    Args:
        path: The file.
        progress: Told how many cells and edges are checked.

    Raises:
        FileFormatError: The file cannot be loaded at all.
    """
    metadata, tensors = read_file(path)
    roadmap = load_roadmap(path)
    quality = roadmap.quality(progress)
    tolerances = Tolerances(**roadmap.parameters["tolerances"])
    robot = metadata["robot"]
    stored_hash, found_hash = str(metadata.get("tensors_sha256")), tensors_hash(tensors)
    differing = quality_differences(metadata["quality"], quality.to_dict())
    position, rotation = quality.max_position_error or 0.0, quality.max_rotation_error or 0.0
    found = check_edges(roadmap, tolerances, progress)
    changed = int((found != roadmap.connected).sum())
    return [
        Check("tensors", stored_hash == found_hash, f"SHA-256 {found_hash[:12]}…, stored {stored_hash[:12]}…"),
        Check(
            "URDF",
            hashlib.sha256(robot["urdf"].encode()).hexdigest() == robot.get("urdf_sha256"),
            f"SHA-256 {str(robot.get('urdf_sha256'))[:12]}…",
        ),
        Check("metadata", metadata_hash(metadata) == metadata.get("metadata_sha256"), "SHA-256 of all entries"),
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
