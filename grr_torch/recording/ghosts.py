"""Translucent copies of a robot in a recording: one mesh a link, drawn at many poses."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from grr_torch.errors import MeshNotFoundError
from grr_torch.robots.geometry import link_meshes
from grr_torch.robots.robot import Robot

Colour = tuple[int, int, int, int]


def log_ghosts(recording: Any, robot: Robot, entity: str, configurations: Tensor, colour: Colour) -> None:
    """Draws the collision shapes of a robot at configurations (K, n), all in one colour with its opacity.

    Links without collision geometry, or whose mesh is not there any more, are left out.
    """
    import rerun as rr

    poses = robot.link_poses(configurations)
    for link in robot.urdf.collisions:
        try:
            meshes = link_meshes(robot.urdf, link)
        except MeshNotFoundError:
            continue
        if not meshes:
            continue
        pose = poses[link].cpu().numpy()
        shifts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        recording.log(
            f"{entity}/{link}",
            rr.CoordinateFrame(robot.base),
            rr.Mesh3D(
                vertex_positions=np.vstack([mesh.vertices for mesh in meshes]),
                triangle_indices=np.vstack([m.faces + shift for m, shift in zip(meshes, shifts, strict=False)]),
                vertex_normals=np.vstack([mesh.vertex_normals for mesh in meshes]),
                albedo_factor=colour,
            ),
            rr.InstancePoses3D(translations=pose[:, :3, 3], mat3x3=pose[:, :3, :3]),
            static=True,
        )
