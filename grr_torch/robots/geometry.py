"""Solid geometry of a link: its collision shapes as triangle meshes, sampled points, and what is inside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from grr_torch.errors import UrdfError
from grr_torch.robots.urdf import Shape, Urdf

if TYPE_CHECKING:
    from trimesh import Trimesh

Points = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

# sides of the prism that stands for a cylinder; it is drawn around the circle
_SIDES = 64


def link_meshes(urdf: Urdf, link: str) -> list[Trimesh]:
    """The collision shapes of a link as triangle meshes in the link's frame [m].

    Raises:
        MeshNotFoundError: A mesh file is missing.
        UrdfError: A mesh file cannot be read or holds no triangles.
    """
    return [_shape_mesh(urdf, link, shape) for shape in urdf.collisions[link]]


def _shape_mesh(urdf: Urdf, link: str, shape: Shape) -> Trimesh:
    import trimesh

    if shape.kind == "box":
        mesh = trimesh.creation.box(extents=shape.size)
    elif shape.kind == "cylinder":
        radius, length = shape.size
        mesh = trimesh.creation.cylinder(radius / np.cos(np.pi / _SIDES), length, sections=_SIDES)
    elif shape.kind == "sphere":
        mesh = trimesh.creation.icosphere(subdivisions=4, radius=shape.size[0])
    else:
        mesh = _read_mesh(urdf, link, shape)
    mesh.apply_transform(shape.origin)
    return mesh


def _read_mesh(urdf: Urdf, link: str, shape: Shape) -> Trimesh:
    import trimesh
    from collada.common import DaeError

    path = urdf.mesh_path(str(shape.filename), link)
    try:
        mesh = trimesh.load_mesh(path)
    except (
        ValueError,
        OSError,
        KeyError,
        IndexError,
        TypeError,
        NotImplementedError,
        ImportError,
        DaeError,
        BadZipFile,
    ) as error:
        raise UrdfError(path, f"mesh of link '{link}' cannot be read: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh):
        mesh = mesh.to_mesh()
    if len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
        raise UrdfError(path, f"mesh of link '{link}' has no triangles")
    mesh.apply_scale(shape.size)
    return mesh


def surface_points(meshes: list[Trimesh], spacing: float, seed: int) -> Points:
    """Points about every `spacing` metres on the surfaces of all parts, and their corners: (S, 3) [m]."""
    import trimesh

    points: list[Points] = []
    for i, mesh in enumerate(meshes):
        count = int(np.clip(2.0 * mesh.area / spacing**2, 200, 400_000))
        points += [trimesh.sample.sample_surface(mesh, count, seed=seed + i)[0], mesh.vertices]
    return np.vstack(points)


@dataclass(frozen=True)
class Solid:
    """The union of closed meshes, as points.

    Attributes:
        meshes: The parts.
        boundary: (S, 3) points on the surface of the union [m].
    """

    meshes: tuple[Trimesh, ...]
    boundary: Points

    @staticmethod
    def sampled(meshes: list[Trimesh], spacing: float, seed: int) -> Solid:
        """Samples the union's surface about every `spacing` metres; the corners of the meshes are always in."""
        import trimesh

        kept: list[Points] = []
        for i, mesh in enumerate(meshes):
            count = int(np.clip(2.0 * mesh.area / spacing**2, 200, 60_000))
            points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed + i)
            points = np.vstack([points, mesh.vertices])
            normals = np.vstack([mesh.face_normals[faces], mesh.vertex_normals])
            # a point is on the surface of the union if just outside its own part it is in no other one
            just_outside = points + 1e-5 * normals
            for j, other in enumerate(meshes):
                if j != i:
                    hidden = _inside(just_outside, other)
                    points, just_outside = points[~hidden], just_outside[~hidden]
            kept.append(points)
        return Solid(tuple(meshes), np.vstack(kept))

    def inside(self, points: Points) -> Mask:
        """Which points lie in the solid: winding number above one half for any of its parts."""
        result = np.zeros(len(points), dtype=bool)
        for mesh in self.meshes:
            result |= _inside(points, mesh)
        return result

    def distance(self, points: Points) -> Points:
        """Distances [m] of points to the sampled surface."""
        return np.asarray(cKDTree(self.boundary).query(points, workers=-1)[0])


def _inside(points: Points, mesh: Trimesh) -> Mask:
    """By the planes of a convex part; else by winding number above one half, which forgives small holes."""
    low, high = mesh.bounds
    inside = ((points >= low) & (points <= high)).all(1)
    if mesh.is_convex:
        normals = np.asarray(mesh.face_normals)
        offsets = np.einsum("ti,ti->t", normals, mesh.triangles[:, 0])
        inside[inside] = (points[inside] @ normals.T <= offsets + 1e-9).all(1)
        return inside
    triangles = np.asarray(mesh.triangles)
    boxed = np.flatnonzero(inside)
    for part in np.array_split(boxed, 1 + len(boxed) * len(triangles) // 4_000_000):
        inside[part] = _winding_number(points[part], triangles) > 0.5
    return inside


def _winding_number(points: Points, triangles: Points) -> Points:
    """Sum of the solid angles of all triangles seen from each point, over 4π (Van Oosterom and Strackee)."""
    a, b, c = (triangles[None, :, k] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    volume = np.einsum("pti,pti->pt", a, np.cross(b, c))
    spread = (
        la * lb * lc
        + np.einsum("pti,pti->pt", a, b) * lc
        + np.einsum("pti,pti->pt", b, c) * la
        + np.einsum("pti,pti->pt", c, a) * lb
    )
    return np.asarray(np.arctan2(volume, spread).sum(1) / (2.0 * np.pi))
