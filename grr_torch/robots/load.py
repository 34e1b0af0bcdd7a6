"""Making a `Robot` from a bundled name or any URDF."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from grr_torch.errors import GrrWarning, ParameterError, UnknownNameError, UrdfError
from grr_torch.robots.compile_tree import compile_tree, degrees_of_freedom
from grr_torch.robots.presets import Preset, load_preset, robot_names
from grr_torch.robots.read_urdf import read_urdf
from grr_torch.robots.robot import Robot
from grr_torch.robots.spheres import SphereModel
from grr_torch.robots.urdf import MOVABLE_TYPES, Joint, Urdf


def load_robot(
    name_or_path: str | os.PathLike[str],
    *,
    tool: str | None = None,
    base: str | None = None,
    package_dirs: Sequence[str | os.PathLike[str]] = (),
    allow_missing_meshes: bool = False,
    held_joints: Mapping[str, float] | None = None,
    spheres: str | os.PathLike[str] | SphereModel | None = None,
    margin: float | None = None,
    device: torch.device | str | None = None,
    dtype: torch.dtype = torch.float64,
) -> Robot:
    """Loads a bundled robot or a URDF file.

    Args:
        name_or_path: A bundled name (`grr-torch robots` lists them) or the path of a URDF.
        tool: Link whose pose is controlled; by default the preset's, or the URDF's last link if it has one only.
        base: Link in whose frame poses are given; by default the preset's, or the URDF's root.
        package_dirs: Folders in which `package://` mesh names are searched before those above the URDF.
        allow_missing_meshes: Whether to go on where meshes are missing: kinematics needs none, and the robot is shown
            without them.
        held_joints: Values [rad or m] of joints that do not move. Joints outside the chain stay at 0 by default.
        spheres: Sphere file or model; by default the preset's. A URDF without one is not checked for self-collision.
        margin: Distance [m] below which two links count as in collision; by default the preset's, or 0.
        device: Where tensors live; the CPU by default.
        dtype: torch.float64, or torch.float32 where less accuracy will do.

    Raises:
        UnknownNameError: No such robot, link or joint; the known ones are listed.
        MeshNotFoundError: A mesh is missing that may not be.
        UrdfError: The URDF is malformed, or between base and tool has no movable joint or one of a type not supported.
        FileFormatError: The sphere file is not one.
        ParameterError: No tool is given for a URDF with several ends, or a held value, the margin, the device or the
            dtype is not valid.
    """
    if dtype not in (torch.float64, torch.float32):
        raise ParameterError("dtype", dtype, "torch.float64 or torch.float32")
    preset = _preset(name_or_path)
    urdf = read_urdf(preset.urdf if preset else name_or_path, package_dirs)
    base = base or (preset.base if preset else urdf.root)
    tool = tool or (preset.tool if preset else _only_leaf(urdf))
    if spheres is None and preset is not None and preset.spheres is not None:
        spheres = preset.spheres
    if spheres is not None and not isinstance(spheres, SphereModel):
        spheres = SphereModel.load(spheres, urdf.links)
    if margin is None:
        margin = preset.margin if preset else 0.0
    elif spheres is None:
        warnings.warn("the margin has no effect: there is no sphere file to check with", GrrWarning, stacklevel=2)
    robot = make_robot(
        urdf,
        name=preset.name if preset else urdf.name,
        base=base,
        tool=tool,
        held_joints=held_joints or {},
        spheres=spheres,
        margin=margin,
        device=find_device(device),
        dtype=dtype,
    )
    if not allow_missing_meshes:
        urdf.check_meshes()
    return replace(robot, preset=preset)


def make_robot(
    urdf: Urdf,
    *,
    name: str,
    base: str,
    tool: str,
    held_joints: Mapping[str, float],
    spheres: SphereModel | None,
    margin: float,
    device: torch.device,
    dtype: torch.dtype,
) -> Robot:
    """Makes a `Robot` from a validated URDF; see `load_robot`."""
    if spheres is not None:
        spheres.check_links(urdf.links)
    held = _held(urdf, held_joints)
    path = urdf.path(base, tool)
    _check_types(urdf, path)
    moving = degrees_of_freedom(path, held)
    if not moving:
        raise UrdfError(urdf.name, f"no movable joint between base '{base}' and tool '{tool}'")
    tree = compile_tree(urdf, path, base, tool, held, dtype=dtype, device=device)
    figures = {joint.name: [joint.lower, joint.upper, joint.velocity] for joint in moving}
    wraps = {joint.name: joint.kind == "continuous" for joint in moving}
    for joint in urdf.joints.values():
        _add_mimic(urdf, joint, held, figures, wraps)
    lower, upper, velocity = (
        torch.tensor([row[k] for row in figures.values()], dtype=dtype, device=device) for k in range(3)
    )
    if bool((lower > upper).any()):
        raise UrdfError(urdf.name, "a joint and one that mimics it have limits that exclude each other")
    return Robot(
        name=name,
        urdf=urdf,
        base=base,
        tool=tool,
        joint_names=tuple(figures),
        lower=lower,
        upper=upper,
        continuous=torch.tensor(list(wraps.values()), device=device),
        velocity_limits=velocity,
        held_joints=held,
        tree=tree,
        spheres=spheres,
        margin=0.0,
    ).with_margin(margin)


def find_device(device: torch.device | str | None) -> torch.device:
    """The device, after a first tensor was put on it.

    Raises:
        ParameterError: There is no such device.
    """
    try:
        found = torch.device("cpu" if device is None else device)
        torch.zeros(1, device=found).cpu()
    except (RuntimeError, TypeError, AssertionError, NotImplementedError, ImportError) as error:
        available = "cpu, cuda" if torch.cuda.is_available() else "cpu (no CUDA device is available)"
        raise ParameterError("device", device, available) from error
    return found


def _preset(name_or_path: str | os.PathLike[str]) -> Preset | None:
    """The preset of a bundled name; None for what is, or looks like, a path."""
    text = os.fspath(name_or_path)
    if text in robot_names():
        return load_preset(text)
    if os.sep not in text and not Path(text).suffix and not Path(text).exists():
        raise UnknownNameError("robot", text, robot_names(), " A URDF is given by its path.")
    return None


def _only_leaf(urdf: Urdf) -> str:
    leaves = urdf.leaves()
    if len(leaves) > 1:
        raise ParameterError(
            "tool", "nothing", f"one of the links (--tool), as the URDF has several ends: {', '.join(leaves)}"
        )
    return leaves[0]


def _held(urdf: Urdf, held_joints: Mapping[str, float]) -> dict[str, float]:
    movable = [joint.name for joint in urdf.joints.values() if joint.movable]
    for name, value in held_joints.items():
        if name not in movable:
            raise UnknownNameError("joint", name, movable, " (to be held)")
        joint = urdf.joints[name]
        if not math.isfinite(value) or not joint.lower <= value <= joint.upper:
            raise ParameterError(f"held joint '{name}'", value, f"{joint.lower} to {joint.upper}")
    return {name: float(value) for name, value in held_joints.items()}


def _check_types(urdf: Urdf, path: Sequence[Joint]) -> None:
    for joint in path:
        if joint.kind not in (*MOVABLE_TYPES, "fixed"):
            supported = f"supported: {', '.join(MOVABLE_TYPES)}, fixed"
            chain = f"the chain from '{path[0].parent}' to '{path[-1].child}', outside of which it would be held"
            raise UrdfError(urdf.name, f"joint '{joint.name}' is of type '{joint.kind}'; {supported} in {chain}")


def _add_mimic(
    urdf: Urdf, joint: Joint, held: Mapping[str, float], figures: dict[str, list[float]], wraps: dict[str, bool]
) -> None:
    """Narrows the limits of the joint that drives a mimic joint by the mimic joint's own.

    A full turn of a continuous joint changes nothing only if it is a whole number of turns of what follows it.
    """
    multiplier, offset, source = 1.0, 0.0, joint
    while source.mimic is not None and source.name not in held:
        name, factor, shift = source.mimic
        multiplier, offset, source = multiplier * factor, multiplier * shift + offset, urdf.joints[name]
    if source is joint or source.name not in figures or multiplier == 0.0:
        return
    ends = sorted([(joint.lower - offset) / multiplier, (joint.upper - offset) / multiplier])
    driver = figures[source.name]
    driver[0], driver[1] = max(driver[0], ends[0]), min(driver[1], ends[1])
    driver[2] = min(driver[2], joint.velocity / abs(multiplier))
    periodic = joint.kind != "prismatic" and multiplier.is_integer() and math.isinf(ends[0]) and math.isinf(ends[1])
    wraps[source.name] = wraps[source.name] and periodic
