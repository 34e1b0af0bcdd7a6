"""Data sets and networks in files, and the commands that write and read them."""

from __future__ import annotations

import json
import subprocess
import sys
import time
import warnings

import numpy as np
import pytest
import torch
from command_line import PROGRAM
from safetensors.numpy import load_file

import grr_torch
from grr_torch import Split, TrainingOptions
from grr_torch.errors import GrrError, GrrWarning, MissingPackageError
from grr_torch.experiments.learning import compare_warm_starts, independent_solutions, measure_learning
from grr_torch.learning.export import export_dataset
from grr_torch.learning.network import Architecture
from grr_torch.learning.onnx import export_onnx, export_torch
from grr_torch.learning.split import SPLITS
from grr_torch.resolution.roadmap_file import read_file, roadmap_hash
from grr_torch.tensor_file import tensors_hash

ROWS = 20_000


def read_dataset(path):
    """Arrays and metadata of a data set, whatever its kind."""
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        about = json.loads(str(arrays.pop("grr_torch")))
        return {**arrays, "split": [SPLITS.index(part) for part in arrays["split"]]}, about
    if path.suffix == ".safetensors":
        from safetensors import safe_open

        with safe_open(path, "np") as file:
            about = json.loads(file.metadata()["grr_torch"])
        return load_file(path), about
    from pyarrow import parquet

    table = parquet.read_table(path)
    about = json.loads(table.schema.metadata[b"grr_torch"])
    for name, unit in about["units"].items():
        assert table.schema.field(name).metadata == {b"unit": unit.encode()}
    arrays = {name: np.column_stack([table[c].to_numpy() for c in group]) for name, group in about["columns"].items()}
    if "jacobians" in arrays:
        arrays["jacobians"] = arrays["jacobians"].reshape(len(table), 6, -1)
    return {
        **arrays,
        "valid": arrays["valid"][:, 0],
        "split": [SPLITS.index(part) for part in arrays["split"][:, 0]],
    }, about


@pytest.mark.parametrize("suffix", [".parquet", ".safetensors", ".npz"])
def test_a_data_set_reads_back_with_names_units_and_hash(planar_roadmap, tmp_path, suffix):
    out = tmp_path / f"d{suffix}"
    counts = export_dataset(planar_roadmap, out, ROWS, jacobians=True, seed=4)
    arrays, about = read_dataset(out)
    points, q, valid = arrays["points"], arrays["configurations"], arrays["valid"]
    assert points.shape == (ROWS, 2)
    assert q.shape == (ROWS, 5)
    assert points.dtype == q.dtype == np.float64
    assert counts["not valid"] == int((~valid).sum())
    assert [counts[part] for part in SPLITS] == np.bincount(arrays["split"], minlength=3).tolist()
    solution = planar_roadmap.solve(torch.from_numpy(points))
    np.testing.assert_array_equal(valid, solution.valid.numpy())
    np.testing.assert_allclose(q, solution.configurations.numpy(), atol=1e-9)
    jacobians = planar_roadmap.robot.jacobian(torch.from_numpy(q[valid]))
    np.testing.assert_allclose(arrays["jacobians"][valid], jacobians.numpy(), atol=1e-9)
    assert about["columns"]["configurations"] == list(planar_roadmap.robot.joint_names)
    assert about["units"] == {
        **dict.fromkeys("xy", "m"),
        **dict.fromkeys(planar_roadmap.robot.joint_names, "rad"),
        **dict.fromkeys(about["columns"]["jacobians"][:15], "m/rad"),
        **dict.fromkeys(about["columns"]["jacobians"][15:], "rad/rad"),
    }
    assert about["roadmap_sha256"] == roadmap_hash(planar_roadmap)
    planar_roadmap.save(tmp_path / "r.grr")
    tensors = read_file(tmp_path / "r.grr")[1]
    assert about["roadmap_sha256"] == tensors_hash({name: tensors[name] for name in tensors if name != "reachable"})
    np.testing.assert_array_equal(Split(seed=4).of(planar_roadmap)(torch.from_numpy(points)), arrays["split"])


def test_all_kinds_of_files_hold_the_same(planar_roadmap, tmp_path):
    read = []
    for suffix in (".parquet", ".safetensors", ".npz"):
        export_dataset(planar_roadmap, tmp_path / f"d{suffix}", 500, split=Split("random"))
        read.append(read_dataset(tmp_path / f"d{suffix}")[0])
    for name in ("points", "configurations", "valid", "split"):
        for other in read[1:]:
            np.testing.assert_array_equal(read[0][name], other[name])


def test_points_that_the_map_does_not_solve_keep_their_rows(planar_roadmap, tmp_path, monkeypatch):
    from grr_torch.resolution.roadmap import Roadmap

    solve = Roadmap.solve

    def fails(self, points, **options):
        solution = solve(self, points, **options)
        solution.valid[::7] = False
        solution.configurations[::7] = torch.nan
        return solution

    monkeypatch.setattr(Roadmap, "solve", fails)
    counts = export_dataset(planar_roadmap, tmp_path / "d.npz", 700, jacobians=True)
    arrays, _ = read_dataset(tmp_path / "d.npz")
    assert counts["not valid"] == 100
    assert len(arrays["points"]) == 700
    assert np.isfinite(arrays["points"]).all()
    np.testing.assert_array_equal(np.isnan(arrays["configurations"]).all(1), ~arrays["valid"])
    np.testing.assert_array_equal(np.isfinite(arrays["jacobians"]).all((1, 2)), arrays["valid"])


@pytest.mark.parametrize("suffix", [".parquet", ".safetensors", ".npz"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_export_that_is_stopped_leaves_nothing(planar_roadmap, tmp_path, suffix, error):
    out = tmp_path / f"d{suffix}"

    def stop(stage, done, total):
        if stage == "solving" and done:
            raise error

    with pytest.raises(error):
        export_dataset(planar_roadmap, out, ROWS, progress=stop)
    assert not list(tmp_path.iterdir())
    out.write_bytes(b"before")
    with pytest.raises(error):
        export_dataset(planar_roadmap, out, ROWS, progress=stop)
    assert out.read_bytes() == b"before"


def test_parts_without_samples_are_warned_of(planar_roadmap, tmp_path):
    with pytest.warns(GrrWarning, match="none of 300 samples is for validation or test: take more, or smaller blocks"):
        export_dataset(planar_roadmap, str(tmp_path / "d.npz"), 300, split=Split(block=100.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        export_dataset(planar_roadmap, tmp_path / "d.npz", 300, split=Split("random", test=0.0))


def test_an_export_that_is_asked_to_end_leaves_nothing(planar_roadmap, tmp_path):
    planar_roadmap.save(tmp_path / "map.grr")
    words = ["export", tmp_path / "map.grr", "--samples", "3000000", "--out", tmp_path / "d.npz"]
    process = subprocess.Popen([*PROGRAM, *map(str, words)], stderr=subprocess.DEVNULL)
    try:
        while not list(tmp_path.glob(".d.npz*")):
            assert process.poll() is None
            time.sleep(0.05)
        process.terminate()
        assert process.wait(60) != 0
    finally:
        process.kill()
    assert [path.name for path in tmp_path.iterdir()] == ["map.grr"]


def test_pandas_opens_parquet_as_it_is(planar_roadmap, tmp_path):
    pandas = pytest.importorskip("pandas")
    export_dataset(planar_roadmap, tmp_path / "d.parquet", 300)
    frame = pandas.read_parquet(tmp_path / "d.parquet")
    assert list(frame) == ["x", "y", *planar_roadmap.robot.joint_names, "valid", "split"]
    assert set(frame["split"]) <= set(SPLITS)
    assert frame["valid"].dtype == bool


# networks in other formats


def some_points(count=300):
    return 0.5 * torch.rand(count, 2, generator=torch.Generator().manual_seed(2)) - 0.25


def test_onnx_gives_what_the_network_gives(tiny_ik, tmp_path):
    runtime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    assert export_onnx(tiny_ik.network, tiny_ik.origin, tmp_path / "ik.onnx") < 1e-5
    session = runtime.InferenceSession(str(tmp_path / "ik.onnx"), providers=["CPUExecutionProvider"])
    assert [(x.name, x.type, x.shape[1]) for x in session.get_inputs()] == [("points", "tensor(float)", 2)]
    assert [(x.name, x.type, x.shape[1]) for x in session.get_outputs()] == [("configurations", "tensor(float)", 5)]
    about = json.loads(session.get_modelmeta().custom_metadata_map["grr_torch"])
    assert about["joint_names"] == list(tiny_ik.robot.joint_names)
    for count in (1, 7, 300):
        points = some_points(count)
        (q,) = session.run(None, {"points": points.numpy()})
        np.testing.assert_allclose(q, tiny_ik(points).numpy(), atol=1e-5)


def test_torch_export_gives_what_the_network_gives(tiny_ik, tmp_path):
    assert export_torch(tiny_ik.network, tiny_ik.origin, tmp_path / "ik.pt2") < 1e-6
    program = torch.export.load(tmp_path / "ik.pt2").module()
    for count in (1, 7, 300):
        assert torch.allclose(program(some_points(count)).double(), tiny_ik(some_points(count)), atol=1e-6)


def test_a_missing_package_is_named(tiny_ik, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    pytest.importorskip("onnxscript")
    with pytest.raises(MissingPackageError, match=r"grr-torch\[learn\]"):
        export_onnx(tiny_ik.network, tiny_ik.origin, tmp_path / "ik.onnx")
    assert not list(tmp_path.iterdir())


def test_an_export_that_differs_is_refused(tiny_ik, tmp_path, monkeypatch):
    load = torch.export.load

    class Off:
        def __init__(self, *given):
            self._program = load(*given)

        def module(self):
            return lambda points: self._program.module()(points) + 0.01

    monkeypatch.setattr(torch.export, "load", Off)
    with pytest.raises(GrrError, match="rad from the network"):
        export_torch(tiny_ik.network, tiny_ik.origin, tmp_path / "ik.pt2")
    assert not list(tmp_path.iterdir())


# the experiment


def test_the_same_network_is_measured_with_each_kind_of_labels(planar_roadmap):
    labels = ["roadmap", "independent-joints"]
    size = Architecture(width=32, depth=2, waves=4)
    options = TrainingOptions(samples=3000, epochs=12, batch=256, architecture=size)
    outcomes = measure_learning(planar_roadmap, options, labels=labels, points=500)
    assert [outcome.labels for outcome in outcomes] == labels
    assert [outcome.ik.origin.training["options"]["pose_weight"] for outcome in outcomes] == [1.0, 0.0]
    by_labels = {outcome.labels: outcome.evaluation for outcome in outcomes}
    assert by_labels["roadmap"].from_map < by_labels["independent-joints"].from_map
    assert all(json.dumps(outcome.to_dict()) for outcome in outcomes)
    counts = {len(list(outcome.ik.network.parameters())) for outcome in outcomes}
    assert len(counts) == 1
    rows = compare_warm_starts(outcomes[0].ik, planar_roadmap, points=500)
    assert rows[0].method == "roadmap.solve"
    assert rows[0].from_map == 0.0
    assert min(row.valid for row in rows[:2]) > 0.9


def test_independent_solutions_reach_the_points_but_are_no_map(planar_roadmap):
    points = grr_torch.RoadmapDataset(planar_roadmap, 400).points
    q, valid = independent_solutions(planar_roadmap, points, 0)
    assert float(valid.double().mean()) > 0.99
    position, _ = planar_roadmap.robot.forward_kinematics(q[valid])
    assert float((position[:, :2] - points[valid]).norm(dim=1).max()) <= 1e-4
    again, _ = independent_solutions(planar_roadmap, points, 1)
    assert float((again - q)[valid].abs().amax(1).median()) > 0.1
