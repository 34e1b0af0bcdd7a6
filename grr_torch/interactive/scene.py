"""What the page shows in space: the arm, its roadmap, the target's handle and the tool's trail."""

from __future__ import annotations

import io
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from grr_torch.recording import colours
from grr_torch.recording.robot import displayable
from grr_torch.recording.self_motion_view import in_space
from grr_torch.resolution.roadmap import Roadmap
from grr_torch.resolution.slices import fullest_slice
from grr_torch.robots.robot import Robot
from grr_torch.spaces.rotation import quaternion_from_matrix

if TYPE_CHECKING:
    from trimesh import Trimesh

# positions of the tool that its trail shows
_TRAIL = 160


def link_meshes(robot: Robot) -> dict[str, list[Trimesh]]:
    """What is seen of each link, in its frame [m], in the URDF's colours; warns of meshes that are missing."""
    import yourdfpy
    from trimesh import Trimesh

    urdf = yourdfpy.URDF.load(io.BytesIO(displayable(robot, "page")))
    scene = urdf.scene
    parts: dict[str, list[Trimesh]] = {}
    for node in scene.graph.nodes_geometry:
        link = scene.graph.transforms.parents[node]
        solid = scene.geometry[scene.graph[node][1]]
        # a primitive is made a plain mesh, so that several can be joined
        mesh = Trimesh(solid.vertices, solid.faces, visual=solid.visual.copy(), process=False)
        mesh.apply_transform(scene.graph.get(node, link)[0])
        parts.setdefault(link, []).append(mesh)
    return parts


class ArmView:
    """An arm on the page, a frame for each link."""

    def __init__(self, server: Any, robot: Robot) -> None:
        self._robot = robot
        self._frames: dict[str, Any] = {}
        # a link's name may hold a slash, which would make it part of another
        for index, (link, meshes) in enumerate(link_meshes(robot).items()):
            self._frames[link] = server.scene.add_frame(f"/arm/{index}", show_axes=False)
            for number, mesh in enumerate(_joined(meshes)):
                server.scene.add_mesh_trimesh(f"/arm/{index}/{number}", mesh)

    def show(self, configuration: Tensor) -> None:
        """Puts the arm at a configuration (n,)."""
        poses = self._robot.link_poses(configuration)
        if not self._frames:
            return
        placed = torch.stack([poses[link] for link in self._frames])
        turned = quaternion_from_matrix(placed[:, :3, :3]).cpu().numpy()
        for frame, position, wxyz in zip(self._frames.values(), placed[:, :3, 3].cpu().numpy(), turned, strict=True):
            frame.position, frame.wxyz = position, wxyz


def _joined(meshes: list[Trimesh]) -> list[Trimesh]:
    """One mesh of those that are coloured face by face; textured ones stay alone."""
    import trimesh

    textured: list[Any] = [mesh for mesh in meshes if isinstance(mesh.visual, trimesh.visual.TextureVisuals)]
    plain = [mesh for mesh in meshes if not isinstance(mesh.visual, trimesh.visual.TextureVisuals)]
    joined: list[Any] = [trimesh.util.concatenate(plain)] if plain else []
    return joined + textured


class MapView:
    """The roadmap on the page, in three parts that can be shown or hidden.

    Attributes:
        parts: What is shown, by name.
    """

    def __init__(self, server: Any, roadmap: Roadmap) -> None:
        # where rotation varies, the rotation in which most is resolved
        roadmap = fullest_slice(roadmap)
        points, resolved = in_space(roadmap.positions.numpy()), roadmap.resolved.numpy()
        first = roadmap.configurations[roadmap.resolved][:, 0].numpy()
        shade = colours.circle(first) if bool(roadmap.robot.continuous[0]) else colours.scale(first)
        dots = server.scene.add_point_cloud(
            "/roadmap/points",
            points[resolved].astype(np.float32),
            shade,
            point_size=(0.055 if roadmap.task.dimension == 3 else 0.12) * self._spacing(roadmap),
            point_shape="circle",
            precision="float32",
        )
        self.parts: dict[str, Any] = {"roadmap": dots}
        edges = roadmap.edges[~roadmap.connected].numpy()
        edges = edges[resolved[edges].all(1)]
        if len(edges):
            self.parts["broken edges"] = server.scene.add_line_segments(
                "/roadmap/broken",
                points[edges],
                colours.BROKEN[:3],
                thickness=3.0,
                thickness_units="screen",
                visible=False,
            )
        triangles, faces = (corners.numpy() for corners in roadmap.uncertified)
        cells = np.concatenate([triangles, faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
        if len(cells):
            self.parts["uncertified cells"] = server.scene.add_mesh_simple(
                "/roadmap/cells", points, cells, color=colours.WOUND[:3], opacity=0.35, side="double", visible=False
            )

    @staticmethod
    def _spacing(roadmap: Roadmap) -> float:
        """Median length of an edge [m]."""
        a, b = roadmap.positions[roadmap.edges].unbind(1)
        return float((a - b).norm(dim=1).median()) if len(a) else 0.1


class TrailView:
    """The tool's last seconds on the page, in colours of the status, and a dot where it is."""

    def __init__(self, server: Any, start: np.ndarray) -> None:
        self._places: deque[np.ndarray] = deque(maxlen=_TRAIL)
        self._hues: deque[tuple[int, int, int]] = deque(maxlen=_TRAIL)
        nothing = np.repeat(start[None, None], 2, axis=1)
        self._line = server.scene.add_line_segments(
            "/trail", nothing, np.zeros((1, 2, 3), dtype=np.uint8), thickness=3.0, thickness_units="screen"
        )

    def show(self, tool: np.ndarray, status: str) -> None:
        """Adds where the tool (3,) is."""
        if self._places and np.linalg.norm(tool - self._places[-1]) < 1e-3:
            return
        self._places.append(tool)
        self._hues.append(colours.STATUS[status])
        if len(self._places) > 1:
            places, hues = np.array(self._places), np.array(self._hues, dtype=np.uint8)
            self._line.points = np.stack([places[:-1], places[1:]], axis=1).astype(np.float32)
            self._line.colors = np.repeat(hues[1:, None], 2, axis=1)
