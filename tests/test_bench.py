"""`grr-torch bench`: its figures are measured, and it refuses what it does not know."""

from __future__ import annotations

import json

import pytest
import torch
from grr_torch.cli.main import app
from typer.testing import CliRunner

from grr_torch.errors import ParameterError, UnknownNameError
from grr_torch.experiments import peers
from grr_torch.experiments.effort import measure_effort
from grr_torch.experiments.profile import profile_build
from grr_torch.experiments.projection_cost import count_operators, projection_cost
from grr_torch.experiments.speed import SECTIONS, measure_speed
from grr_torch.experiments.timing import in_fresh_process, median_seconds
from grr_torch.resolution.memory import peak_memory


def test_a_section_gives_rows_with_figures():
    table = measure_speed(sections=["kinematics", "self-collision"], peers=["pytorch-kinematics"], repeats=1)
    assert [row.what.split(",")[0] for row in table.rows] == ["pose + Jacobian"] * 4 + ["self-collision"]
    assert all(row.ours > 0.0 for row in table.rows)
    assert set(table.rows[0].peers) == {"pytorch-kinematics"}
    assert (
        table.rows[0].ratios()["pytorch-kinematics"] == table.rows[0].peers["pytorch-kinematics"] / table.rows[0].ours
    )
    assert table.peers["pytorch-kinematics"][0].isdigit()
    assert table.machine["torch"] == torch.__version__


def test_peers_that_are_not_installed_are_named(monkeypatch):
    monkeypatch.setitem(peers.PEERS, "Klampt", ("no_such_module_klampt", "klampt"))
    found, missing = peers.installed_peers()
    assert "Klampt" not in found
    assert "grr-torch[bench]" in missing["Klampt"]


def test_pinocchio_is_asked_for_the_same_jacobians(kinova, generator):
    pytest.importorskip("pinocchio")
    q = kinova.sample(3, generator)
    call = peers.pinocchio_jacobian(kinova, q)
    call()
    (jacobians,) = (cell.cell_contents for cell in call.__closure__ if hasattr(cell.cell_contents, "shape"))
    torch.testing.assert_close(torch.from_numpy(jacobians), kinova.jacobian(q), atol=1e-9, rtol=0)


def test_medians_are_of_what_ran():
    counts = {"a": 0, "b": 0}

    def count(name):
        counts[name] += 1

    seconds = median_seconds({"a": lambda: count("a"), "b": lambda: count("b")}, 3)
    assert set(seconds) == {"a", "b"}
    assert all(value > 0.0 for value in seconds.values())
    assert all(value >= 5 for value in counts.values())


def test_memory_is_that_of_the_process_alone():
    held = torch.zeros(2**25, dtype=torch.float64)  # 256 MiB here
    held += 1.0
    _, peak = in_fresh_process(abs, -1)
    assert 10.0 < peak < peak_memory()


def test_a_profile_adds_up_to_a_build(planar_5):
    stages, vertices = profile_build(planar_5, "position", points=300)
    assert 200 < vertices < 500
    by_name = {stage.name: stage for stage in stages}
    assert by_name["poses"].calls > 10
    assert by_name["damped least squares"].seconds > 0.0
    assert by_name["self-collision"].calls == 0


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"sections": ["speed"]}, UnknownNameError),
        ({"peers": ["drake"]}, UnknownNameError),
        ({"repeats": 0}, ParameterError),
    ],
)
def test_bad_input_is_an_error(options, error):
    with pytest.raises(error):
        measure_speed(**{"sections": ["self-collision"], **options})


def test_the_command_prints_a_table_and_writes_json(tmp_path):
    out = tmp_path / "speed.json"
    arguments = ["bench", "speed", "--only", "self-collision", "--repeats", "1", "--json", str(out)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "| self-collision, all pairs" in result.output
    written = json.loads(out.read_text())
    assert written["rows"][0]["unit"] == "µs a configuration"
    assert not list(tmp_path.glob(".*")), "nothing else is left"


@pytest.mark.parametrize(
    "option", [["--only", "nothing"], ["--peers", "drake"], ["--repeats", "0"], ["--json", "/no/f"]]
)
def test_bad_options_are_one_line(option):
    result = CliRunner().invoke(app, ["bench", "speed", *option])
    assert result.exit_code == 2
    assert "error: " in result.output
    assert "Traceback" not in result.output


def test_every_section_is_in_the_help():
    result = CliRunner().invoke(app, ["bench", "speed", "--help"], env={"COLUMNS": "300", "TERM": "dumb"})
    assert all(name in result.output for name in SECTIONS)


def test_the_parts_of_a_projection_are_counted_where_they_run(kinova):
    cost = projection_cost(kinova, count=700, repeats=2)
    parts = {part.name: part for part in cost.parts}
    evaluated, stepped = parts["poses of the frames"], parts["steps: damped least squares"]
    # every pose is evaluated at least once more than it is stepped, and nearly all need two steps or more
    assert parts["errors"].columns == evaluated.columns
    assert evaluated.columns >= stepped.columns + 0.99
    assert 2.0 < stepped.columns < 6.0
    assert 0.0 <= parts["steps again, at limits"].columns < 0.5 * stepped.columns
    assert cost.floor() > 0.0
    assert cost.functions > 0.0
    # a product of 5 × 4 × 3 a joint, and of 4 × 4 × 3 for the tool
    assert evaluated.products == pytest.approx(7 * 2 * 60 + 2 * 48)


def test_operators_are_counted_with_their_operations():
    a, b = torch.ones(3, 5), torch.ones(5, 7)
    counter = count_operators(lambda: (a @ b).addcmul_(a[:, :1], b[:1]).view(21).sum())
    assert counter.operators == 3
    assert counter.products == 2 * 3 * 5 * 7
    assert counter.pointwise == 2 * 21 + 21


def test_only_roadmaps_that_no_other_beats_are_shown():
    best = measure_effort(3, robots=["planar_5"], tasks=["fixed-rotation"])
    assert best
    assert not any(one.beats(other) for one in best for other in best)
    smoothness = [one.quality.smoothness for one in best]
    assert smoothness == sorted(smoothness)
    gentle = measure_effort(1, robots=["planar_5"], tasks=["fixed-rotation"], max_slope=60.0)
    assert all(one.quality.smoothness_max <= 60.0 < best[0].quality.smoothness_max for one in gentle)
    with pytest.raises(ParameterError, match="draws"):
        measure_effort(0)
    with pytest.raises(ParameterError, match="max_slope"):
        measure_effort(1, max_slope=0.0)
    with pytest.raises(UnknownNameError, match="fixed-rotation"):
        measure_effort(1, tasks=["pose"])


def test_figures_of_an_infinite_bound_are_json(tmp_path):
    out = tmp_path / "e.json"
    words = ["bench", "effort", "--draws", "1", "--robot", "planar_5", "--task", "position", "--max-slope", "inf"]
    result = CliRunner().invoke(app, [*words, "--json", str(out)])
    assert result.exit_code == 0, result.output
    figures = json.loads(out.read_text(encoding="utf-8"), parse_constant=pytest.fail)
    assert figures["max_slope"] == "inf"
    assert all(roadmap["smoothness_p99"] <= roadmap["smoothness_max"] for roadmap in figures["roadmaps"])
    assert "99 %, largest slope [rad/m]; steep edges" in result.output
