"""Which pairs of links need no self-collision check, found from random configurations and the geometry itself.

As MoveIt's Setup Assistant does: links that a joint joins, links that touch in nearly every configuration, and links
that touch in none. Besides, links whose spheres touch in nearly every configuration though the links do not: if they
were checked, next to no configuration would be free.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from grr_torch.errors import GrrWarning, ParameterError
from grr_torch.progress import Progress, silent
from grr_torch.robots.compile_tree import compile_tree, degrees_of_freedom
from grr_torch.robots.geometry import Mask, Points, link_meshes
from grr_torch.robots.kinematics import KinematicTree
from grr_torch.robots.spheres import Sphere, ordered_pair
from grr_torch.robots.urdf import Urdf, sampling_range

# links that touch in more than this share of configurations do so by construction
_ALWAYS = 0.95
# spheres that touch in so much larger a share of configurations than their links are told of
_COARSE = 0.1
# pairs that are named in a warning
_NAMED = 12
_CONFIGURATIONS_AT_ONCE = 2000


@dataclass(frozen=True)
class PairReport:
    """What was found about one pair of links.

    Attributes:
        links: The pair, in alphabetical order.
        reason: "rigid", "adjacent", "always" or "never" where it need not be checked; "checked" otherwise.
        contacts: Share of the random configurations in which the two touch (not counted for rigid and adjacent ones).
        overlaps: Share in which their spheres do (as well).
    """

    links: tuple[str, str]
    reason: str
    contacts: float
    overlaps: float = 0.0

    @property
    def ignored(self) -> bool:
        """Whether the pair is not checked."""
        return self.reason != "checked"

    def __str__(self) -> str:
        first, second = self.links
        return f"{first} – {second} (spheres {100.0 * self.overlaps:.1f} %, links {100.0 * self.contacts:.1f} %)"


@dataclass(frozen=True)
class Contacts:
    """What was found about all pairs of links.

    Attributes:
        pairs: The pairs.
        free: Share of the random configurations in which the spheres of no checked pair touch.
    """

    pairs: list[PairReport]
    free: float


def find_pairs(
    urdf: Urdf,
    spheres: Mapping[str, tuple[Sphere, ...]],
    *,
    samples: int = 50_000,
    seed: int = 0,
    progress: Progress = silent,
) -> Contacts:
    """Sorts all pairs of links that have spheres into those to check and those to ignore.

    Every movable joint of the URDF takes part. Contact is that of the triangles of the collision geometry: a link
    wholly inside another one is not seen. The spheres, which hold the geometry, tell where contact cannot be, and which
    pairs they are too coarse for: those are named in a GrrWarning.

    Args:
        urdf: The robot.
        spheres: Spheres that hold the geometry of each link.
        samples: Random configurations within limits.
        seed: Of the random configurations.
        progress: Told how many configurations were tested.

    Raises:
        ParameterError: `samples` is below 1.
        MeshNotFoundError: A mesh is missing.
    """
    if samples < 1:
        raise ParameterError("samples", samples, "1 or more random configurations")
    joints = list(urdf.joints.values())
    cpu = torch.device("cpu")
    tree = compile_tree(urdf, joints, urdf.root, urdf.root, {}, dtype=torch.float64, device=cpu)
    groups = {link: _group(urdf, link) for link in spheres}
    joined = {frozenset((_group(urdf, j.parent), _group(urdf, j.child))) for j in joints if j.movable}
    reports: list[PairReport] = []
    candidates: list[tuple[str, str]] = []
    for first, second in itertools.combinations([link for link, of_link in spheres.items() if of_link], 2):
        pair = ordered_pair(first, second)
        if groups[first] == groups[second]:
            reports.append(PairReport(pair, "rigid", 0.0))
        elif frozenset((groups[first], groups[second])) in joined:
            reports.append(PairReport(pair, "adjacent", 0.0))
        else:
            candidates.append(pair)
    contacts, overlapping = _contacts(urdf, tree, spheres, candidates, samples, seed, progress)
    overlaps = overlapping.mean(1).tolist()
    found = [
        PairReport(pair, _reason(shares[0]), *shares)
        for pair, *shares in zip(candidates, contacts, overlaps, strict=True)
    ]
    checked = np.array([not pair.ignored for pair in found], dtype=bool)
    _warn_of_coarse(found)
    return Contacts(reports + found, free=1.0 - float(overlapping[checked].any(0).mean()))


def _reason(contacts: float) -> str:
    if contacts == 0.0:
        return "never"
    return "always" if contacts > _ALWAYS else "checked"


def _warn_of_coarse(pairs: list[PairReport]) -> None:
    """Warns of pairs whose spheres touch far more often than the links do."""
    coarse = [pair for pair in pairs if not pair.ignored and pair.overlaps - pair.contacts > _COARSE]
    if coarse:
        text = f"spheres touch far more often than their links: {_names(coarse)}. Free configurations are lost by it"
        ways = (
            "more spheres (--spheres) or descents (--starts) may help; self_collision_ignore in the file leaves it out"
        )
        warnings.warn(f"{text}; {ways}", GrrWarning, stacklevel=3)


def _names(pairs: list[PairReport]) -> str:
    ordered = sorted(pairs, key=lambda pair: pair.contacts - pair.overlaps)
    more = f" and {len(pairs) - _NAMED} more" if len(pairs) > _NAMED else ""
    return ", ".join(map(str, ordered[:_NAMED])) + more


def _group(urdf: Urdf, link: str) -> str:
    """The topmost link that a link is rigidly fixed to."""
    while link in urdf.parent_joint and not urdf.parent_joint[link].movable:
        link = urdf.parent_joint[link].parent
    return link


def _contacts(
    urdf: Urdf,
    tree: KinematicTree,
    spheres: Mapping[str, tuple[Sphere, ...]],
    pairs: list[tuple[str, str]],
    samples: int,
    seed: int,
    progress: Progress,
) -> tuple[list[float], Mask]:
    """Share of random configurations in which each pair's geometry touches; in which (P, samples) its spheres do."""
    import fcl

    links = sorted({link for pair in pairs for link in pair})
    objects = {link: fcl.CollisionObject(_bvh(urdf, link)) for link in links}
    centres = {link: np.array([sphere.center for sphere in spheres[link]]) for link in links}
    radii = {link: np.array([sphere.radius for sphere in spheres[link]]) for link in links}
    generator = torch.Generator().manual_seed(seed)
    contacts, overlapping = np.zeros(len(pairs), dtype=np.int64), np.zeros((len(pairs), samples), dtype=bool)
    for start in range(0, samples if pairs else 0, _CONFIGURATIONS_AT_ONCE):
        progress("testing contacts", start, samples)
        poses = _random_poses(urdf, tree, links, min(_CONFIGURATIONS_AT_ONCE, samples - start), generator)
        placed = {link: _placed(centres[link], pose) for link, pose in poses.items()}
        for index, (first, second) in enumerate(pairs):
            reach = radii[first][:, None] + radii[second]
            near = _near(placed[first], placed[second], reach)
            overlapping[index, start + np.array(near, dtype=np.int64)] = True
            for k in near:
                for link in (first, second):
                    objects[link].setTransform(fcl.Transform(poses[link][k, :3, :3], poses[link][k, :3, 3]))
                contacts[index] += bool(fcl.collide(objects[first], objects[second]))
    progress("testing contacts", samples, samples)
    return [float(count) / samples for count in contacts], overlapping


def _placed(centres: Points, poses: Points) -> Points:
    """Centres (S, 3) of a link's spheres at its poses (K, 4, 4): (K, S, 3)."""
    return centres @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]


def _near(first: Points, second: Points, reach: Points) -> list[int]:
    """Configurations in which some sphere of one link overlaps one of the other."""
    overlaps = (reach - _distances(first, second)).max((1, 2)) > 0.0
    return np.flatnonzero(overlaps).tolist()


def _distances(first: Points, second: Points) -> Points:
    """Distances (K, A, B) between points (K, A, 3) and (K, B, 3)."""
    return torch.cdist(torch.from_numpy(first), torch.from_numpy(second)).numpy()


def _random_poses(
    urdf: Urdf, tree: KinematicTree, links: list[str], count: int, generator: torch.Generator
) -> dict[str, Points]:
    """Poses (count, 4, 4) of links in random configurations of all joints."""
    free = degrees_of_freedom(list(urdf.joints.values()), {})
    ranges = [sampling_range(joint.kind, joint.lower, joint.upper) for joint in free]
    low, high = torch.tensor(ranges, dtype=torch.float64).reshape(-1, 2).T
    q = low + (high - low) * torch.rand(count, len(free), dtype=torch.float64, generator=generator)
    frames = tree.frames(q.T.contiguous())
    poses: dict[str, Points] = {}
    for link in links:
        matrix = np.tile(np.eye(4), (count, 1, 1))
        matrix[:, :3] = tree.link_pose(frames, link).permute(2, 1, 0).numpy()
        poses[link] = matrix
    return poses


def _bvh(urdf: Urdf, link: str) -> Any:
    import fcl
    import trimesh

    mesh: Any = trimesh.util.concatenate(link_meshes(urdf, link))
    model = fcl.BVHModel()
    model.beginModel(len(mesh.vertices), len(mesh.faces))
    model.addSubModel(mesh.vertices, mesh.faces)
    model.endModel()
    return model
