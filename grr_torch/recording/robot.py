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
from grr_torch.robots.urdf import Joint

Array = npt.NDArray[np.float64]


class RecordedRobot:
    """A robot in a recording, below the entity `robot`."""

    def __init__(self, recording: Any, robot: Robot) -> None:
        """Logs the geometry; a mesh that is not there any more is left out, with a warning."""
        from rerun.urdf import UrdfTree

        self._recording, self._robot = recording, robot
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_bytes(displayable(robot, "recording"))
            self._tree = UrdfTree.from_file_path(path, entity_path_prefix="robot")
            self._tree.log_urdf_to_recording(recording)

    def animate(self, timeline: Any, q: Array) -> None:
        """Moves the robot through configurations (T, n) at the T times of a rerun time column."""
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
    """The URDF with visual shapes only and absolute mesh paths; warns of meshes that `where` it is shown will lack."""
    from lxml import etree

    root = etree.fromstring(robot.urdf.text.encode(), etree.XMLParser(resolve_entities=False, no_network=True))
    missing: list[str] = []
    for link in root.iter("link"):
        tag = "visual" if link.find("visual") is not None else "collision"
        for shape in list(link):
            if shape.tag in ("visual", "collision") and shape.tag != tag:
                link.remove(shape)
                continue
            mesh = shape.find("geometry/mesh")
            if mesh is None:
                continue
            try:
                mesh.set("filename", str(robot.urdf.mesh_path(mesh.get("filename", ""), link.get("name", ""))))
            except MeshNotFoundError:
                missing.append(mesh.get("filename", ""))
                link.remove(shape)
        for shape in link.findall("collision"):
            shape.tag = "visual"
    if missing:
        text = f"{len(missing)} meshes are left out of the {where}, not found: {', '.join(sorted(set(missing)))}"
        warnings.warn(text, GrrWarning, stacklevel=3)
    return bytes(etree.tostring(root))
