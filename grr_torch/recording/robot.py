"""Putting a robot into a recording: its geometry once, its joints as columns over time."""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from grr_torch.errors import GrrWarning, MeshNotFoundError
from grr_torch.robots.robot import Robot
from grr_torch.robots.urdf import Joint, Urdf

Array = npt.NDArray[np.float64]


class RecordedRobot:
    """A robot in a recording, below the entity `robot`."""

    def __init__(self, recording: Any, robot: Robot) -> None:
        """Logs the geometry; a missing mesh, or a robot that rerun cannot display, is left out with a warning."""
        from rerun.urdf import UrdfTree

        self._recording, self._robot = recording, robot
        self._tree: UrdfTree | None = None
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_bytes(displayable(robot, "recording"))
            try:
                tree = UrdfTree.from_file_path(path, entity_path_prefix="robot")
                tree.log_urdf_to_recording(recording)
                self._tree = tree
            except RuntimeError as error:
                reason = (str(error).splitlines() or [type(error).__name__])[0]
                text = f"the robot is left out of the recording: rerun cannot display its URDF: {reason}"
                warnings.warn(text, GrrWarning, stacklevel=3)

    def animate(self, timeline: Any, q: Array) -> None:
        """Moves the robot through configurations (T, n) at the T times of a rerun time column."""
        if self._tree is None:
            return
        for joint in self._robot.urdf.joints.values():
            if joint.movable:
                values = self._values(joint, q)
                shown = self._tree.get_joint_by_name(joint.name)
                if shown is not None:
                    columns = shown.compute_transform_columns(values.tolist(), clamp=False)
                    self._recording.send_columns(f"robot/joints/{joint.name}", indexes=[timeline], columns=columns)

    def _values(self, joint: Joint, q: Array) -> Array:
        robot = self._robot
        if joint.name in robot.joint_names:
            return q[:, robot.joint_names.index(joint.name)]
        if joint.name in robot.held_joints or joint.mimic is None:
            return np.full(len(q), robot.held_joints.get(joint.name, 0.0))
        source, multiplier, offset = joint.mimic
        return multiplier * self._values(robot.urdf.joints[source], q) + offset


def displayable(robot: Robot, where: str) -> bytes:
    """The URDF with nothing but what is seen; warns of meshes that `where` it is shown will lack.

    Links have visual shapes only, with absolute mesh paths; joints have no limits, and those that never move are fixed.
    Displays read more strictly than `read_urdf`: they stop at a limit without a velocity, or an inertia without a mass.
    """
    from lxml import etree

    root = etree.fromstring(robot.urdf.text.encode(), etree.XMLParser(resolve_entities=False, no_network=True))
    missing: set[str] = set()
    for link in root.findall("link"):
        _keep(link, "visual" if link.find("visual") is not None else "collision")
        for shape in list(link):
            shape.tag = "visual"
            try:
                _complete_mesh(shape.find("geometry/mesh"), robot.urdf, link.get("name", ""))
            except MeshNotFoundError as error:
                missing.add(error.filename)
                link.remove(shape)
    for joint in root.findall("joint"):
        _keep(joint, "parent", "child", "origin", "axis")
        if not robot.urdf.joints[joint.get("name", "")].movable:
            joint.set("type", "fixed")
    _complete_materials(root)
    if missing:
        text = (
            f"meshes left out of the {where}, not found: {', '.join(sorted(missing))}. "
            "Folders to search for package:// names are given by --package-dir (package_dirs of load_robot)"
        )
        warnings.warn(text, GrrWarning, stacklevel=3)
    return bytes(etree.tostring(root))


def _keep(parent: Any, *tags: str) -> None:
    for child in list(parent):
        if child.tag not in tags:
            parent.remove(child)


def _complete_mesh(mesh: Any, urdf: Urdf, link: str) -> None:
    """Writes out where a mesh lies, and the scale in x, y and z."""
    if mesh is not None:
        mesh.set("filename", str(urdf.mesh_path(mesh.get("filename", ""), link)))
        scale = mesh.get("scale", "1").split()
        mesh.set("scale", " ".join(scale * 3 if len(scale) == 1 else scale))


def _complete_materials(root: Any) -> None:
    for material in root.iter("material"):
        material.set("name", material.get("name", ""))
    for colour in root.iter("color"):
        shades = colour.get("rgba", "").split()
        colour.set("rgba", " ".join([*shades, "1"] if len(shades) == 3 else shades))
