"""The commands that write and read data sets and networks."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from grr_torch import NeuralIK
from grr_torch.errors import GrrError, ParameterError
from grr_torch.experiments.learning import compare_warm_starts
from grr_torch.learning.checkpoint import checkpoint_path
from grr_torch.learning.split import SPLITS


@pytest.fixture(scope="module")
def folder(planar_roadmap, tiny_ik, tmp_path_factory):
    path = tmp_path_factory.mktemp("learning")
    planar_roadmap.save(path / "r.grr")
    tiny_ik.save(path / "ik.safetensors")
    return path


@pytest.fixture
def command(folder, tmp_path, run_cli):
    """Runs a command beside a roadmap and the weights that learned it."""
    for name in ("r.grr", "ik.safetensors"):
        (tmp_path / name).symlink_to(folder / name)
    return run_cli


def test_export_writes_a_file_and_says_what_is_in_it(command, tmp_path):
    code, out, _ = command("export", "r.grr", "--samples", 2000, "--out", "d.parquet", "--json")
    assert code == 0
    printed = json.loads(out)
    assert sum(printed["counts"][part] for part in SPLITS) == 2000
    assert (tmp_path / "d.parquet").exists()
    code, out, _ = command("export", "r.grr", "--samples", 500, "--out", "d.npz", "--split", "random", "--jacobians")
    assert code == 0
    assert "500 samples" in out


def test_networks_are_trained_exported_and_measured_by_commands(command, tmp_path):
    size = ["--epochs", 2, "--samples", 2000, "--batch", 256, "--width", 16, "--depth", 1]
    code, out, err = command("train-ik", "r.grr", "--out", "new.safetensors", *size)
    assert code == 0
    assert "epoch 2/2" in err
    assert " mm " in err
    assert "best epoch" in out
    code, out, _ = command("export-ik", "new.safetensors", "--torch", "new.pt2")
    assert code == 0
    assert (tmp_path / "new.pt2").exists()
    code, out, _ = command("eval-ik", "ik.safetensors", "r.grr", "--points", 300, "--json")
    assert code == 0
    printed = json.loads(out)
    assert [errors["steps"] for errors in printed["errors"]] == [0, 1, 2]
    code, out, _ = command("eval-ik", "new.safetensors", "r.grr", "--points", 300)
    assert code == 0
    assert "poses / s" in out
    assert "roadmap.solve" in out


def test_bench_learning_prints_tables_and_writes_figures(command, tmp_path):
    words = ["bench", "learning", "r.grr", "--epochs", 1, "--samples", 2000, "--points", 200, "--json", "f.json"]
    code, out, _ = command(*words, "--labels", "none")
    assert code == 0
    assert "not like for like" in out
    assert [run["labels"] for run in json.loads((tmp_path / "f.json").read_text())["runs"]] == ["none"]


def test_interrupted_training_says_how_to_go_on(command, tmp_path, monkeypatch):
    import grr_torch.cli.train_ik as module

    def stop(epoch):
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "_show_epoch", stop)
    size = ["--epochs", 2, "--samples", 2000, "--batch", 256, "--width", 16, "--depth", 1]
    code, _, err = command("train-ik", "r.grr", "--out", "new.safetensors", *size)
    assert code == 130
    assert "--resume" in err
    assert not (tmp_path / "new.safetensors").exists()
    assert checkpoint_path(tmp_path / "new.safetensors").exists()
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    code, _, err = command("train-ik", "r.grr", "--out", "new.safetensors", "--resume", *size)
    assert code == 0
    assert "epoch 1/2" not in err


@pytest.mark.parametrize("what_ends_it", [KeyboardInterrupt, GrrError("no more")])
def test_networks_are_exported_in_all_formats_or_none(command, tmp_path, monkeypatch, what_ends_it):
    def write(network, origin, path):
        path.write_text("written")
        return 0.0

    def stop(network, origin, path):
        path.write_text("half")
        raise what_ends_it

    monkeypatch.setattr("grr_torch.learning.onnx.export_onnx", write)
    monkeypatch.setattr("grr_torch.learning.onnx.export_torch", stop)
    before = set(tmp_path.iterdir())
    code, _, err = command("export-ik", "ik.safetensors", "--onnx", "x.onnx", "--torch", "x.pt2")
    assert (code, err) in ((130, "interrupted: nothing was written\n"), (2, "error: no more\n"))
    assert set(tmp_path.iterdir()) == before
    monkeypatch.setattr("grr_torch.learning.onnx.export_torch", write)
    assert command("export-ik", "ik.safetensors", "--onnx", "x.onnx", "--torch", "x.pt2")[0] == 0
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in before} | {"x.onnx", "x.pt2"}


@pytest.mark.parametrize(
    "words",
    [
        ["export", "none.grr", "--out", "d.npz"],
        ["export", "r.grr", "--out", "d.txt"],
        ["export", "r.grr", "--out", "none/d.npz"],
        ["export", "r.grr", "--out", "d.npz", "--samples", 0],
        ["export", "r.grr", "--out", "d.npz", "--split", "blocks"],
        ["export", "r.grr", "--out", "d.npz", "--test", 1.5],
        ["train-ik", "r.grr", "--out", "ik.pt"],
        ["train-ik", "r.grr", "--out", "none/ik.safetensors"],
        ["train-ik", "r.grr", "--out", "x.safetensors", "--epochs", 0],
        ["train-ik", "r.grr", "--out", "x.safetensors", "--resume", "--samples", 1000],
        ["train-ik", "ik.safetensors", "--out", "x.safetensors"],
        ["export-ik", "ik.safetensors"],
        ["export-ik", "r.grr", "--torch", "x.pt2"],
        ["export-ik", "ik.safetensors", "--onnx", "x.pt"],
        ["export-ik", "ik.safetensors", "--torch", "none/x.pt2"],
        ["eval-ik", "r.grr", "r.grr"],
        ["eval-ik", "ik.safetensors", "r.grr", "--points", 0],
        ["bench", "learning", "r.grr", "--labels", "magic"],
        ["bench", "learning", "r.grr", "--labels", ","],
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(command, words, tmp_path):
    before = set(tmp_path.iterdir())
    code, out, err = command(*words)
    assert code == 2
    assert out == ""
    assert "Traceback" not in err
    assert err.startswith("error: ")
    assert set(tmp_path.iterdir()) == before


def test_eval_refuses_a_roadmap_that_was_not_learned(command, planar_roadmap, tmp_path):
    other = replace(planar_roadmap, configurations=planar_roadmap.configurations + 0.1)
    with pytest.raises(ParameterError):
        compare_warm_starts(NeuralIK.load("ik.safetensors", other), other)
    other.save(tmp_path / "other.grr")
    code, _, err = command("eval-ik", "ik.safetensors", "other.grr")
    assert code == 2
    assert "trained on" in err
