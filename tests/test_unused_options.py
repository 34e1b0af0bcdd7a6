"""Options that would have no effect, files that would not hold what their names say, and what a roadmap says itself."""

from __future__ import annotations

import json

import pytest

import grr_torch


@pytest.fixture
def command(planar_roadmap, tmp_path, run_cli):
    """Runs a command beside a roadmap."""
    planar_roadmap.save(tmp_path / "r.grr")
    return run_cli


WITH_ROADMAP = "valid: none with --roadmap"


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("smm --roadmap r.grr --tool link_2", "--tool: got link_2; " + WITH_ROADMAP),
        ("smm --roadmap r.grr --base link_1", "--base: got link_1; " + WITH_ROADMAP),
        ("smm --roadmap r.grr --hold joint_1=0 --hold joint_2=1", "--hold: got joint_1=0 joint_2=1; " + WITH_ROADMAP),
        ("smm --roadmap r.grr --spheres none.yaml", "--spheres: got none.yaml; " + WITH_ROADMAP),
        ("smm --roadmap r.grr --margin 0", "--margin: got 0.0; " + WITH_ROADMAP),
        ("smm --roadmap r.grr --package-dir here", "--package-dir: got here; " + WITH_ROADMAP),
        ("smm --roadmap r.grr --allow-missing-meshes", "--allow-missing-meshes: got True; " + WITH_ROADMAP),
        ("smm --roadmap r.grr --robot planar_3", "--robot: got planar_3; valid: planar_5, the roadmap's, or none"),
        ("smm --roadmap r.grr --robot nobody", "--robot: got nobody; valid: planar_5, the roadmap's, or none"),
        ("smm --roadmap r.grr --rotation 0 0 1", "--rotation: got 0.0 0.0 1.0; valid: none: the roadmap's task"),
        ("smm --robot planar_3 --out x.csv", "--out: got x.csv; valid: a file that ends in .npz"),
        ("smm --robot planar_3 --record x.txt", "--record: got x.txt; valid: a file that ends in .rrd"),
        ("smm --robot planar_5 --point 0.1 0.2 0.3 0.4", "got '0.1 0.2 0.3 0.4'; valid: 3 finite numbers: x y z"),
        ("smm --roadmap r.grr --point 0.1 0.2 0.3", "--point: got '0.1 0.2 0.3'; valid: 2 finite numbers: x y"),
        ("smm --robot planar_3 --point 0.1 inf", "--point: got '0.1 inf'; valid: two or three numbers"),
        ("bench speed --profile --only kinematics", "--only: got kinematics; valid: none with --profile"),
        ("bench speed --profile --peers Pinocchio", "--peers: got Pinocchio; valid: none with --profile"),
        ("bench speed --profile --repeats 7", "--repeats: got 7; valid: none with --profile"),
        ("bench speed --profile --json f.json", "--json: got f.json; valid: none with --profile"),
        ("build --robot planar_5 --no-record --record x.rrd", "--record: got x.rrd; valid: none with --no-record"),
        ("build --robot planar_5 --no-record --out x.txt", "--out: got x.txt; valid: a file that ends in .grr"),
        ("build --robot planar_5 --record x.txt", "--record: got x.txt; valid: a file that ends in .rrd"),
        ("view r.grr --save x.txt", "--save: got x.txt; valid: a file that ends in .rrd"),
    ],
)
def test_what_would_have_no_effect_is_refused(command, tmp_path, words, complaint):
    code, shown, errors = command(*words.split())
    assert code == 2
    assert complaint in errors
    assert errors.count("\n") == 1
    assert shown == ""
    assert [path.name for path in tmp_path.iterdir()] == ["r.grr"]


def test_with_a_roadmap_its_own_arm_is_taken(command, box_arm, monkeypatch):
    monkeypatch.setattr("grr_torch.cli.smm.load_arm", pytest.fail)
    words = ("--point", 0.2, 0.1, "--samples", 10, "--json")
    code, shown, errors = command("smm", "--robot", "planar_5", "--roadmap", "r.grr", *words)
    assert code == 0, errors
    assert json.loads(shown)["points"][0]["roadmap"] is not None
    # of a URDF, what is held and which link is the tool are the roadmap's affair; this one has no joint to spare
    arm = grr_torch.load_robot(box_arm, tool="tip", base="base")
    grr_torch.build(arm, "position", points=60, refine=False).save("box.grr")
    words = ("--roadmap", "box.grr", "--point", 0.3, 0.0, 0.5)
    assert "fewer equations than joints" in command("smm", "--robot", box_arm, *words)[2]
    box_arm.write_text(box_arm.read_text().replace('"elbow"', '"bend"'))
    assert "valid: box_arm, the roadmap's, or none" in command("smm", "--robot", box_arm, *words)[2]


def test_a_rotation_that_is_not_the_roadmap_s_is_told_that(command, planar_5):
    grr_torch.build(planar_5, "fixed-rotation", points=100, refine=False).save("turned.grr")
    words = ("smm", "--roadmap", "turned.grr", "--samples", 10, "--point", 0.2, 0.1, "--rotation")
    _, _, errors = command(*words, 1, 2, 3)
    given, _, valid = errors.partition("; valid: ")
    assert given == "error: --rotation: got 1.0 2.0 3.0"
    own = valid.removesuffix(", the roadmap's, or none\n").split()
    assert list(map(float, own)) == list(planar_5.preset.problems["fixed-rotation"].rotation)
    assert command(*words, *own)[0] == 0
