"""Reading URDFs: every feature, and every way they can be wrong."""

from __future__ import annotations

import math
import re
import warnings

import pytest
import torch
from random_robots import BOX_ARM
from small_urdfs import HINGE, hinge, robot_text

import grr_torch
from grr_torch.errors import GrrWarning, ParameterError, UnknownNameError, UrdfError
from grr_torch.spaces.configuration import normalise


def test_limits_are_those_of_the_urdf(load):
    robot = load(robot_text(hinge("j", "a", "b")))
    assert (robot.lower.item(), robot.upper.item(), robot.velocity_limits.item()) == (-1.0, 1.0, 2.0)


def test_a_limit_without_lower_and_upper_is_no_limit(load):
    robot = load(robot_text(hinge("j", "a", "b", "continuous", '<limit effort="1" velocity="2"/>')))
    assert (robot.lower.item(), robot.upper.item()) == (-math.inf, math.inf)
    assert robot.continuous.item()


def test_limits_of_a_continuous_joint_do_not_count(load):
    wide = '<limit lower="-3.14" upper="3.14" effort="1" velocity="2"/>'
    robot = load(robot_text(hinge("j", "a", "b", "continuous", wide)))
    assert robot.continuous.item()
    assert math.isinf(robot.upper.item())


def test_a_revolute_joint_over_a_full_turn_is_not_continuous(load):
    robot = load(robot_text(hinge("j", "a", "b", extra='<limit lower="-6.3" upper="6.3" effort="1" velocity="1"/>')))
    assert not robot.continuous.item()
    assert robot.upper.item() == 6.3


def test_joints_outside_the_chain_are_held(load):
    text = robot_text(hinge("j", "a", "b"), hinge("side", "b", "c"), links="abc")
    assert load(text, tool="b").joint_names == ("j",)
    held = load(text, tool="b", held_joints={"side": 0.5}).link_poses(torch.zeros(1))["c"]
    assert math.atan2(held[1, 0], held[0, 0]) == pytest.approx(0.5)


@pytest.mark.parametrize("kind", ["floating", "planar", "ball"])
@pytest.mark.parametrize("fault", ["", '<axis xyz="0 0 0"/>', '<mimic joint="j"/>'])
def test_joints_of_other_types_outside_the_chain_are_held(load, kind, fault):
    """Above the base and beside the chain; as if they were fixed, whatever else is written of them."""
    other = HINGE.replace('<axis xyz="0 0 1"/>', '<origin xyz="0.1 0 0" rpy="0 1 0"/>')

    def text(kind, fault):
        ends = (("world", "w", "a"), ("side", "b", "c"))
        others = "".join(other.format(n=name, t=kind, p=parent, c=child, x=fault) for name, parent, child in ends)
        return robot_text(others, hinge("j", "a", "b"), hinge("k", "c", "d"), links="wabcd")

    robot = load(text(kind, fault), base="a", tool="b")
    assert robot.joint_names == ("j",)
    q = torch.tensor([0.3], dtype=torch.float64)
    fixed = load(text("fixed", ""), base="a", tool="b")
    torch.testing.assert_close(robot.link_poses(q), fixed.link_poses(q), atol=0, rtol=0)
    with pytest.raises(UnknownNameError, match=r"unknown joint 'side'. Known: j, k\."):
        load(text(kind, fault), base="a", tool="b", held_joints={"side": 0.0})
    for base, tool, joint in (("w", "b", "world"), ("a", "d", "side")):
        with pytest.raises(UrdfError, match=f"joint '{joint}' is of type '{kind}'; supported: revolute"):
            load(text(kind, fault), base=base, tool=tool)


def test_a_held_joint_of_the_chain_is_no_degree_of_freedom(load):
    text = robot_text(hinge("i", "a", "b"), hinge("j", "b", "c"), links="abc")
    robot = load(text, held_joints={"i": 0.25})
    assert robot.joint_names == ("j",)
    assert robot.chain.get_joint_parameter_names() == ["j"]
    _, rotation = robot.forward_kinematics(torch.zeros(1))
    assert math.atan2(rotation[1, 0], rotation[0, 0]) == pytest.approx(0.25)


def test_the_chain_is_made_once_and_only_when_asked_for(load):
    robot = load(robot_text(hinge("j", "a", "b")))
    assert "chain" not in vars(robot)
    assert robot.chain is robot.chain
    assert robot.with_margin(0.0).chain.get_joint_parameter_names() == ["j"]


def test_a_mimic_joint_follows_and_narrows_the_limits(load):
    mimic = '<limit lower="-1" upper="1" effort="1" velocity="2"/><mimic joint="i" multiplier="2" offset="0.5"/>'
    robot = load(robot_text(hinge("i", "a", "b"), hinge("j", "b", "c", extra=mimic), links="abc"))
    assert robot.joint_names == ("i",)
    # −1 ≤ 2 q + 0.5 ≤ 1 and |2 q̇| ≤ 2
    assert (robot.lower.item(), robot.upper.item(), robot.velocity_limits.item()) == (-0.75, 0.25, 1.0)
    _, rotation = robot.forward_kinematics(torch.tensor([0.1]))
    assert math.atan2(rotation[1, 0], rotation[0, 0]) == pytest.approx(0.1 + 0.7)


@pytest.mark.parametrize(("multiplier", "continuous"), [("2", True), ("-1", True), ("0.5", False)])
def test_a_joint_that_others_follow_wraps_only_by_whole_turns(load, multiplier, continuous):
    mimic = f'<mimic joint="i" multiplier="{multiplier}"/>'
    text = robot_text(hinge("i", "a", "b", "continuous", ""), hinge("j", "b", "c", "continuous", mimic), links="abc")
    robot = load(text)
    assert robot.continuous.item() is continuous
    q = torch.tensor([[3.3], [-4.0], [9.0]], dtype=torch.float64)
    turned = robot.forward_kinematics(normalise(q, robot.continuous))
    torch.testing.assert_close(turned, robot.forward_kinematics(q), atol=1e-12, rtol=0)


def test_limits_of_joints_beside_the_chain_hold_for_the_one_they_follow(load):
    mimic = '<limit lower="-0.2" upper="0.4" velocity="9"/><mimic joint="i" multiplier="-0.5"/>'
    robot = load(robot_text(hinge("i", "a", "b"), hinge("side", "a", "c", extra=mimic), links="abc"), tool="b")
    assert (robot.lower.item(), robot.upper.item()) == pytest.approx((-0.8, 0.4))


def test_text_in_another_encoding_is_read(tmp_path):
    path = tmp_path / "utf16.urdf"
    path.write_bytes(('<?xml version="1.0" encoding="UTF-16"?>' + robot_text(hinge("jé", "a", "b"))).encode("utf-16"))
    robot = grr_torch.load_robot(path)
    assert robot.joint_names == ("jé",)
    assert "encoding" not in robot.urdf.text


def test_a_margin_without_spheres_is_warned_of(load):
    with pytest.warns(GrrWarning, match="the margin has no effect"):
        load(robot_text(hinge("j", "a", "b")), margin=0.01)


@pytest.mark.parametrize(("x", "warned"), [("340", True), ("-21", True), ("12", False)])
def test_origins_that_are_likely_to_be_in_millimetres_are_warned_of(load, x, warned):
    joint = hinge("j", "a", "b", "revolute", f'<origin xyz="0 {x} 0"/><limit lower="-1" upper="1" velocity="2"/>')
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load(robot_text(joint))
    assert any("millimetres? (j)" in str(warning.message) for warning in caught) == warned


@pytest.mark.parametrize(
    ("kind", "limit", "complaint"),
    [
        ("revolute", '<limit lower="-180" upper="180" velocity="1"/>', "position limits beyond ±4π rad: .* degrees"),
        ("revolute", '<limit lower="-12" upper="12.6" velocity="1"/>', "position limits beyond"),
        ("revolute", '<limit lower="-12.6" velocity="1"/>', "position limits beyond"),
        ("revolute", '<limit lower="-12.5" upper="12.5" velocity="1"/>', None),
        ("revolute", '<limit lower="-inf" upper="inf" velocity="1"/>', None),
        ("prismatic", '<limit lower="-180" upper="180" velocity="1"/>', None),
        ("continuous", '<limit lower="-180" upper="180" velocity="1"/>', None),
        ("revolute", '<limit velocity="1"/>', "no position limits .* taken as unlimited"),
        ("prismatic", "", "no position limits .* taken as unlimited"),
        ("revolute", '<limit lower="0" upper="0" velocity="1"/>', None),
        ("revolute", '<limit upper="1" velocity="1"/>', None),
        ("continuous", "", None),
        ("revolute", '<limit lower="-1" upper="1" velocity="0"/>', "a velocity limit of 0: taken as none"),
        ("continuous", '<limit velocity="0"/>', "a velocity limit of 0: taken as none"),
        ("revolute", '<limit lower="-1" upper="1"/>', None),
    ],
)
def test_limits_that_are_hardly_meant_are_warned_of_once(load, kind, limit, complaint):
    text = robot_text(hinge("i", "a", "b", kind, limit), hinge("j", "b", "c", kind, limit), links="abc")
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        load(text)
    assert len(warned) == (complaint is not None)
    for warning in warned:
        assert warning.category is GrrWarning
        assert re.search(rf"robot\.urdf: {complaint}.* \(i, j\)$", str(warning.message))
        assert warning.filename == load.__code__.co_filename


@pytest.mark.parametrize("name", grr_torch.robot_names())
def test_bundled_robots_are_not_warned_of(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        grr_torch.load_robot(name)


def test_base_may_lie_inside_the_tree(load):
    text = robot_text(hinge("i", "a", "b"), hinge("j", "b", "c"), links="abc")
    robot = load(text, base="b", held_joints={"i": 0.3})
    assert robot.joint_names == ("j",)
    pose = robot.link_poses(torch.zeros(1))["a"]
    assert math.atan2(pose[1, 0], pose[0, 0]) == pytest.approx(-0.3)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "is empty"),
        ("<robot name='r'><link", "not well-formed"),
        ("<sdf/>", "root element is <sdf>"),
        ("<robot><link name='a'/></robot>", "no name"),
        ("<robot name='r'/>", "has no <link>"),
        ("<robot name='r'><link/></robot>", "<link> number 1 has no name"),
        (robot_text(links="a"), "no movable joint"),
        (robot_text(hinge("j", "a", "b", "fixed")), "no movable joint"),
        (robot_text(hinge("j", "a", "b", "floating")), "'floating'; supported: revolute"),
        (robot_text(hinge("j", "a", "b", "planar")), "'planar'"),
        (
            robot_text(hinge("j", "a", "b", extra='<limit lower="1" upper="-1" velocity="1"/>')),
            "lower=1.0, upper=-1.0",
        ),
        (robot_text(hinge("j", "a", "b", extra='<limit lower="nan" upper="1" velocity="1"/>')), "lower=nan"),
        (robot_text(hinge("j", "a", "c")), "'c', which does not exist"),
        (robot_text(hinge("j", "a", "b"), links="abc"), "more than one root"),
        (robot_text(hinge("i", "a", "b"), hinge("j", "b", "a")), "loop"),
        (robot_text(hinge("j", "a", "b"), links="aab"), "more than one link named 'a'"),
        (robot_text(hinge("j", "a", "b", extra='<mimic joint="x"/>')), "mimics 'x'"),
        (robot_text(hinge("j", "a", "b").replace("0 0 1", "0 0 0")), "axis of length zero"),
        (robot_text(hinge("j", "a", "b").replace("0 0 1", "0 0 nan")), "not finite"),
        (BOX_ARM.replace('radius="0.05" length', 'radius="-1" length'), "2 finite values, positive"),
        (
            BOX_ARM.replace("<sphere", "<capsule"),
            "link 'hand': the <geometry> of a <collision> holds <capsule>",
        ),
        (BOX_ARM.replace('size="0.2 0.2 0.1"', 'size="0.2 0.2"'), "valid: 3 finite values"),
        (BOX_ARM.replace('<sphere radius="0.05"/>', '<mesh filename="m.stl" scale="1 2"/>'), "valid: 3 finite values"),
        (BOX_ARM.replace('xyz="0 0 0.05"', 'xyz="0 0 nan"'), "origin is not finite"),
        (robot_text(hinge("j", "a", "b", extra='<limit lower="inf" upper="inf" velocity="1"/>')), "lower=inf"),
        (
            robot_text(
                hinge("i", "a", "b"), hinge("j", "b", "c", extra='<mimic joint="i" multiplier="nan"/>'), links="abc"
            ),
            "valid: finite",
        ),
    ],
)
def test_a_bad_urdf_is_a_clear_error(load, text, complaint):
    with pytest.raises(UrdfError, match=complaint) as caught:
        load(text)
    assert caught.value.reason in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_urdf_is_a_clear_error(tmp_path):
    with pytest.raises(UrdfError, match="No such file"):
        grr_torch.load_robot(tmp_path / "none.urdf")


def test_an_unknown_robot_lists_the_known_and_the_nearest():
    with pytest.raises(UnknownNameError, match="Did you mean 'kinova'") as caught:
        grr_torch.load_robot("kinovaa")
    assert caught.value.known == ("kinova", "planar_3", "planar_5")


@pytest.mark.parametrize("frame", ["tool", "base"])
def test_an_unknown_frame_lists_the_links(load, frame):
    with pytest.raises(UnknownNameError, match="unknown link 'z'. Known: a, b"):
        load(robot_text(hinge("j", "a", "b")), **{frame: "z"})


def test_a_base_that_is_not_above_the_tool_is_an_error(load):
    with pytest.raises(UrdfError, match="'b' does not lie above 'a'"):
        load(robot_text(hinge("j", "a", "b")), base="b", tool="a")


def test_a_tree_with_several_ends_asks_for_the_tool(load):
    text = robot_text(hinge("i", "a", "b"), hinge("j", "a", "c"), links="abc")
    with pytest.raises(ParameterError, match="several ends: b, c"):
        load(text)


@pytest.mark.parametrize("value", [math.nan, 7.0])
def test_held_values_lie_within_limits(load, value):
    with pytest.raises(ParameterError, match=r"-1.0 to 1.0"):
        load(robot_text(hinge("j", "a", "b")), held_joints={"j": value})


def test_an_unknown_held_joint_is_an_error(load):
    with pytest.raises(UnknownNameError, match="unknown joint 'k'"):
        load(robot_text(hinge("j", "a", "b")), held_joints={"k": 0.0})
