"""URDF reading: parses and validates the text of a URDF."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from grr_torch.errors import GrrWarning, UrdfError
from grr_torch.robots.check_xml import check_xml
from grr_torch.robots.urdf import MOVABLE_TYPES, Joint, Shape, Urdf

# metres beyond which an origin is a mistake
_FARTHEST = 1e6
# metres beyond which origins are likely to be millimetres
_FAR_AWAY = 20.0
# radians beyond which limits are likely to be degrees
_FARTHEST_TURN = 4.0 * math.pi
_LIMITED_TYPES = ("revolute", "prismatic")


def read_urdf(path: str | os.PathLike[str], package_dirs: Sequence[str | os.PathLike[str]] = ()) -> Urdf:
    """Reads and validates a URDF file.

    Raises:
        UrdfError: The file is missing, empty, malformed, or does not describe one tree of joints.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file():
            raise UrdfError(path, "is not a regular file")
        data = path.read_bytes()
    except OSError as error:
        raise UrdfError(path, f"cannot be read: {error.strerror}") from error
    return parse_urdf(data, source=str(path), directory=path.resolve().parent, package_dirs=package_dirs)


def parse_urdf(
    data: bytes,
    *,
    source: str,
    directory: Path | None = None,
    package_dirs: Sequence[str | os.PathLike[str]] = (),
) -> Urdf:
    """Validates URDF text; see `read_urdf`. `source` names it in errors."""
    parsed, text = _parse(data, source)
    links = tuple(link.name for link in parsed.links)
    if not links:
        raise UrdfError(source, "has no <link>")
    _no_duplicates(source, "link", links)
    _no_duplicates(source, "joint", [joint.name for joint in parsed.joints])
    joints = {joint.name: _joint(joint, source) for joint in parsed.joints}
    urdf = Urdf(
        name=parsed.name,
        text=text,
        directory=directory,
        package_dirs=tuple(Path(folder).resolve() for folder in package_dirs),
        root=_root(links, joints, source),
        links=links,
        joints=joints,
        collisions={link.name: _shapes(link.collisions, link.name, source) for link in parsed.links},
        visuals={link.name: _shapes(link.visuals, link.name, source) for link in parsed.links},
    )
    _warn_of_limits(parsed.joints, source)
    return urdf


def _parse(data: bytes, source: str) -> tuple[Any, str]:
    """What yourdfpy reads, and the text without an encoding of its own."""
    import yourdfpy
    from lxml import etree

    if not data.strip():
        raise UrdfError(source, "is empty")
    try:
        # yourdfpy falls back to a recovering parser, which would accept half a file
        root = etree.fromstring(data, etree.XMLParser(resolve_entities=False, no_network=True))
    except etree.XMLSyntaxError as error:
        raise UrdfError(source, f"is not well-formed XML: {error}") from error
    if root.getroottree().docinfo.doctype:
        raise UrdfError(source, "has a DOCTYPE, which a URDF has no use for")
    if any(isinstance(item.tag, str) and "xacro" in item.tag for item in root.iter()):
        raise UrdfError(source, "is xacro, not URDF: expand it with the xacro tool first")
    if root.tag != "robot":
        raise UrdfError(source, f"is not a URDF: its root element is <{root.tag}>, not <robot>")
    if "name" not in root.attrib:
        raise UrdfError(source, "<robot> has no name")
    check_xml(root, source)
    try:
        urdf = yourdfpy.URDF.load(BytesIO(etree.tostring(root)), build_scene_graph=False, load_meshes=False)
    except (KeyError, ValueError, AttributeError, IndexError, TypeError) as error:
        raise UrdfError(source, f"is malformed: {type(error).__name__}: {error}") from error
    return urdf.robot, str(etree.tostring(root, encoding="unicode"))


def _no_duplicates(source: str, kind: str, names: Sequence[str]) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise UrdfError(source, f"has more than one {kind} named {', '.join(map(repr, twice))}")


def _joint(parsed: Any, source: str) -> Joint:
    where = f"joint '{parsed.name}'"
    movable = parsed.type in MOVABLE_TYPES
    origin = np.eye(4) if parsed.origin is None else np.asarray(parsed.origin, dtype=np.float64)
    axis = np.asarray(parsed.axis, dtype=np.float64)
    length = float(np.linalg.norm(axis))
    if not (np.abs(origin) < _FARTHEST).all() or axis.shape != (3,) or not np.isfinite(length):
        raise UrdfError(source, f"{where}: its origin or axis is not finite")
    if length < 1e-9:
        if movable:
            raise UrdfError(source, f"{where} has an axis of length zero")
        axis, length = np.array([1.0, 0.0, 0.0]), 1.0
    lower, upper = _limits(parsed, where, source)
    velocity = parsed.limit.velocity if parsed.limit is not None else None
    if velocity is not None and not velocity >= 0.0:
        raise UrdfError(source, f"{where} has a velocity limit of {velocity}; valid: 0 or more")
    mimic = None
    if parsed.mimic is not None and movable:
        mimic = (parsed.mimic.joint, float(parsed.mimic.multiplier), float(parsed.mimic.offset))
        if not all(map(math.isfinite, mimic[1:])):
            raise UrdfError(source, f"{where} mimics with multiplier and offset {mimic[1:]}; valid: finite")
    return Joint(
        name=parsed.name,
        kind=parsed.type,
        parent=parsed.parent,
        child=parsed.child,
        origin=origin,
        axis=axis / length,
        lower=lower,
        upper=upper,
        velocity=velocity if velocity else math.inf,
        mimic=mimic,
    )


def _limits(parsed: Any, where: str, source: str) -> tuple[float, float]:
    """Position limits; a limit that is not written does not exist (a parser's 0 would freeze the joint)."""
    limit = parsed.limit
    if parsed.type not in _LIMITED_TYPES or not _written(limit):
        return -math.inf, math.inf
    lower = 0.0 if limit.lower is None else float(limit.lower)
    upper = 0.0 if limit.upper is None else float(limit.upper)
    if not lower <= upper or lower == math.inf or upper == -math.inf:
        raise UrdfError(source, f"{where} has limits lower={lower}, upper={upper}; valid: lower ≤ upper")
    return lower, upper


def _warn_of_limits(joints: Sequence[Any], source: str) -> None:
    """Warns once of each kind of limit that is valid, and hardly what was meant."""
    unwritten = [joint for joint in joints if joint.type in _LIMITED_TYPES and not _written(joint.limit)]
    written = [joint for joint in joints if joint.type == "revolute" and _written(joint.limit)]
    far = [
        joint
        for joint in written
        if any(_FARTHEST_TURN < abs(bound or 0.0) < math.inf for bound in (joint.limit.lower, joint.limit.upper))
    ]
    still = [joint for joint in joints if joint.type in MOVABLE_TYPES and joint.limit and joint.limit.velocity == 0.0]
    away = [joint for joint in joints if joint.origin is not None and np.abs(joint.origin[:3, 3]).max() > _FAR_AWAY]
    for found, text in (
        (away, f"more than {_FAR_AWAY:g} m away from the link before: is its origin in millimetres?"),
        (far, "position limits beyond ±4π rad: are they in degrees?"),
        (unwritten, "no position limits (lower, upper): taken as unlimited, though URDF's default is 0 to 0"),
        (still, "a velocity limit of 0: taken as none"),
    ):
        if found:
            names = ", ".join(joint.name for joint in found)
            warnings.warn(f"{source}: {text} ({names})", GrrWarning, stacklevel=5)


def _written(limit: Any) -> bool:
    return limit is not None and not (limit.lower is None and limit.upper is None)


def _root(links: Sequence[str], joints: Mapping[str, Joint], source: str) -> str:
    """The one link without a parent; checks that joints and links make one tree."""
    parent_of: dict[str, str] = {}
    for joint in joints.values():
        for link in (joint.parent, joint.child):
            if link not in links:
                raise UrdfError(source, f"joint '{joint.name}' names link '{link}', which does not exist")
        if joint.child in parent_of:
            raise UrdfError(source, f"link '{joint.child}' has more than one parent joint")
        parent_of[joint.child] = joint.parent
        if joint.mimic is not None and (joint.mimic[0] not in joints or not joints[joint.mimic[0]].movable):
            raise UrdfError(source, f"joint '{joint.name}' mimics '{joint.mimic[0]}', which is no movable joint")
    roots = [link for link in links if link not in parent_of]
    if len(roots) > 1:
        raise UrdfError(source, f"has more than one root link: {', '.join(roots)}")
    if not roots or any(_depth(link, parent_of) < 0 for link in links):
        raise UrdfError(source, "its joints form a loop")
    for joint in joints.values():
        _mimic_source(joint, joints, source)
    return roots[0]


def _depth(link: str, parent_of: Mapping[str, str]) -> int:
    depth = 0
    while link in parent_of:
        link, depth = parent_of[link], depth + 1
        if depth > len(parent_of):
            return -1
    return depth


def _mimic_source(joint: Joint, joints: Mapping[str, Joint], source: str) -> None:
    seen = {joint.name}
    while joint.mimic is not None:
        joint = joints[joint.mimic[0]]
        if joint.name in seen:
            raise UrdfError(source, f"joint '{joint.name}' mimics itself")
        seen.add(joint.name)


def _shapes(parsed: Sequence[Any], link: str, source: str) -> tuple[Shape, ...]:
    shapes: list[Shape] = []
    for item in parsed:
        geometry = item.geometry
        if geometry.box is not None:
            kind, size = "box", tuple(map(float, geometry.box.size))
        elif geometry.cylinder is not None:
            kind, size = "cylinder", (geometry.cylinder.radius, geometry.cylinder.length)
        elif geometry.sphere is not None:
            kind, size = "sphere", (geometry.sphere.radius,)
        else:
            kind, size = "mesh", _scale(geometry.mesh.scale)
        wanted = {"box": 3, "cylinder": 2, "sphere": 1, "mesh": 3}[kind]
        if len(size) != wanted or not all(
            math.isfinite(value) and (value > 0.0 or (kind == "mesh" and value < 0.0)) for value in size
        ):
            valid = f"{wanted} finite values, {'not zero' if kind == 'mesh' else 'positive'}"
            raise UrdfError(source, f"link '{link}' has a {kind} of size {size}; valid: {valid}")
        origin = np.eye(4) if item.origin is None else np.asarray(item.origin, dtype=np.float64)
        if not (np.abs(origin) < _FARTHEST).all():
            raise UrdfError(source, f"link '{link}' has a {kind} whose origin is not finite")
        filename = geometry.mesh.filename if kind == "mesh" else None
        shapes.append(Shape(kind, origin, size, filename))
    return tuple(shapes)


def _scale(scale: Any) -> tuple[float, ...]:
    if scale is None:
        return (1.0, 1.0, 1.0)
    factors = np.asarray(scale, dtype=np.float64).reshape(-1).tolist()
    return tuple(factors * 3 if len(factors) == 1 else factors)
