"""Secondary objectives: they gain what they ask for, at the price of smoothness, and nothing is lost."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from grr_torch.cli.main import app
from typer.testing import CliRunner

import grr_torch
from grr_torch.errors import FileFormatError, ParameterError, UnknownNameError
from grr_torch.experiments.trade import measure_trade
from grr_torch.projection.project import Tolerances
from grr_torch.resolution.edges import check_edges
from grr_torch.resolution.objectives import OBJECTIVES, Objective, check_objectives, measure_objective
from grr_torch.resolution.refine import refine
from grr_torch.resolution.report import check_refinement, traded


@pytest.fixture(scope="module")
def plain(kinova):
    return grr_torch.build(kinova, "position", points=700, refine=False)


@pytest.fixture(scope="module")
def smooth(plain):
    return refine(plain)


@pytest.mark.parametrize("name", OBJECTIVES)
def test_an_objective_gains_at_the_price_of_smoothness(plain, smooth, name):
    served = refine(plain, objectives={name: 1.0})
    before, after = (
        measure_objective(map_.robot, map_.task, name, map_.configurations[map_.resolved]) for map_ in (smooth, served)
    )
    assert float(after.mean()) > 1.01 * float(before.mean())
    assert float(after.min()) >= float(before.min())
    assert served.quality().smoothness > smooth.quality().smoothness
    told = served.parameters["refinement"]
    assert told["smoothest"] == pytest.approx(smooth.quality().smoothness)
    assert told["objectives"][name] == {
        "weight": 1.0,
        "before": {"mean": pytest.approx(float(before.mean())), "worst": pytest.approx(float(before.min()))},
        "after": {"mean": pytest.approx(float(after.mean())), "worst": pytest.approx(float(after.min()))},
    }


def test_a_joint_without_room_has_no_part_in_limits(plain):
    robot = plain.robot
    still = robot.lower.clone(), robot.upper.clone()
    still[0][1] = still[1][1] = 0.2
    fixed = replace(robot, lower=still[0], upper=still[1])
    q = fixed.sample(50, torch.Generator().manual_seed(0))
    values = measure_objective(fixed, plain.task, "limits", q)
    assert bool(values.isfinite().all())
    limited = robot.lower.isfinite() & ~robot.continuous
    limited[1] = False
    share = 1.0 - (2.0 * q - robot.lower - robot.upper).abs() / (robot.upper - robot.lower)
    assert torch.allclose(values, share[:, limited].amin(1))


def test_checking_draws_nothing(kinova):
    before = torch.random.get_rng_state()
    check_objectives(kinova, {"clearance": 1.0, "limits": 0.5})
    assert torch.equal(torch.random.get_rng_state(), before)


def test_nothing_is_lost_for_objectives(plain, smooth):
    served = refine(plain, objectives={"clearance": 1.0, "limits": 1.0})
    for map_ in (plain, smooth):
        assert bool((served.resolved | ~map_.resolved).all())
        assert bool((served.connected | ~map_.connected).all())
    quality = served.quality()
    assert (quality.joint_limit_violations, quality.self_collisions) == (0, 0)
    assert quality.max_position_error <= 1e-4 * (1.0 + 1e-6)
    assert torch.equal(check_edges(served, Tolerances()), served.connected)


def test_more_weight_gains_more(planar_5):
    rows = measure_trade("planar_5", "fixed-rotation", weights=(1.0, 10.0))
    assert [row.objective for row in rows] == ["", "manipulability", "manipulability"]
    means = [row.values["manipulability"]["mean"] for row in rows]
    smoothness = [row.quality.smoothness for row in rows]
    assert means == sorted(means)
    assert smoothness == sorted(smoothness)
    assert set(rows[0].values) == {"manipulability"}


def test_at_weight_0_an_objective_is_only_reported(plain, smooth):
    reported = refine(plain, objectives={"clearance": 0.0})
    assert torch.equal(reported.configurations.nan_to_num(), smooth.configurations.nan_to_num())
    told = reported.parameters["refinement"]["objectives"]["clearance"]
    assert told["before"] == told["after"]


@pytest.mark.parametrize("name", OBJECTIVES)
def test_the_model_of_an_objective_is_its_derivative(kinova, generator, name):
    objective = Objective(kinova, grr_torch.Position(3), name, 2.0, 0.2)
    q = kinova.sample(6, generator).T.contiguous()
    pull, directions = objective.model(q)
    for column in range(q.shape[1]):
        for joint in range(kinova.n):
            step = torch.zeros_like(q)
            step[joint, column] = 1e-6
            slope = (objective.cost(q + step) - objective.cost(q - step)) / 2e-6
            assert float(pull[joint, column]) == pytest.approx(-slope, rel=1e-3, abs=1e-4)
    assert directions.shape[1:] == q.shape
    assert bool(directions.isfinite().all())


def test_manipulability_is_that_of_the_task_s_jacobian(kinova, generator):
    q = kinova.sample(5, generator)
    jacobian = kinova.jacobian(q)
    for task, rows in ((grr_torch.Position(3), 3), (grr_torch.FixedRotation(3), 6)):
        expected = torch.linalg.svdvals(jacobian[:, :rows]).prod(1)
        found = measure_objective(kinova, task, "manipulability", q)
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-9)


def test_a_straight_arm_has_a_finite_model(planar_5):
    objective = Objective(planar_5, grr_torch.Position(2), "manipulability", 1.0, 0.1)
    pull, directions = objective.model(torch.zeros(5, 3, dtype=torch.float64))
    assert bool(pull.isfinite().all() & directions.isfinite().all())


@pytest.mark.parametrize(
    ("name", "objectives", "error", "complaint"),
    [
        ("kinova", {"clearence": 1.0}, UnknownNameError, "Did you mean 'clearance'"),
        ("kinova", {"clearance": -1.0}, ParameterError, "weight of clearance: got -1.0"),
        ("kinova", {"clearance": math.nan}, ParameterError, "weight of clearance: got nan"),
        ("kinova", {"clearance": "much"}, ParameterError, "weight of clearance: got much"),
        ("planar_5", {"clearance": 1.0}, ParameterError, "planar_5 has no pair of links"),
        ("planar_5", {"limits": 1.0}, ParameterError, "planar_5 has none"),
    ],
)
def test_bad_objectives_are_errors(name, objectives, error, complaint):
    with pytest.raises(error, match=complaint):
        grr_torch.build(grr_torch.load_robot(name), "position", objectives=objectives)


def test_objectives_need_refinement(kinova):
    with pytest.raises(ParameterError, match="none without refinement"):
        grr_torch.build(kinova, "position", refine=False, objectives={"clearance": 1.0})


def test_a_file_keeps_what_was_traded_and_a_wrong_one_is_refused(planar_5, tmp_path):
    roadmap = grr_torch.build(planar_5, "position", points=150, objectives={"manipulability": 1.0})
    roadmap.save(tmp_path / "a.grr")
    again = grr_torch.Roadmap.load(tmp_path / "a.grr")
    lines = traded(again, again.quality())
    assert lines == traded(roadmap, roadmap.quality())
    assert list(lines) == ["manipulability", "at the price of"]
    told = roadmap.parameters["refinement"]
    for wrong in ({"objectives": {"speed": {}}}, {"objectives": {"limits": {"weight": 1.0}}}, {"smoothest": "x"}):
        with pytest.raises(ValueError, match="refinement|limits"):
            check_refinement({"refinement": {**told, **wrong}})
    with pytest.raises(FileFormatError):
        grr_torch.Roadmap.load(tmp_path / "b.grr")


def test_the_commands_show_the_trade(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["build", "--robot", "planar_5", "--points", "150", "--no-record", "--objective", "manipulability=1"]
    built = CliRunner().invoke(app, words)
    assert built.exit_code == 0, built.output
    shown = CliRunner().invoke(app, ["info", "planar_5.grr"])
    for output in (built.output, shown.output):
        assert "manipulability" in output
        assert "at the price of" in output
    table = CliRunner().invoke(app, ["bench", "trade", "--robot", "planar_5", "--weight", "1"])
    assert table.exit_code == 0, table.output
    assert "| manipulability | 1 " in table.output


@pytest.mark.parametrize(
    "words",
    [
        ["build", "--robot", "planar_5", "--objective", "manipulability"],
        ["build", "--robot", "planar_5", "--objective", "speed=1"],
        ["build", "--robot", "planar_5", "--objective", "manipulability=1", "--no-refine"],
        ["bench", "trade", "--robot", "planar_5", "--objective", "limits"],
        ["bench", "trade", "--robot", "planar_5", "--weight", "0"],
    ],
)
def test_bad_options_are_one_line(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 2
    assert "error: " in result.output
    assert "Traceback" not in result.output
    assert not list(tmp_path.iterdir())
