"""What a URDF says, validated and in float64: links, joints with their limits, shapes, and where meshes lie."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from urllib.parse import unquote, urlparse

import numpy as np
import numpy.typing as npt

from grr_torch.errors import MeshNotFoundError, UnknownNameError, UrdfError

Matrix = npt.NDArray[np.float64]

MOVABLE_TYPES = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True)
class Joint:
    """One joint of a URDF.

    Attributes:
        name: Its name.
        kind: "revolute", "continuous", "prismatic" or "fixed"; joints of other kinds do not move either.
        parent: Parent link.
        child: Child link.
        origin: (4, 4) pose of the joint's frame in the parent link's frame [m].
        axis: (3,) unit axis in the joint's frame.
        lower: Lower position limit [rad or m]; −inf where there is none.
        upper: Upper position limit [rad or m]; inf where there is none.
        velocity: Velocity limit [rad/s or m/s]; inf where there is none, or 0, which files write for unknown.
        mimic: (joint, multiplier, offset) where this joint follows another.
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: Matrix
    axis: Matrix
    lower: float
    upper: float
    velocity: float
    mimic: tuple[str, float, float] | None

    @property
    def movable(self) -> bool:
        """Whether the joint can have a value other than 0."""
        return self.kind in MOVABLE_TYPES


def sampling_range(kind: str, lower: float, upper: float) -> tuple[float, float]:
    """Where random values of a joint are drawn: its limits; ±π rad or ±1 m where there are none."""
    reach = 1.0 if kind == "prismatic" else math.pi
    if not math.isfinite(lower):
        lower = min(-reach, upper - 2.0 * reach)
    return lower, upper if math.isfinite(upper) else max(reach, lower + 2.0 * reach)


@dataclass(frozen=True)
class Shape:
    """One collision or visual shape of a link.

    Attributes:
        kind: "box", "cylinder", "sphere" or "mesh".
        origin: (4, 4) pose in the link's frame [m].
        size: Box: the three edges; cylinder: radius, length; sphere: radius; mesh: scale in x, y, z.
        filename: The mesh's name as the URDF gives it.
    """

    kind: str
    origin: Matrix
    size: tuple[float, ...]
    filename: str | None = None


@dataclass(frozen=True)
class Urdf:
    """A validated URDF: one tree of links and joints.

    Attributes:
        name: The robot's name.
        text: The XML it was read from.
        directory: Where relative mesh names start, or None when read from text alone.
        package_dirs: Folders in which `package://` names are searched before those above the URDF.
        root: The link that has no parent.
        links: Link names, in the file's order.
        joints: Joints by name, in the file's order.
        collisions: Collision shapes by link.
        visuals: Visual shapes by link.
    """

    name: str
    text: str
    directory: Path | None
    package_dirs: tuple[Path, ...]
    root: str
    links: tuple[str, ...]
    joints: Mapping[str, Joint]
    collisions: Mapping[str, tuple[Shape, ...]]
    visuals: Mapping[str, tuple[Shape, ...]]

    @cached_property
    def parent_joint(self) -> dict[str, Joint]:
        """The joint above each link (the root has none)."""
        return {joint.child: joint for joint in self.joints.values()}

    def path(self, base: str, tool: str) -> list[Joint]:
        """Joints from link `base` down to link `tool`, in that order.

        Raises:
            UnknownNameError: One of them is no link of this robot.
            UrdfError: `base` does not lie above `tool`.
        """
        for link in (base, tool):
            if link not in self.links:
                raise UnknownNameError("link", link, self.links)
        joints: list[Joint] = []
        link = tool
        while link != base:
            if link not in self.parent_joint:
                above = [tool, *(joint.parent for joint in joints)]
                raise UrdfError(
                    self.name, f"link '{base}' does not lie above '{tool}'; valid bases: {', '.join(above)}"
                )
            joints.append(self.parent_joint[link])
            link = joints[-1].parent
        return joints[::-1]

    def leaves(self) -> list[str]:
        """Links that have no child, in the file's order."""
        parents = {joint.parent for joint in self.joints.values()}
        return [link for link in self.links if link not in parents]

    def mesh_path(self, filename: str, link: str) -> Path:
        """Finds a mesh: relative to the URDF, absolute, `file://`, or `package://`.

        A package is looked for in `package_dirs`, then in the folders above the URDF; each may be the package itself.

        Raises:
            MeshNotFoundError: It is in none of these places.
        """
        try:
            candidates = self._mesh_candidates(filename)
        except ValueError:  # no name that a file could have
            candidates = []
        for candidate in candidates:
            if os.path.isfile(candidate):
                return candidate
        raise MeshNotFoundError(filename, link, candidates)

    def check_meshes(self) -> None:
        """Looks every mesh up.

        Raises:
            MeshNotFoundError: For the first one that is missing.
        """
        for shapes in (self.collisions, self.visuals):
            for link, of_link in shapes.items():
                for shape in of_link:
                    if shape.filename is not None:
                        self.mesh_path(shape.filename, link)

    def _mesh_candidates(self, filename: str) -> list[Path]:
        url = urlparse(filename)
        if url.scheme == "package":
            package, inside = unquote(url.netloc), unquote(url.path).lstrip("/")
            above = () if self.directory is None else (self.directory, *self.directory.parents)
            # a package folder may be named itself, or the folder that holds it
            return [
                path
                for folder in (*self.package_dirs, *above)
                for path in ([folder / inside] if folder.name == package else []) + [folder / package / inside]
            ]
        path = Path(unquote(url.path)) if url.scheme == "file" else Path(filename)
        return [path] if path.is_absolute() or self.directory is None else [self.directory / path]
