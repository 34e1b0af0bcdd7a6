"""`grr-torch solve` and `grr-torch plan`."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

import grr_torch
from grr_torch.applications.path import save_path
from grr_torch.errors import ParameterError
from grr_torch.recording.plan import record_plan
from grr_torch.tables import read_points

NAMES = ["x", "y", *(f"joint_{k}" for k in range(1, 6)), "valid", "status"]


@pytest.fixture(scope="module")
def folder(planar_roadmap, tmp_path_factory):
    path = tmp_path_factory.mktemp("commands")
    planar_roadmap.save(path / "r.grr")
    return path


@pytest.fixture
def command(folder, tmp_path, run_cli):
    """Runs a command beside a roadmap."""
    (tmp_path / "r.grr").symlink_to(folder / "r.grr")
    return run_cli


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(0).uniform(-0.6, 0.6, (500, 2))


def write_points(path, points):
    import pyarrow
    from pyarrow import parquet

    if path.suffix == ".csv":
        np.savetxt(path, points, delimiter=",", fmt="%.17g")
    elif path.suffix == ".npy":
        np.save(path, points)
    else:
        # columns are found by name, whatever stands beside them
        columns = {"name": ["p"] * len(points), "y": points[:, 1], "x": points[:, 0]}
        parquet.write_table(pyarrow.table(columns), path)


def read_table(path):
    """Coordinates and joints (N, k), valid (N,), status (N,) and the columns' names."""
    from pyarrow import csv, parquet

    if path.suffix == ".npz":
        with np.load(path) as file:
            names = ["x", "y", *file["joint_names"], "valid", "status"]
            return np.column_stack([file["points"], file["configurations"]]), file["valid"], file["status"], names
    if path.suffix == ".npy":
        table = np.load(path)
        names = list(table.dtype.names)
        columns = {name: table[name] for name in names}
    else:
        read = csv.read_csv(path) if path.suffix == ".csv" else parquet.read_table(path)
        names = read.column_names
        columns = {name: read[name].to_numpy() for name in names}
    return np.column_stack([columns[name] for name in names[:-2]]), columns["valid"], columns["status"], names


@pytest.mark.parametrize(
    ("given", "out"), [("csv", "csv"), ("csv", "npz"), ("npy", "npy"), ("npy", "parquet"), ("parquet", "csv")]
)
def test_files_of_points_are_solved_row_by_row(command, planar_roadmap, points, tmp_path, given, out):
    write_points(tmp_path / f"p.{given}", points)
    code, shown, _ = command("solve", "r.grr", "--points", f"p.{given}", "--out", f"s.{out}", "--json")
    assert code == 0
    expected = planar_roadmap.solve(torch.from_numpy(points))
    values, valid, status, names = read_table(tmp_path / f"s.{out}")
    assert names == NAMES
    np.testing.assert_array_equal(values[:, :2], points)
    np.testing.assert_allclose(values[:, 2:], expected.configurations, atol=1e-9)
    np.testing.assert_array_equal(valid.astype(bool), expected.valid)
    np.testing.assert_array_equal(status.astype(str), expected.status)
    counts = json.loads(shown)["counts"]
    assert counts == dict(zip(*map(np.ndarray.tolist, np.unique(expected.status, return_counts=True)), strict=True))
    assert sum(counts.values()) == len(points)
    assert {"solved", "outside"} <= set(counts)


def test_what_is_written_can_be_read_as_points_again(command, points, tmp_path):
    write_points(tmp_path / "p.npy", points)
    before = "p.npy"
    for out in ("a.csv", "b.parquet", "c.npy"):
        assert command("solve", "r.grr", "--points", before, "--out", out)[0] == 0
        before = out
    np.testing.assert_array_equal(read_table(tmp_path / "c.npy")[0], read_table(tmp_path / "a.csv")[0])


def test_points_on_the_command_line_are_shown(command, planar_roadmap):
    code, shown, _ = command("solve", "r.grr", "--point", -0.3, 0.2, "--point", 9, 9)
    assert code == 0
    assert "| -0.3 0.2" in shown
    assert "solved" in shown
    assert "outside" in shown
    code, shown, _ = command("solve", "r.grr", "--point", -0.3, 0.2, "--point", 9, 9, "--json", "--out", "s.csv")
    first, second = json.loads(shown)["points"]
    q = planar_roadmap.solve(torch.tensor([-0.3, 0.2], dtype=torch.float64)).configurations
    np.testing.assert_allclose(first["configuration"], q)
    assert (first["valid"], first["status"]) == (True, "solved")
    assert (second["configuration"], second["valid"], second["status"]) == (None, False, "outside")
    assert json.loads(shown)["counts"] == {"solved": 1, "outside": 1}


def bad_files(folder):
    import pyarrow
    from pyarrow import parquet

    texts = {
        "empty.csv": "",
        "header.csv": "x,y\n",
        "nan.csv": "0.1,0.2\n0.3,nan\n",
        "gap.csv": "0.1,0.2\n0.3,\n",
        "inf.csv": "0.1,inf\n",
        "three.csv": "0.1,0.2,0.3\n",
        "ragged.csv": "0.1,0.2\n0.3,0.1,0.2\n",
        "words.csv": "x,y\nhere,there\n",
        "points.txt": "0.1 0.2\n",
        "broken.parquet": "PAR1",
        "broken.npy": "no array",
        "good.csv": "x,y\n0.3,0.1\n",
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    np.save(folder / "none.npy", np.empty((0, 2)))
    np.save(folder / "wide.npy", np.zeros((4, 3)))
    np.save(folder / "flat.npy", np.zeros(2))
    np.save(folder / "objects.npy", np.array([{"x": 1}], dtype=object), allow_pickle=True)
    parquet.write_table(pyarrow.table({"x": ["a"], "y": ["b"]}), folder / "text.parquet")
    (folder / "folder.csv").mkdir()


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("solve r.grr", "--point and --points: got neither"),
        ("solve r.grr --point 0 0 --points good.csv", "--point and --points: got both"),
        ("solve r.grr --point 0 0 0", "--point: got '0 0 0'; valid: 2 finite numbers: x y"),
        ("solve r.grr --point a b", "--point: got 'a b'; valid: 2 finite numbers: x y"),
        ("solve --point 0,2 0.3 r.grr", "--point: got '0,2 0.3'; valid: 2 finite numbers: x y"),
        ("solve --point 0.1 0.3m r.grr", "--point: got '0.1 0.3m'; valid: 2 finite numbers: x y"),
        ("solve --point -.1 0..3 r.grr", "--point: got '-.1 0..3'; valid: 2 finite numbers: x y"),
        ("solve r.grr --point -x 0.2", "--point: got '-x 0.2'; valid: 2 finite numbers: x y"),
        ("solve --point 0.1 0.3 3r.grr", "3r.grr: does not exist"),
        ("solve --point 0.1 0.3 2026/r.grr", "2026/r.grr: does not exist"),
        ("solve r.grr --point 0.1 y", "--point: got '0.1 y'; valid: 2 finite numbers: x y"),
        ("solve r.grr --point 0.1 O.2", "--point: got '0.1 O.2'; valid: 2 finite numbers: x y"),
        ("solve --point 0 b r.grr", "--point: got '0 b'; valid: 2 finite numbers: x y"),
        ("solve r.grr --point 0 nan", "2 finite numbers: x y"),
        ("solve none.grr --point 0 0", "none.grr: does not exist"),
        ("solve r.grr --point 0 0 --device tpu9", "device: got tpu9; valid: cpu"),
        ("solve good.csv --point 0 0", "truncated or not a roadmap"),
        ("solve r.grr --points good.csv", "--out: got nothing"),
        ("solve r.grr --points good.csv --out good.csv", "another file than those that are read"),
        ("solve r.grr --point 0 0 --out r.grr", "a file that ends in .csv, .npy, .npz, .parquet"),
        ("solve r.grr --point 0 0 --out s.xlsx", "a file that ends in .csv, .npy, .npz, .parquet"),
        ("solve r.grr --point 0 0 --out no/s.csv", "folder 'no' does not exist"),
        ("solve r.grr --points none.csv --out s.csv", "none.csv: does not exist"),
        ("solve r.grr --points folder.csv --out s.csv", "folder.csv: is not a regular file"),
        ("solve r.grr --points points.txt --out s.csv", "a file that ends in .csv, .npy, .parquet"),
        ("solve r.grr --points empty.csv --out s.csv", "empty.csv: holds no points"),
        ("solve r.grr --points header.csv --out s.csv", "header.csv: holds no points"),
        ("solve r.grr --points none.npy --out s.csv", "none.npy: holds no points"),
        ("solve r.grr --points nan.csv --out s.csv", "nan.csv: row 2 holds NaN"),
        ("solve r.grr --points gap.csv --out s.csv", "gap.csv: row 2 holds NaN, infinite or missing"),
        ("solve r.grr --points inf.csv --out s.csv", "inf.csv: row 1 holds NaN"),
        ("solve r.grr --points three.csv --out s.csv", "has 3 columns; valid: 2, or columns named x, y"),
        ("solve r.grr --points ragged.csv --out s.csv", "ragged.csv: is not a table of numbers"),
        ("solve r.grr --points words.csv --out s.csv", "words.csv: is not a table of numbers"),
        ("solve r.grr --points wide.npy --out s.csv", "shape (4, 3) of float64; valid: (N, 2)"),
        ("solve r.grr --points flat.npy --out s.csv", "shape (2,) of float64; valid: (N, 2)"),
        ("solve r.grr --points objects.npy --out s.csv", "objects.npy: is not a table of numbers"),
        ("solve r.grr --points broken.npy --out s.csv", "broken.npy: is not a table of numbers"),
        ("solve r.grr --points broken.parquet --out s.csv", "broken.parquet: is not a table of numbers"),
        ("solve r.grr --points text.parquet --out s.csv", "column 'x' holds string; valid: numbers"),
        ("plan r.grr --start 0.3 0.1", "--goal and --goal-configuration: got neither; valid: one of them"),
        ("plan r.grr --goal 0.3 0.1", "--start and --start-configuration: got neither; valid: one of them"),
        ("plan r.grr --start 0.3 --goal 0.3 0.1", "--start: got '0.3'; valid: 2 finite numbers: x y"),
        ("plan r.grr --start 0.3 inf --goal 0.3 0.1", "--start: got '0.3 inf'"),
        ("plan r.grr --start-configuration 0 0 --goal 0.3 0.1", "5 finite numbers: joint_1 joint_2"),
        ("plan r.grr --start 0.3 0 --start-configuration 1 1 1 1 1 --goal 0 0.3", "--start-configuration: got both"),
        (
            "plan r.grr --start 0.3 0 --goal 0 0.3 --record p.txt",
            "--record: got p.txt; valid: a file that ends in .rrd",
        ),
        ("solve r.grr --point=0.1 0.2 0.3", "--point: got '0.1 0.2 0.3'; valid: 2 finite numbers: x y"),
        ("plan r.grr --start 0.3 0 --goal 0 0.3 --step 9", "step: got 9.0"),
        ("plan r.grr --start 0.3 0 --goal 0 0.3 --velocity -1", "velocity_limits: got -1.0"),
        ("plan r.grr --start 0.3 0 --goal 0 0.3 --acceleration 0", "acceleration_limits: got 0.0"),
        ("plan r.grr --start 0.3 0 --goal 0 0.3 --out p.txt", "a file that ends in"),
        ("plan r.grr --start 0.3 0 --goal 0 0.3 --record r.grr", "another file than those that are read"),
        ("plan r.grr --start 0.3 0 --goal 0 0.3 --out p.csv --record p.csv", "another file than that of --out"),
        ("plan none.grr --start 0.3 0 --goal 0 0.3", "none.grr: does not exist"),
    ],
)
def test_a_mistake_is_one_clear_line_and_exit_code_2(command, tmp_path, words, complaint):
    bad_files(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
    code, shown, errors = command(*words.split())
    assert code == 2
    assert complaint in errors
    assert errors.startswith("error: ")
    assert errors.count("\n") == 1
    assert shown == ""
    assert {path: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == before


@pytest.mark.parametrize("suffix", [".csv", ".npy", ".npz", ".parquet"])
def test_a_path_is_written_as_it_was_planned(planar_roadmap, tmp_path, suffix):
    start, goal = (torch.tensor(point, dtype=torch.float64) for point in ([0.3, -0.2], [-0.2, 0.3]))
    path = planar_roadmap.plan(start, goal)
    expected = np.column_stack([path.times, path.points, path.configurations])
    save_path(planar_roadmap, path, tmp_path / f"p{suffix}")
    if suffix == ".npz":
        with np.load(tmp_path / "p.npz") as file:
            found = np.column_stack([file["times"], file["points"], file["configurations"]])
            np.testing.assert_array_equal(file["vertices"], path.vertices)
    else:
        found = np.concatenate(list(read_points(tmp_path / f"p{suffix}", ("x", "y"))))
        expected = expected[:, 1:3]
    np.testing.assert_array_equal(found, expected)


def test_plan_writes_a_path_and_a_recording(command, planar_roadmap, tmp_path):
    words = "plan r.grr --start 0.3 -0.2 --goal -0.2 0.3 --smooth --acceleration 4 --out p.csv --record p.rrd"
    code, shown, _ = command(*words.split(), "--json")
    assert code == 0
    data = json.loads(shown)
    table = np.genfromtxt(tmp_path / "p.csv", delimiter=",", names=True)
    assert table.dtype.names == ("time", "x", "y", *planar_roadmap.robot.joint_names)
    assert data["waypoints"] == len(table)
    assert data["duration"] == pytest.approx(table["time"][-1])
    assert (tmp_path / "p.rrd").stat().st_size > 10_000
    start, goal = (torch.tensor(point, dtype=torch.float64) for point in ([0.3, -0.2], [-0.2, 0.3]))
    path = planar_roadmap.plan(start, goal, smooth=True, acceleration_limits=4.0)
    assert data["joint_length"] == pytest.approx(path.joint_length)
    code, shown, _ = command(*words.split())
    assert code == 0
    assert "deviation" in shown


def test_no_path_is_exit_code_1_with_the_reason_and_no_file(command, tmp_path):
    words = "plan r.grr --start 0.3 -0.2 --goal 9 9 --out p.csv --record p.rrd"
    assert command(*words.split()) == (1, "", "no path: the goal cannot be solved: outside\n")
    code, shown, _ = command(*words.split(), "--json")
    assert code == 1
    assert json.loads(shown) == {"found": False, "reason": "the goal cannot be solved: outside"}
    assert [path.name for path in tmp_path.iterdir()] == ["r.grr"]


def test_a_recording_of_a_plan_has_all_its_parts(planar_roadmap, tmp_path):
    from test_recording import entities

    q = torch.full((5,), 0.8, dtype=torch.float64)
    path = planar_roadmap.plan(start_configuration=q, goal=torch.tensor([-0.2, 0.3], dtype=torch.float64))
    record_plan(planar_roadmap, path, tmp_path / "p.rrd")
    found = entities(tmp_path / "p.rrd")
    parts = ("way", "trace", "tool", "start", "goal", "used/vertices", "used/edges", "vertices", "edges")
    assert {f"/space/{part}" for part in parts} <= found
    assert {f"/joints/{name}" for name in planar_roadmap.robot.joint_names} <= found
    still = planar_roadmap.plan(path.points[-1], path.points[-1])
    record_plan(planar_roadmap, still, tmp_path / "still.rrd")
    assert (tmp_path / "still.rrd").stat().st_size > 0


def test_what_was_not_found_is_not_written(planar_roadmap, tmp_path):
    path = planar_roadmap.plan(torch.full((2,), 9.0), torch.zeros(2))
    for write in (save_path, record_plan):
        with pytest.raises(ParameterError, match="valid: one that was found"):
            write(planar_roadmap, path, tmp_path / "p.csv")
    assert not list(tmp_path.iterdir())


def test_names_are_exported():
    for name in ("Path", "Solution", "Teleoperator", "Command"):
        assert getattr(grr_torch, name).__name__ == name
