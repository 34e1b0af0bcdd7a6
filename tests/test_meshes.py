"""Where the meshes of a URDF are looked for, and what needs them."""

from __future__ import annotations

import warnings

import pytest
import trimesh
from small_urdfs import hinge, robot_text

import grr_torch
from grr_torch.errors import MeshNotFoundError
from grr_torch.robots.fit_spheres import fit_spheres


def meshed(mesh, tag="collision"):
    """An arm of one joint, whose link b has a mesh."""
    link = f'<link name="b"><{tag}><geometry><mesh filename="{mesh}"/></geometry></{tag}></link>'
    return robot_text(link, hinge("j", "a", "b"), links="a")


@pytest.mark.parametrize(
    ("place", "name"),
    [
        ("robots/arm/meshes/part.stl", "meshes/part.stl"),
        ("part.stl", "../../part.stl"),
        ("meshes/part.stl", "{root}/meshes/part.stl"),
        ("meshes/part.stl", "file://{root}/meshes/part.stl"),
        ("packages/my_arm/part.stl", "package://my_arm/part.stl"),
        # beside the URDF, in a folder above it of that name, and beside one above it
        ("robots/arm/meshes/part.stl", "package://meshes/part.stl"),
        ("robots/meshes/part.stl", "package://robots/meshes/part.stl"),
        ("my_meshes/part.stl", "package://my_meshes/part.stl"),
    ],
)
def test_meshes_are_found_wherever_they_may_be(tmp_path, place, name):
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box().export(tmp_path / place)
    mesh = name.format(root=tmp_path)
    path = tmp_path / "robots" / "arm" / "arm.urdf"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(meshed(mesh))
    folders = [tmp_path / "packages"]
    found = grr_torch.load_robot(path, package_dirs=folders).urdf.mesh_path(mesh, "b")
    assert found.samefile(tmp_path / place)


def test_a_package_is_looked_for_first_where_it_is_said_to_be(load, tmp_path):
    for folder in ("my_arm", "packages/my_arm"):
        (tmp_path / folder).mkdir(parents=True)
        trimesh.creation.box().export(tmp_path / folder / "part.stl")
    said = tmp_path / "packages" / "my_arm"
    for folder in (said, said.parent):
        robot = load(meshed("package://my_arm/part.stl"), package_dirs=[folder])
        assert robot.urdf.mesh_path("package://my_arm/part.stl", "b") == said / "part.stl"


@pytest.mark.parametrize(
    "mesh", ["package://arm/b.stl", "package://[arm/b.stl", "package://arm/b%00.stl", "b.stl", "b" * 300]
)
@pytest.mark.parametrize("tag", ["collision", "visual"])
def test_a_mesh_may_be_missing_only_if_that_is_allowed(load, mesh, tag):
    with pytest.raises(MeshNotFoundError, match="--allow-missing-meshes"):
        load(meshed(mesh, tag))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        robot = load(meshed(mesh, tag), allow_missing_meshes=True)
    assert robot.n == 1
    with pytest.raises(MeshNotFoundError):
        robot.urdf.mesh_path(mesh, "b")


def test_a_missing_mesh_is_named_with_where_it_was_sought(load, tmp_path):
    options = {"package_dirs": [tmp_path / "packages"], "allow_missing_meshes": True}
    robot = load(meshed("package://arm/b.stl"), **options)
    with pytest.raises(MeshNotFoundError) as caught:
        fit_spheres(robot.urdf)
    assert caught.value.filename == "package://arm/b.stl"
    above = [folder / "arm" / "b.stl" for folder in (tmp_path, *tmp_path.parents)]
    assert caught.value.searched == (tmp_path / "packages" / "arm" / "b.stl", *above)
    for place in caught.value.searched:
        assert str(place) in str(caught.value)
    assert "--package-dir" in str(caught.value)
