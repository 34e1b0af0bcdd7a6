"""Fitting spheres to a URDF, and finding the pairs of links that need no check."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from random_robots import BOX_ARM

import grr_torch
from grr_torch.errors import GrrWarning, MeshNotFoundError, ParameterError, UrdfError
from grr_torch.robots.contact_pairs import find_pairs
from grr_torch.robots.fit_spheres import fit_spheres, measure
from grr_torch.robots.geometry import Solid, link_meshes
from grr_torch.robots.read_urdf import parse_urdf, read_urdf
from grr_torch.robots.spheres import Sphere, SphereModel


def outside(spheres, points):
    centres, radii = np.array([s.center for s in spheres]), np.array([s.radius for s in spheres])
    return float((np.linalg.norm(points[:, None] - centres, axis=2) - radii).min(1).max())


@pytest.fixture(scope="module")
def fits():
    return fit_spheres(parse_urdf(BOX_ARM.encode(), source="box arm"), count=8, starts=1)


def test_every_point_of_the_geometry_is_inside_a_sphere(fits):
    urdf = parse_urdf(BOX_ARM.encode(), source="box arm")
    for link, fit in fits.items():
        assert 1 <= len(fit.spheres) <= 8
        for mesh in link_meshes(urdf, link):
            points = np.vstack([trimesh.sample.sample_surface(mesh, 20_000, seed=9)[0], mesh.vertices])
            assert outside(fit.spheres, points) <= 2e-4
        assert fit.uncovered <= 2e-4


def test_what_is_left_outside_is_told():
    mesh = trimesh.creation.box((0.1, 0.1, 0.3))
    fit = measure((Sphere((0.0, 0.0, 0.0), 0.01),), Solid.sampled([mesh], 0.01, 0), mesh.vertices)
    assert fit.uncovered == pytest.approx(np.linalg.norm([0.05, 0.05, 0.15]) - 0.01)


def test_a_sphere_is_fitted_by_a_sphere(fits):
    assert fits["hand"].max_excess < 0.002


def test_more_spheres_fit_tighter(fits):
    urdf = parse_urdf(BOX_ARM.encode(), source="box arm")
    one = fit_spheres(urdf, count=1, starts=1)
    for link in ("base", "upper", "fore"):
        assert fits[link].mean_excess < 0.6 * one[link].mean_excess
        assert len(one[link].spheres) == 1


def test_a_tolerance_is_kept():
    fit = fit_spheres(parse_urdf(BOX_ARM.encode(), source="box arm"), tolerance=0.02)["fore"]
    assert fit.max_excess <= 0.022
    assert fit.uncovered <= 2e-4


def test_meshes_are_fitted_like_primitives(tmp_path):
    trimesh.creation.cylinder(0.04, 0.2).export(tmp_path / "tube.stl")
    mesh = '<geometry><mesh filename="tube.stl" scale="1 1 2"/></geometry>'
    path = tmp_path / "arm.urdf"
    path.write_text(BOX_ARM.replace('<geometry><cylinder radius="0.05" length="0.3"/></geometry>', mesh))
    fit = fit_spheres(read_urdf(path), count=6, starts=0)["upper"]
    ring = np.array([[0.04, 0, 0.4], [0, -0.04, 0.0], [-0.04, 0, 0.2]])
    assert outside(fit.spheres, ring) <= 2e-4


def test_winding_numbers_tell_inside_from_outside_through_a_hole():
    mesh = trimesh.creation.icosphere(subdivisions=3)
    mesh.update_faces(np.arange(len(mesh.faces)) > 3)
    points = np.array([[0, 0, 0], [0.9, 0, 0], [1.1, 0, 0], [0, 0, -3]])
    assert not mesh.is_watertight
    assert Solid((mesh,), mesh.vertices).inside(points).tolist() == [True, True, False, False]


def test_faces_between_touching_parts_are_not_surface():
    left, right = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 1))
    right.apply_translation([1, 0, 0])
    boundary = Solid.sampled([left, right], 0.05, 0).boundary
    inner = (np.abs(boundary[:, 0] - 0.5) < 1e-9) & (np.abs(boundary[:, 1:]) < 0.49).all(1)
    assert not inner.any()


def test_pairs_are_sorted_by_what_the_geometry_can_do(fits):
    urdf = parse_urdf(BOX_ARM.encode(), source="box arm")
    spheres = {link: fit.spheres for link, fit in fits.items()}
    reasons = {pair.links: pair for pair in find_pairs(urdf, spheres, samples=2000).pairs}
    assert reasons["base", "upper"].reason == "adjacent"
    assert reasons["fore", "hand"].reason == "adjacent"
    # the folded hand meets the upper arm, but the base lies out of its reach
    assert reasons["hand", "upper"].reason == "checked"
    assert 0.0 < reasons["hand", "upper"].contacts < 0.5
    assert reasons["base", "fore"].reason == "never"


def test_fat_spheres_do_not_make_contacts(fits):
    urdf = parse_urdf(BOX_ARM.encode(), source="box arm")
    fat = {link: (Sphere((0.0, 0.0, 0.1), 2.0),) for link in fits}
    with pytest.warns(GrrWarning, match=r"far more often.*hand – upper \(spheres 100\.0 %, links \d+\.\d %\)"):
        found = find_pairs(urdf, fat, samples=300)
    reasons = {pair.links: pair.reason for pair in found.pairs}
    assert reasons["base", "fore"] == "never"
    # nor do they make a pair that can touch one that cannot
    assert reasons["hand", "upper"] == "checked"
    assert found.free == 0.0


@pytest.mark.filterwarnings("error")
def test_spheres_that_fit_are_not_warned_of(fits):
    urdf = parse_urdf(BOX_ARM.encode(), source="box arm")
    find_pairs(urdf, {link: fit.spheres for link, fit in fits.items()}, samples=300)


def test_it_is_measured_how_often_spheres_touch(fits, box_arm):
    spheres = {link: fit.spheres for link, fit in fits.items()}
    spheres["hand"] = (Sphere((0.0, 0.0, 0.06), 0.15),)
    urdf = read_urdf(box_arm)
    with pytest.warns(GrrWarning, match=r"far more often than their links:.* hand – upper"):
        found = find_pairs(urdf, spheres, samples=4000)
    pair = next(pair for pair in found.pairs if pair.links == ("hand", "upper"))
    assert pair.reason == "checked"
    assert 0.0 < pair.contacts < pair.overlaps
    model = SphereModel(spheres, frozenset(pair.links for pair in found.pairs if pair.ignored))
    robot = grr_torch.load_robot(box_arm, spheres=model)
    q = robot.sample(4000, torch.Generator().manual_seed(1))
    shares = robot.collision_shares(q)
    assert list(shares) == [("base", "hand"), ("upper", "hand")]
    assert pair.overlaps == pytest.approx(shares["upper", "hand"], abs=0.03)
    assert found.free == pytest.approx(1.0 - float(robot.in_self_collision(q).double().mean()), abs=0.03)


def test_links_that_always_touch_are_ignored():
    """The hand is moved down the forearm until it is inside the upper arm at every angle of the elbow."""
    text = BOX_ARM.replace('<origin xyz="0 0 0.33"/>', '<origin xyz="0 0 -0.09"/>')
    urdf = parse_urdf(text.replace("2.9", "0.1").encode(), source="box arm")
    spheres = {link: fit.spheres for link, fit in fit_spheres(urdf, count=2, starts=0).items()}
    reasons = {pair.links: pair.reason for pair in find_pairs(urdf, spheres, samples=200).pairs}
    assert reasons["hand", "upper"] == "always"


@pytest.mark.parametrize(
    "options",
    [
        {"tolerance": 1e-4},
        {"seed": -1},
        {"starts": -1},
        {"count": 0},
        {"tolerance": 0.0},
        {"tolerance": -1.0},
        {"count": 3, "tolerance": 0.01},
    ],
)
def test_bad_options_are_errors(options):
    with pytest.raises(ParameterError):
        fit_spheres(parse_urdf(BOX_ARM.encode(), source="box arm"), **options)


def test_a_urdf_without_collision_geometry_is_an_error(kinova):
    text = '<robot name="r"><link name="a"/></robot>'
    with pytest.raises(UrdfError, match="no link has collision geometry"):
        fit_spheres(parse_urdf(text.encode(), source="text"))


def test_missing_and_broken_meshes_are_errors(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(BOX_ARM.replace('<sphere radius="0.05"/>', '<mesh filename="hand.stl"/>'))
    with pytest.raises(MeshNotFoundError, match=r"hand\.stl"):
        fit_spheres(read_urdf(path))
    (tmp_path / "hand.stl").write_text("not a mesh")
    with pytest.raises(UrdfError, match=r"hand\.stl: mesh of link 'hand'"):
        fit_spheres(read_urdf(path))
