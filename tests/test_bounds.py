"""The problem that is posed for an arm without a preset: bounds that hold what it reaches, and how many points."""

from __future__ import annotations

import warnings

import pytest
import torch

import grr_torch
from grr_torch.errors import GrrWarning, ParameterError
from grr_torch.projection.project import tool_points
from grr_torch.resolution.problem import pose_problem
from grr_torch.resolution.reachability import reach, reach_box, within_reach


def chain(path, *joints):
    """An arm of limbs, each 0.1 m long along x, before which a joint (kind, axis, limits) moves."""
    lines = ['<robot name="chain"><link name="0"/>']
    for k, (kind, axis, limits) in enumerate(joints, 1):
        bounds = 'lower="{}" upper="{}"'.format(*limits) if limits else ""
        lines.append(f'''<link name="{k}"/><joint name="j{k}" type="{kind}"><parent link="{k - 1}"/><child link="{k}"/>
            <origin xyz="{0.1 * (k > 1)} 0 0.05"/><axis xyz="{axis}"/><limit {bounds} effort="1" velocity="1"/>
            </joint>''')
    k = len(joints)
    lines.append(f'''<link name="tip"/><joint name="end" type="fixed"><parent link="{k}"/><child link="tip"/>
        <origin xyz="0.1 0 0"/></joint></robot>''')
    path.write_text("\n".join(lines))
    return grr_torch.load_robot(path)


TURN = ("continuous", "0 0 1", None)


@pytest.fixture
def flat_arm(tmp_path):
    return chain(tmp_path / "flat.urdf", *[TURN] * 10)


@pytest.fixture
def rail_arm(tmp_path):
    return chain(tmp_path / "rail.urdf", ("prismatic", "0 1 0", (-0.2, 1.5)), TURN, TURN)


def test_bounds_hold_what_the_arm_reaches_and_little_more(flat_arm, rail_arm, planar_5, kinova):
    # ten limbs are hardly ever stretched by chance
    assert reach_box(flat_arm, 2) == [(-1.0, 1.0), (-1.0, 1.0)]
    assert reach_box(planar_5, 2) == [(-0.5, 0.5), (-0.5, 0.5)]
    assert reach_box(rail_arm, 2) == [(-0.1, 0.3), (-0.4, 1.7)]
    low, high = torch.tensor(reach_box(kinova, 3), dtype=torch.float64).T
    position = kinova.forward_kinematics(kinova.sample(20_000, torch.Generator().manual_seed(7)))[0]
    assert bool(((position >= low) & (position <= high)).all())
    assert bool((high - low <= 2.0 * reach(kinova)[1] + 0.2).all())


def test_no_chance_is_in_bounds(kinova):
    before = torch.random.get_rng_state()
    assert reach_box(kinova, 3) == reach_box(kinova, 3)
    assert torch.equal(torch.random.get_rng_state(), before)


@pytest.mark.parametrize(
    ("joints", "complaint"),
    [
        (
            [("prismatic", "1 0 0", None), TURN],
            r"\(low, high\) of each axis \(--bounds\), as a sliding joint .* no limits",
        ),
        ([("continuous", "0 1 0", None)] * 3, r"\(--bounds\), as the tool of chain does not move along y"),
    ],
)
def test_without_such_bounds_an_error_asks_for_them(tmp_path, joints, complaint):
    with pytest.raises(ParameterError, match=complaint) as caught:
        pose_problem(chain(tmp_path / "chain.urdf", *joints))
    assert caught.value.name == "bounds"


def test_what_is_not_given_is_found_from_the_arm(flat_arm, box_arm):
    for robot, task, points in (
        (flat_arm, grr_torch.Position(2), 1000),
        (grr_torch.load_robot(box_arm), grr_torch.Position(3), 3000),
    ):
        problem = pose_problem(robot)
        assert problem.task == task
        assert problem.seeds == "auto"
        assert points <= len(problem.graph.points) < 1.1 * points
        ends = [side.tolist() for side in problem.graph.points.aminmax(dim=0)]
        assert list(zip(*ends, strict=True)) == reach_box(robot, task.dimension)
    assert len(pose_problem(flat_arm, bounds=[(0, 0.2), (0, 0.2)], points=50).graph.points) < 80


def test_presets_keep_their_bounds(kinova):
    problem = pose_problem(kinova, "position")
    preset = kinova.preset.problems["position"]
    ends = [side.tolist() for side in problem.graph.points.aminmax(dim=0)]
    assert tuple(zip(*ends, strict=True)) == preset.bounds
    assert len(problem.graph.points) >= preset.points


def test_bounds_that_leave_z_free_are_warned_of(kinova, flat_arm, tmp_path):
    sides = [(-0.3, 0.3), (-0.3, 0.3)]
    with pytest.warns(GrrWarning, match="leave z free, and kinova moves in space: six bounds") as warned:
        grr_torch.build(kinova, grr_torch.Position(2), bounds=sides, points=20, refine=False)
    assert len(warned) == 1
    assert warned[0].filename == __file__
    lift = chain(tmp_path / "lift.urdf", TURN, TURN, ("prismatic", "0 0 1", (0, 0.2)))
    with pytest.warns(GrrWarning, match="leave z free"):
        pose_problem(lift, grr_torch.Position(2), bounds=sides)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pose_problem(flat_arm, bounds=sides)
        pose_problem(kinova, grr_torch.Position(3), bounds=[*sides, (0.2, 0.6)])
        graph = grr_torch.staggered_grid(sides, 20)
        pose_problem(kinova, grr_torch.Position(2), points=graph)


def test_a_tool_that_points_down_reaches_the_same_poses(tmp_path):
    """Of planar arms whose tool is mounted aside, so that the wrist lies aside of it too."""
    arms = []
    for name, rpy in (("up", "0 0 0"), ("down", "3.141592653589793 0 0")):
        chain(tmp_path / "arm.urdf", TURN, TURN, TURN, TURN)
        head, end, _ = (tmp_path / "arm.urdf").read_text().partition('<origin xyz="0.1 0 0"/></joint></robot>')
        assert end
        (tmp_path / f"{name}.urdf").write_text(f'{head}<origin xyz="0 0.2 0" rpy="{rpy}"/></joint></robot>')
        arms.append(grr_torch.load_robot(tmp_path / f"{name}.urdf"))
    task = grr_torch.Pose(2)
    for arm in arms:
        q = arm.sample(2000, torch.Generator().manual_seed(0))
        assert bool(within_reach(arm, task, tool_points(arm, task, q)).all())
    points = torch.rand(2000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 0.5
    inside = [within_reach(arm, task, points * torch.tensor([1.6, 1.6, 6.0])) for arm in arms]
    assert 0.1 < float(inside[1].double().mean()) < 0.9
    assert abs(int(inside[0].sum()) - int(inside[1].sum())) < 100
