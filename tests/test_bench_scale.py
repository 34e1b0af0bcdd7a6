"""`grr-torch bench scale`: its figures are measured, and it refuses what it cannot measure."""

from __future__ import annotations

import json
import subprocess
import sys
import time

import pytest
from grr_torch.cli.main import app
from typer.testing import CliRunner

from grr_torch import build
from grr_torch.errors import ParameterError
from grr_torch.experiments import scale
from grr_torch.experiments.scale import Size, exponents, measure_scale, plot
from grr_torch.experiments.timing import in_fresh_process


def row(vertices, **figures):
    names = [name for name in Size.__dataclass_fields__ if name != "vertices"]
    return Size(vertices=vertices, **{name: figures.get(name, 1.0) for name in names})


def test_exponents_tell_straight_lines_from_others():
    sizes = (100, 20_000, 100_000, 500_000)
    rows = [row(v, seconds=3.0 * v, edges=v**1.5, save_seconds=7.0 if v > 100 else 1e6) for v in sizes]
    powers = exponents(rows)
    assert powers["seconds"] == pytest.approx(1.0)
    assert powers["edges"] == pytest.approx(1.5)
    assert powers["save_seconds"] == pytest.approx(0.0, abs=1e-9)
    assert exponents(rows[:2]) == {}


def test_a_plot_is_a_png(tmp_path):
    plot([row(1_000), row(10_000, seconds=10.0)], tmp_path / "scale.png")
    assert (tmp_path / "scale.png").read_bytes().startswith(b"\x89PNG")


def test_the_command_measures_prints_and_draws(tmp_path):
    out, picture = tmp_path / "scale.json", tmp_path / "scale.png"
    arguments = ["bench", "scale", "--robot", "planar_5", "--task", "position", "--points", "200", "--no-refine"]
    result = CliRunner().invoke(app, [*arguments, "--repeats", "1", "--json", str(out), "--plot", str(picture)])
    assert result.exit_code == 0, result.output
    assert "| vertices" in result.output
    (figures,) = json.loads(out.read_text())["sizes"]
    assert 200 <= figures["vertices"] < 300
    assert figures["edges"] > figures["vertices"] > figures["resolved"] > 100
    assert all(value > 0.0 for value in figures.values())
    assert figures["peak_mib"] > 50.0 > figures["file_mib"]
    assert picture.stat().st_size > 1000


def test_processor_time_is_that_of_forked_processes_too():
    before, alone = scale._processor_seconds(), time.process_time()
    burn = "import time\nwhile time.process_time() < 0.5: pass"
    subprocess.run([sys.executable, "-c", burn], check=True)
    # the system counts in hundredths of a second
    assert scale._processor_seconds() - before > 0.45 > time.process_time() - alone


@pytest.mark.parametrize("task", ["position", "pose"])
def test_the_build_that_warms_up_is_small_beside_what_is_measured(monkeypatch, task):
    sizes = []

    def noted(*arguments, **options):
        roadmap = build(*arguments, **options)
        sizes.append(len(roadmap.points))
        return roadmap

    monkeypatch.setattr(scale, "build", noted)
    figures = scale._grow("kinova", task, 400, False, "cpu")
    warm, measured = sizes
    assert measured == figures["vertices"]
    assert 1.5 * warm < measured
    assert figures["cpu_seconds"] > 0.0


def refuse():
    raise ParameterError("points", 3, "fewer")


def test_an_error_comes_back_from_a_process_of_its_own():
    with pytest.raises(ParameterError, match="points: got 3; valid: fewer") as caught:
        in_fresh_process(refuse)
    assert (caught.value.name, caught.value.value, caught.value.valid) == ("points", 3, "fewer")


@pytest.mark.parametrize("options", [{"sizes": []}, {"repeats": 0}])
def test_bad_input_is_an_error(options):
    with pytest.raises(ParameterError):
        measure_scale("planar_5", **options)


@pytest.mark.parametrize(
    "option", [["--plot", "f.jpg"], ["--json", "/no/f"], ["--robot", "nobody"], ["--task", "x"], ["--points", "0"]]
)
def test_bad_options_are_one_line(option):
    result = CliRunner().invoke(app, ["bench", "scale", "--points", "100", *option])
    assert result.exit_code == 2
    assert "error: " in result.output
    assert "Traceback" not in result.output
