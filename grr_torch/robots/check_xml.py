"""What the XML of a URDF must have for a parser to make sense of it: names, ends of joints, geometry, numbers."""

from __future__ import annotations

import difflib
from typing import Any

from grr_torch.errors import UrdfError

_JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
# how like one of these another type is that is a slip of the pen; others exist outside of URDF
_LIKE = 0.7
# attributes that a shape must have
_SHAPES = {"box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",), "mesh": ("filename",)}
# attributes that may be there, and how many numbers each holds
_NUMBERS = {
    "origin": {"xyz": 3, "rpy": 3},
    "axis": {"xyz": 3},
    "limit": {"lower": 1, "upper": 1, "effort": 1, "velocity": 1},
    "mimic": {"multiplier": 1, "offset": 1},
    "mass": {"value": 1},
    "inertia": dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), 1),
}


def check_xml(robot: Any, source: str) -> None:
    """Checks what is read of links and joints; all else in the file may be as it is.

    Args:
        robot: The root element.
        source: What it is called in errors.

    Raises:
        UrdfError: Something is missing, or is not what it must be; the link or joint is named.
    """
    for kind in ("link", "joint"):
        for number, item in enumerate(robot.findall(kind), 1):
            if not item.get("name"):
                raise UrdfError(source, f"<{kind}> number {number} has no name")
    for link in robot.findall("link"):
        where = f"link '{link.get('name')}'"
        for part in link.iterchildren("inertial", "visual", "collision"):
            _check_numbers(part, where, source)
            if part.tag != "inertial":
                _check_geometry(part, where, source)
    for joint in robot.findall("joint"):
        where = f"joint '{joint.get('name')}'"
        _check_ends(joint, where, source)
        _check_numbers(joint, where, source)


def _check_ends(joint: Any, where: str, source: str) -> None:
    kind = joint.get("type")
    if not kind:
        raise UrdfError(source, f"{where} has no type; valid: {', '.join(_JOINT_TYPES)}")
    meant = difflib.get_close_matches(kind, _JOINT_TYPES, n=1, cutoff=_LIKE)
    if meant and kind not in _JOINT_TYPES:
        known = ", ".join(_JOINT_TYPES)
        raise UrdfError(source, f"{where} is of type '{kind}'. Did you mean '{meant[0]}'? Known: {known}")
    for end in ("parent", "child"):
        element = joint.find(end)
        if element is None or not element.get("link"):
            raise UrdfError(source, f'{where} has no <{end} link="…"/>')
    mimic = joint.find("mimic")
    if mimic is not None and not mimic.get("joint"):
        raise UrdfError(source, f"{where} has a <mimic> without joint")


def _check_geometry(part: Any, where: str, source: str) -> None:
    geometry = part.find("geometry")
    if geometry is None:
        raise UrdfError(source, f"{where} has a <{part.tag}> without <geometry>")
    shapes = list(geometry.iterchildren(tag="*"))
    # a parser takes the first
    if not shapes or shapes[0].tag not in _SHAPES or sum(shape.tag in _SHAPES for shape in shapes) > 1:
        given = ", ".join(f"<{shape.tag}>" for shape in shapes) or "nothing"
        valid = f"one of {', '.join(f'<{tag}>' for tag in _SHAPES)}"
        raise UrdfError(source, f"{where}: the <geometry> of a <{part.tag}> holds {given}; valid: {valid}")
    shape = shapes[0]
    for name in _SHAPES[shape.tag]:
        if not shape.get(name):
            raise UrdfError(source, f"{where} has a <{shape.tag}> without {name}")
    for name, one in (("size", False), ("scale", False), ("radius", True), ("length", True)):
        text = shape.get(name)
        count = 1 if text is None else _count(text.replace(",", " "))
        if count is None or (one and count != 1):
            valid = "a number" if one else "numbers"
            raise UrdfError(source, f'{where}: got <{shape.tag} {name}="{text}">; valid: {valid}')


def _check_numbers(item: Any, where: str, source: str) -> None:
    """Checks the numbers of the elements directly below one."""
    for tag, attributes in _NUMBERS.items():
        element = item.find(tag)
        for name, wanted in attributes.items() if element is not None else ():
            text = element.get(name)
            if text is not None and _count(text) != wanted:
                valid = "a number" if wanted == 1 else f"{wanted} numbers, with blanks between them"
                raise UrdfError(source, f'{where}: got <{tag} {name}="{text}">; valid: {valid}')


def _count(text: str) -> int | None:
    """How many numbers a text is; None: it is something else."""
    try:
        return len(list(map(float, text.split())))
    except ValueError:
        return None
