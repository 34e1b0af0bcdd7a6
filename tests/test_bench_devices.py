"""`grr-torch bench devices`: the same work everywhere, measured; the CPU stands for all devices."""

from __future__ import annotations

import json

import pytest
from grr_torch.cli.main import app
from typer.testing import CliRunner

from grr_torch.errors import ParameterError, UnknownNameError
from grr_torch.experiments.devices import measure_devices


def test_the_command_measures_prints_and_writes(tmp_path):
    out = tmp_path / "devices.json"
    words = (
        "bench devices --device cpu --device cpu --only solve --only export --only train --solves 500 --samples 3000"
    )
    result = CliRunner().invoke(app, [*words.split(), "--epochs", "1", "--repeats", "1", "--json", str(out)])
    assert result.exit_code == 0, result.output
    assert "| solve 500 points" in result.output
    work = json.loads(out.read_text())["work"]
    assert len(work) == 6
    assert all(part["seconds"] > 0.0 for part in work)
    for first, second in zip(work[::2], work[1::2], strict=True):
        assert (first["work"], first["outcome"]) == (second["work"], second["outcome"])


@pytest.mark.parametrize("options", [{"devices": []}, {"solves": 0}, {"samples": 0}, {"epochs": 0}, {"repeats": 0}])
def test_bad_input_is_an_error(options):
    with pytest.raises(ParameterError):
        measure_devices(**{"devices": ["cpu"], **options})


def test_unknown_work_and_devices_are_named():
    with pytest.raises(UnknownNameError, match="roadmaps"):
        measure_devices(["cpu"], work=["roadmap"])
    result = CliRunner().invoke(app, ["bench", "devices", "--device", "tpu9", "--only", "solve"])
    assert result.exit_code == 2
    assert "device: got tpu9; valid: cpu" in result.output
