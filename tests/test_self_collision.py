"""The sphere model: distances against all pairs by brute force, and the bundled Kinova against its real meshes."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from random_robots import random_urdf
from scipy.spatial import cKDTree

import grr_torch
from grr_torch.errors import FileFormatError, GrrWarning, ParameterError, SeedError, UnknownNameError
from grr_torch.robots.crowding import crowding
from grr_torch.robots.spheres import Sphere, SphereModel

ARM_MESHES = {
    "base_link": "Base_Link",
    "shoulder_link": "Shoulder_Link",
    "half_arm_1_link": "HalfArm1_Link",
    "half_arm_2_link": "HalfArm2_Link",
    "forearm_link": "ForeArm_Link",
    "spherical_wrist_1_link": "SphericalWrist1_Link",
    "spherical_wrist_2_link": "SphericalWrist2_Link",
    "bracelet_link": "Bracelet_Link",
}
# lower corners of the left parts of the open gripper in end_effector_link's frame [m]; the right ones are mirrored
GRIPPER_PARTS = {
    "outer_knuckle": (0.0231, -0.0120, 0.0549),
    "outer_finger": (0.0563, -0.0135, 0.0549),
    "inner_knuckle": (0.0067, -0.0195, 0.0634),
    "inner_finger": (0.0395, -0.0110, 0.1023),
}


def brute_force(robot, q):
    """Smallest distance over every pair of spheres of every checked pair of links."""
    poses = robot.link_poses(q)
    smallest = torch.full(q.shape[:-1], torch.inf, dtype=q.dtype)
    for pair in robot.spheres.checked:
        placed = []
        for link in pair:
            centres = torch.tensor([sphere.center for sphere in robot.spheres.spheres[link]], dtype=q.dtype)
            pose = poses[link]
            placed.append(torch.einsum("...ij,sj->...si", pose[..., :3, :3], centres) + pose[..., None, :3, 3])
        radii = [
            torch.tensor([sphere.radius for sphere in robot.spheres.spheres[link]], dtype=q.dtype) for link in pair
        ]
        gaps = torch.cdist(*placed, compute_mode="donot_use_mm_for_euclid_dist") - (radii[0][:, None] + radii[1])
        smallest = torch.minimum(smallest, gaps.flatten(-2).amin(-1))
    return smallest


def test_distance_is_that_of_all_pairs(kinova, generator):
    q = kinova.sample(3000, generator)
    expected = brute_force(kinova, q)
    torch.testing.assert_close(kinova.self_collision_distance(q), expected, atol=1e-12, rtol=0)
    assert torch.equal(kinova.in_self_collision(q), expected < kinova.margin)
    assert 0.005 < kinova.in_self_collision(q).double().mean() < 0.5


def random_arm(folder, seed):
    """An arm with joints of every kind, branches and a mimic joint, and a few spheres on each link."""
    rng = np.random.default_rng(seed)
    path = folder / "arm.urdf"
    path.write_text(random_urdf(rng, 6, branches=True, mimic=True), encoding="utf-8")
    links = [f"link_{k}" for k in range(8)] + ["finger_2", "finger_4", "finger_6"]
    spheres = {
        link: tuple(Sphere(tuple(rng.uniform(-0.1, 0.1, 3)), rng.uniform(0.01, 0.04)) for _ in range(3))
        for link in links
    }
    return grr_torch.load_robot(path, tool="tool", spheres=SphereModel(spheres, frozenset()), margin=0.001)


@pytest.mark.parametrize("seed", range(8))
def test_within_motions_that_are_ruled_out_nothing_touches(tmp_path, kinova, seed):
    rng = np.random.default_rng(seed)
    for arm in (random_arm(tmp_path, seed), kinova):
        count = 60
        q = arm.sample(count, torch.Generator().manual_seed(seed)).numpy().T
        motions = 0.2 * rng.random(count) * rng.normal(size=q.shape)
        ruled_out = ~arm.few.may_collide_near(np.ascontiguousarray(q), motions)
        for share in np.linspace(-1.0, 1.0, 9):
            assert not (arm.few.in_self_collision(np.ascontiguousarray(q + share * motions)) & ruled_out).any()
        assert arm is not kinova or 0.1 < ruled_out.mean() < 0.9


@pytest.mark.parametrize("seed", range(8))
def test_links_move_against_each_other_no_farther_than_their_levers_allow(tmp_path, seed):
    arm = random_arm(tmp_path, seed)
    kernel, generator = arm.sphere_kernel, torch.Generator().manual_seed(seed)
    first, second = arm.sample(500, generator), arm.sample(500, generator)
    apart = [kernel._squared(arm.tree.frames(q.T.contiguous()), kernel.bounds).sqrt() for q in (first, second)]
    allowed = kernel.levers @ (second - first).abs().T
    assert bool(((apart[1] - apart[0]).abs() <= allowed + 1e-12).all())
    assert bool(kernel.levers.isfinite().any())


@pytest.mark.parametrize("margin", [0.0, 0.05, 0.2])
def test_the_margin_is_added_to_every_check(kinova, generator, margin):
    q = kinova.sample(500, generator)
    robot = kinova.with_margin(margin)
    assert torch.equal(robot.in_self_collision(q), brute_force(kinova, q) < margin)


@pytest.mark.parametrize("margin", [-0.01, float("nan")])
def test_a_bad_margin_is_an_error(kinova, margin):
    with pytest.raises(ParameterError, match="margin"):
        kinova.with_margin(margin)


def test_distance_is_differentiable(kinova, generator):
    q = kinova.sample(4, generator).requires_grad_()
    assert torch.autograd.gradcheck(kinova.self_collision_distance, (q,))


def test_the_pairs_that_touch_are_told(kinova, generator):
    q = kinova.sample(2000, generator)
    shares = kinova.collision_shares(q)
    assert set(shares) == {pair for pair in kinova.spheres.checked if pair in shares}
    assert len(shares) == len(kinova.spheres.checked)
    for pair, share in shares.items():
        ignored = {tuple(sorted(other)) for other in itertools.combinations(kinova.spheres.spheres, 2)} - {
            tuple(sorted(pair))
        }
        alone = replace(kinova, spheres=replace(kinova.spheres, ignored=frozenset(ignored)))
        assert share == float(alone.in_self_collision(q).double().mean())
    assert grr_torch.load_robot("planar_5").collision_shares(torch.zeros(3, 5)) == {}


def crowded(box_arm, radius):
    """An arm whose hand touches a sphere at its elbow in most configurations, or all."""
    spheres = {"upper": (Sphere((0.0, 0.0, 0.4), radius),), "hand": (Sphere((0.0, 0.0, 0.06), 0.05),)}
    return grr_torch.load_robot(box_arm, spheres=SphereModel(spheres, frozenset()))


def test_a_model_by_which_nearly_everything_collides_is_named_and_not_reach(box_arm, kinova):
    options = {"task": "position", "points": 60, "bounds": [(-0.6, 0.6)] * 2 + [(0.2, 1.0)]}
    told = r"%d.* %% of random configurations are in self-collision, mostly upper – hand \(%d"
    for radius, share in ((0.5, 100), (0.335, 8)):
        with pytest.raises(SeedError, match="no seeds were found.* free of self-collision: " + told % (share, share)):
            grr_torch.build(crowded(box_arm, radius), **options)
    arm = crowded(box_arm, 0.339)
    q = arm.sample(20_000, torch.Generator().manual_seed(1))
    seed = q[~arm.in_self_collision(q)][0]
    options["bounds"] = [(value - 0.03, value + 0.03) for value in arm.forward_kinematics(seed)[0].tolist()]
    with pytest.warns(GrrWarning, match="^" + told % (9, 9)):
        grr_torch.build(arm, **options, seeds=seed[None], refine=False)
    assert crowding(kinova) == ""
    assert crowding(crowded(box_arm, 0.1)) == ""


def test_what_is_not_a_number_is_not_free(kinova):
    q = torch.zeros(3, 7, dtype=torch.float64)
    q[1, 2] = torch.nan
    assert kinova.in_self_collision(q).tolist() == [False, True, False]
    assert kinova.self_collision_distance(q).isnan().tolist() == [False, True, False]


def test_a_robot_without_spheres_is_never_in_collision(planar_5, generator):
    q = planar_5.sample(10, generator)
    assert not bool(planar_5.in_self_collision(q).any())
    assert bool(planar_5.self_collision_distance(q).isinf().all())


def test_the_kinova_checks_the_pairs_that_can_touch(kinova):
    wrists = ["spherical_wrist_1_link", "spherical_wrist_2_link", "bracelet_link", "gripper_link"]
    expected = {frozenset(pair) for pair in itertools.product(["base_link"], wrists)}
    expected |= {frozenset(pair) for pair in itertools.product(["shoulder_link", "half_arm_1_link"], wrists[1:])}
    expected |= {frozenset(pair) for pair in itertools.product(["half_arm_2_link"], wrists[2:])}
    assert {frozenset(pair) for pair in kinova.spheres.checked} == expected
    assert kinova.margin == 0.002


def kinova_meshes(folder, link):
    """The real meshes of a link, in its frame."""
    import trimesh

    if link in ARM_MESHES:
        return [trimesh.load_mesh(folder / "kinova_gen3" / f"{ARM_MESHES[link]}.off")]
    meshes = [trimesh.load_mesh(folder / "robotiq_85" / "robotiq_85_base_link.off")]
    for part, corner in GRIPPER_PARTS.items():
        left = trimesh.load_mesh(folder / "robotiq_85" / f"left_{part}.off")
        left.apply_translation(np.array(corner) - left.bounds[0])
        right = left.copy()
        right.apply_transform(np.diag([-1.0, -1.0, 1.0, 1.0]))
        meshes += [left, right]
    return meshes


@pytest.mark.parametrize("link", [*ARM_MESHES, "gripper_link"])
def test_the_kinova_s_spheres_hold_the_real_meshes_tightly(kinova, real_meshes, link):
    import trimesh

    meshes = kinova_meshes(real_meshes, link)
    surface = np.vstack([np.vstack([trimesh.sample.sample_surface(m, 40_000, seed=1)[0], m.vertices]) for m in meshes])
    spheres = kinova.spheres.spheres[link]
    assert len(spheres) <= 20
    centres, radii = np.array([s.center for s in spheres]), np.array([s.radius for s in spheres])
    sticks_out = (np.linalg.norm(surface[:, None] - centres, axis=2) - radii).min(1).max()
    assert sticks_out <= 0.001
    unit = np.random.default_rng(0).normal(size=(1000, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    outer = (centres[:, None] + radii[:, None, None] * unit).reshape(-1, 3)
    area = np.repeat(radii**2, len(unit))
    free = (np.linalg.norm(outer[:, None] - centres, axis=2) - radii).min(1) > -1e-9
    excess = cKDTree(surface).query(outer[free])[0]
    assert np.average(excess, weights=area[free]) <= 0.012
    assert excess.max() <= 0.030


def test_a_pair_is_ignored_in_whatever_order():
    spheres = {name: (Sphere((0.0, 0.0, 0.0), 1.0),) for name in "abc"}
    model = SphereModel(spheres, frozenset({("b", "a"), ("b", "c")}))
    assert model.checked == [("a", "c")]
    assert model.ignored == {("a", "b"), ("b", "c")}
    for wrong in ("ab", ("a",), ("a", "b", "c")):
        with pytest.raises(ParameterError, match="ignored: .* valid: pairs of links"):
            SphereModel(spheres, frozenset({wrong}))


def test_a_model_names_links_of_its_robot(box_arm):
    spheres = {name: (Sphere((0.0, 0.0, 0.0), 0.1),) for name in ("base", "hand")}
    for model in (
        SphereModel({**spheres, "hnad": spheres["hand"]}, frozenset()),
        SphereModel(spheres, frozenset({("base", "hnad")})),
    ):
        with pytest.raises(UnknownNameError, match=r"unknown link 'hnad'. Did you mean 'hand'\?"):
            grr_torch.load_robot(box_arm, spheres=model)


def test_curobo_s_nesting_and_disabled_spheres_are_read():
    text = """robot_cfg:
  kinematics:
    collision_spheres:
      a: [{center: [0, 0, 1], radius: 0.5}, {center: [0, 0, 0], radius: -1}]
    self_collision_ignore: {b: [a]}
"""
    model = SphereModel.parse(text, ["a", "b"], source="text")
    assert model.spheres["a"] == (Sphere((0.0, 0.0, 1.0), 0.5),)
    assert model.ignored == {("a", "b")}


@pytest.mark.parametrize(
    ("text", "error", "complaint"),
    [
        ("a: [", FileFormatError, "is not YAML"),
        ("a: 1", FileFormatError, "no mapping 'collision_spheres'"),
        ("collision_spheres: {z: []}", UnknownNameError, "unknown link 'z'"),
        ("collision_spheres: {a: [{center: [0, 0], radius: 1}]}", FileFormatError, "valid: {center"),
        ("collision_spheres: {a: [{center: [0, 0, .nan], radius: 1}]}", FileFormatError, "not finite"),
        ("collision_spheres: {a: []}\nself_collision_ignore: [a]", FileFormatError, "must map a link"),
        ("collision_spheres: {a: []}\nself_collision_ignore: {a: [z]}", UnknownNameError, "unknown link 'z'"),
        ("!!python/object/apply:os.system ['true']", FileFormatError, "is not YAML"),
    ],
)
def test_a_bad_sphere_file_is_a_clear_error(text, error, complaint):
    with pytest.raises(error, match=complaint):
        SphereModel.parse(text, ["a", "b"], source="text")


def test_a_missing_sphere_file_is_a_clear_error(tmp_path):
    with pytest.raises(FileFormatError, match="cannot be read"):
        grr_torch.load_robot("kinova", spheres=tmp_path / "none.yaml")


def test_a_few_configurations_are_checked_as_many_are(kinova, generator):
    q = torch.cat([kinova.sample(2000, generator), torch.full((1, 7), torch.nan, dtype=torch.float64)])
    assert 90 < kinova.sphere_kernel.most_of_few < len(q)
    many = kinova.in_self_collision(q)
    assert 60 < int(many.sum()) < 1800
    assert torch.equal(many, torch.cat([kinova.in_self_collision(part) for part in q.split(90)]))
    assert torch.equal(many, kinova.self_collision_distance(q).nan_to_num(-1.0) < kinova.margin)
    assert kinova.in_self_collision(q[:0]).shape == (0,)
