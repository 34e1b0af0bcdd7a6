"""Common mistakes in a URDF are named with their link or joint, and what is not read may be anything."""

from __future__ import annotations

import re

import pytest
from small_urdfs import HINGE, hinge, robot_text

from grr_torch.errors import UrdfError


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (HINGE.replace('<parent link="{p}"/>', ""), "joint 'j' has no <parent link=\"…\"/>"),
        (HINGE.replace('link="{c}"', ""), "joint 'j' has no <child link=\"…\"/>"),
        (HINGE.replace('name="{n}"', ""), "<joint> number 1 has no name"),
        (HINGE.replace('type="{t}"', ""), "joint 'j' has no type; valid: revolute"),
        (HINGE.replace("{t}", "revolut"), "joint 'j' is of type 'revolut'. Did you mean 'revolute'"),
        (HINGE.replace("{t}", "Fixed"), "Did you mean 'fixed'"),
        (HINGE.replace("0 0 1", "0 1"), "joint 'j': got <axis xyz=\"0 1\">; valid: 3 numbers"),
        (HINGE.replace("0 0 1", "0, 0, 1"), "joint 'j': got <axis xyz=\"0, 0, 1\">; valid: 3 numbers"),
        (HINGE.replace("{x}", '<origin rpy="0 0"/>'), "joint 'j': got <origin rpy=\"0 0\">; valid: 3 numbers"),
        (HINGE.replace("{x}", '<limit lower="-pi"/>'), "joint 'j': got <limit lower=\"-pi\">; valid: a number"),
        (HINGE.replace("{x}", "<mimic/>"), "joint 'j' has a <mimic> without joint"),
        ("<collision/>", "link 'c' has a <collision> without <geometry>"),
        ("<visual><geometry/></visual>", "link 'c': the <geometry> of a <visual> holds nothing; valid: one of <box>"),
        ('<visual><geometry><box size="1 1 1"/><sphere radius="1"/></geometry></visual>', "holds <box>, <sphere>"),
        ("<visual><geometry><cylinder radius='1'/></geometry></visual>", "link 'c' has a <cylinder> without length"),
        (
            "<visual><geometry><sphere radius='r'/></geometry></visual>",
            "link 'c': got <sphere radius=\"r\">; valid",
        ),
        ("<visual><geometry><box size='a b c'/></geometry></visual>", "link 'c': got <box size=\"a b c\">; valid"),
        ("<visual><geometry><mesh/></geometry></visual>", "link 'c' has a <mesh> without filename"),
        ('<inertial><mass value="m"/></inertial>', "link 'c': got <mass value=\"m\">; valid: a number"),
        ("<collision><origin xyz='1 2'/></collision>", "link 'c': got <origin xyz=\"1 2\">; valid: 3 numbers"),
    ],
)
def test_what_is_wrong_in_a_urdf_is_named_with_its_link_or_joint(load, text, complaint):
    if text.startswith("<joint"):
        text = robot_text(text.format(n="j", t="revolute", p="a", c="b", x=""))
    else:
        text = robot_text(hinge("j", "a", "b"), hinge("k", "b", "c"), f'<link name="c">{text}</link>')
    with pytest.raises(UrdfError, match=re.escape(complaint)):
        load(text)


def test_what_is_not_read_may_be_anything(load):
    more = """<!-- robot --><material name="m"><color rgba="1 0 0 1"/></material>
    <transmission name="t"><type>x</type><joint name="j"><hardwareInterface>y</hardwareInterface></joint></transmission>
    <gazebo reference="a"><collision/><joint/></gazebo><sensor><origin xyz="here"/></sensor>
    <link name="c"><more/><visual><geometry><!-- c --><box size="1, 1, 1"/><more/></geometry></visual></link>
    """
    robot = load(robot_text(hinge("j", "a", "b"), hinge("k", "b", "c", "ball"), more), tool="b")
    assert robot.joint_names == ("j",)
    assert robot.urdf.visuals["c"][0].size == (1.0, 1.0, 1.0)
