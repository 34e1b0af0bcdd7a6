"""What commands do with an arm of one's own, of which there is nothing but a URDF."""

from __future__ import annotations

import json

import pytest

from grr_torch import Roadmap

# two ends, and a mesh in a package
TWO_ENDS = """<robot name="two_ends">
  <link name="base"><visual><geometry><mesh filename="package://arms/base.stl"/></geometry></visual></link>
  <link name="upper"/><link name="fore"/><link name="wrist"/><link name="palm"/><link name="hand"/>
  <link name="flange"/><link name="camera"/>
  <joint name="turn" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/></joint>
  <joint name="shoulder" type="revolute"><parent link="upper"/><child link="fore"/>
    <origin xyz="0 0 0.2"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="elbow" type="revolute"><parent link="fore"/><child link="wrist"/>
    <origin xyz="0 0 0.4"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="bend" type="revolute"><parent link="wrist"/><child link="hand"/>
    <origin xyz="0 0 0.3"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="roll" type="continuous"><parent link="hand"/><child link="palm"/><axis xyz="0 0 1"/></joint>
  <joint name="end" type="fixed"><parent link="palm"/><child link="flange"/><origin xyz="0.1 0 0.1"/></joint>
  <joint name="mount" type="fixed"><parent link="fore"/><child link="camera"/></joint>
</robot>
"""


@pytest.fixture
def two_ends(tmp_path):
    (tmp_path / "packages" / "arms").mkdir(parents=True)
    (tmp_path / "packages" / "arms" / "base.stl").touch()
    path = tmp_path / "two_ends.urdf"
    path.write_text(TWO_ENDS)
    return path


def test_smm_loads_robots_as_build_does(run_cli, two_ends):
    words = ("smm", "--robot", two_ends, "--point", 0.4, 0.1, 0.5, "--samples", 20)
    code, _, complaint = run_cli(*words, "--tool", "flange")
    assert code == 2
    assert "--package-dir" in complaint
    words = (*words, "--tool", "flange", "--package-dir", "packages", "--hold", "bend=0.3")
    code, shown, complaint = run_cli(*words, "--json")
    assert code == 0, complaint
    assert set(json.loads(shown)["points"][0]["components"][0]["ranges"]) == {"turn", "shoulder", "elbow", "roll"}
    assert run_cli(*words, "--hold", "bend=1")[2] == "error: --hold: got 'bend=1'; valid: one value for 'bend'\n"


def test_smm_takes_an_axis(run_cli):
    words = ("smm", "--robot", "kinova", "--task", "axis", "--samples", 20, "--json", "--point", 0.4, 0.1, 0.4, 0, 0, 1)
    code, shown, complaint = run_cli(*words, "--axis", 0, 1, 0)
    assert code == 0, complaint
    assert json.loads(shown)["task"]["axis"] == [0.0, 1.0, 0.0]
    assert run_cli(*words[:-7], "--axis", 0, 1, 0)[2].startswith("error: --axis: got [0.0, 1.0, 0.0]; valid: none")


def test_smm_does_not_call_free_what_is_not_checked(run_cli):
    words = ("--samples", 10, "--point", 0.2, 0.1)
    shown = run_cli("smm", "--robot", "planar_5", *words)[1]
    assert "not checked: no sphere model" in shown
    assert "%" not in shown
    assert (
        json.loads(run_cli("smm", "--robot", "planar_5", *words, "--json")[1])["points"][0]["components"][0]["free"]
        is None
    )
    assert "%" in run_cli("smm", "--robot", "kinova", "--samples", 10, "--point", 0.4, 0.1, 0.4)[1]


def test_an_arm_is_built_from_its_urdf_and_tool_alone(run_cli, two_ends):
    words = ("build", "--robot", two_ends, "--package-dir", "packages", "--no-record")
    assert run_cli(*words)[2] == (
        "error: tool: got nothing; valid: one of the links (--tool), as the URDF has several ends: flange, camera\n"
    )
    code, shown, complaint = run_cli(*words, "--tool", "flange", "--no-refine")
    assert code == 0
    assert "warning" not in complaint
    # limbs of 0.4, 0.3 and 0.1 that turn 2 rad each, and 0.1 to the side
    assert "\nbounds                             -0.9 0.9 -0.9 0.9 -0.5 1.1 m\n" in shown
    assert "two_ends, position in R3\n" in shown
    assert "connected parts" in shown
    roadmap = Roadmap.load("two_ends.grr")
    assert len(roadmap.points) >= 3000
    assert bool(roadmap.resolved.any())


def test_what_leaves_z_free_is_one_warning(run_cli, two_ends):
    options = ("--points", 60, "--no-record", "--no-refine", "--json")
    words = ("build", "--robot", two_ends, "--package-dir", "packages", "--tool", "flange", *options)
    code, shown, complaint = run_cli(*words, "--bounds", -0.4, 0.4, -0.4, 0.4)
    assert code == 0
    assert json.loads(shown)["bounds"] == [[-0.4, 0.4], [-0.4, 0.4]]
    said = "warning: bounds of x and y leave z free, and two_ends moves in space: six bounds give a map in space\n"
    assert said in complaint
    assert complaint.count("warning") == 1
    words = ("build", "--robot", "planar_5", *options)
    assert "warning" not in run_cli(*words, "--bounds", -0.4, 0.4, -0.4, 0.4)[2]
