"""Sweeps: what their files may say, what is built, and the catalogue, which is what the files are."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pyarrow import parquet
from random_robots import BOX_ARM

import grr_torch
from grr_torch.errors import FileFormatError, GrrWarning, OutputError, UnknownNameError
from grr_torch.fleet.catalogue import best, read_catalogue
from grr_torch.fleet.run import LocalEngine, run_sweep
from grr_torch.fleet.sweep import read_sweep
from grr_torch.fleet.work import make_roadmap

SMALL = "defaults: {robot: planar_5, points: 60, refine: false}\n"
FLEET = SMALL + "grid: {seed: [0, 1]}\nbuilds: [{robot: planar_3, bounds: [[8, 9], [8, 9]]}, {task: fixed-rotation}]\n"


def orders_of(tmp_path, text):
    path = tmp_path / "sweep.yaml"
    path.write_text(text)
    return read_sweep(path)


def one_hash(tmp_path, text):
    (order,) = orders_of(tmp_path, f"builds: [{{robot: planar_5, {text}}}]")
    return order.hash


def stamps(folder):
    return {path.name: path.stat().st_mtime_ns for path in folder.glob("[!.]*.grr")}


def test_a_grid_gives_every_combination_and_a_list_its_builds(tmp_path):
    text = "grid: {seed: [3, 4], task: [position, fixed-rotation]}\nbuilds: [{points: 70}]\nneeds: {memory: 2}"
    orders = orders_of(tmp_path, f"defaults: {{robot: planar_5}}\n{text}")
    assert [(order.options.get("seed"), order.task) for order in orders] == [
        (3, "position"), (3, "fixed-rotation"), (4, "position"), (4, "fixed-rotation"), (None, "position"),
    ]  # fmt: skip
    assert {order.needs.memory for order in orders} == {2}
    assert len({order.hash for order in orders}) == 5


@pytest.mark.parametrize(
    "same", ["seed: 0", "refine: true", "task: position", "reachability: 0", "objectives: null", "tool: tool"]
)
def test_what_is_said_but_holds_anyway_does_not_change_the_hash(tmp_path, planar_5, same):
    same = same.replace("tool: tool", f"tool: {planar_5.tool}")
    assert one_hash(tmp_path, same) == one_hash(tmp_path, "points: null")


def test_what_determines_a_roadmap_changes_the_hash(tmp_path):
    said = [
        "seed: 0", "seed: 1", "points: 70", "task: fixed-rotation", "task: fixed-rotation, rotation: [0, 0, 1]",
        "refine: false", "objectives: {manipulability: 1}", "objectives: {manipulability: 2}", "tool: link_3",
        "held_joints: {joint_2: 0.1}",
        "seeds: auto", "seeds: [[0, 0.1, 0.1, 0.1, 0.1]]", "bounds: [[0, 0.2], [0, 0.2]]", "device: cuda",
    ]  # fmt: skip
    assert len({one_hash(tmp_path, text) for text in said}) == len(said)


def test_a_sweep_can_ask_for_no_bound_of_slopes(tmp_path):
    orders = orders_of(tmp_path, "defaults: {robot: kinova}\ngrid: {max_slope: [null, .inf, 12]}")
    assert [order.options.get("max_slope") for order in orders] == [None, float("inf"), 12.0]
    assert len({order.hash for order in orders}) == 3


def test_files_count_by_what_is_in_them(tmp_path):
    for name in ("a", "b", "c"):
        (tmp_path / f"{name}.urdf").write_text(BOX_ARM if name != "c" else BOX_ARM.replace("0.3", "0.31"))
    (tmp_path / "seeds.csv").write_text("0.1, 1.0, 0.5\n")
    more = "task: position, tool: tip, base: base, points: 50, bounds: [[0, 1], [0, 1], [0, 1]]"
    hashes = {}
    for name in ("a", "b", "c"):
        for seeds in ("seeds.csv", "[[0.1, 1, 0.5]]", "[[0.1, 1, 0.6]]"):
            (order,) = orders_of(tmp_path, f"builds: [{{robot: {name}.urdf, seeds: {seeds}, {more}}}]")
            hashes[name, seeds] = order.hash
    assert hashes["a", "seeds.csv"] == hashes["a", "[[0.1, 1, 0.5]]"] == hashes["b", "seeds.csv"]
    assert len(set(hashes.values())) == 4


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("builds: [{robot: planar_5, poins: 60}]", "of a build 'poins'. Did you mean 'points'?"),
        ("defaults: {robbot: planar_5}\ngrid: {seed: [1]}", "defaults: unknown option of a build 'robbot'"),
        ("build: [{robot: planar_5}]", "unknown part of a sweep 'build'. Did you mean 'builds'?"),
        ("builds: [{robot: planar_6}]", "unknown robot 'planar_6'. Did you mean 'planar_5'?"),
        ("builds: [{robot: none.urdf}]", "none.urdf: cannot be read"),
        ("builds: [{seed: 1}]", "build 1: robot: got nothing"),
        ("builds: [{robot: planar_5, needs: {gpu: 1}}]", "unknown need 'gpu'. Did you mean 'gpus'?"),
        ("builds: [{robot: planar_5, needs: {cpus: 0}}]", "needs: cpus: got 0"),
        ("builds: [{robot: planar_5, points: many}]", "points: got 'many'; valid: a whole number, or null"),
        ("builds: [{robot: planar_5, points: true}]", "points: got True"),
        ("builds: [{robot: planar_5, margin: .nan}]", "margin: got nan"),
        ("builds: [{robot: planar_5, bounds: [[0, 1, 2], [0, 1]]}]", "bounds: got"),
        ("builds: [{robot: planar_5, objectives: {clearance: a}}]", "objectives: got"),
        ("builds: [{robot: planar_5, objectives: {clearance: -1}}]", "weight of clearance: got -1"),
        ("builds: [{robot: planar_5, points: 0}]", "points: got 0; valid: a whole number from 1"),
        ("builds: [{robot: planar_5, seed: -1}]", "seed: got -1"),
        ("builds: [{robot: planar_5, candidates: 0}]", "candidates: got 0"),
        ("builds: [{robot: planar_5, samples: 0}]", "samples: got 0"),
        ("builds: [{robot: planar_5, reachability: -1}]", "reachability: got -1"),
        ("builds: [{robot: planar_5, method: expand}]", "Did you mean 'expansion'?"),
        ("builds: [{robot: planar_5, task: pose, neighbours: 4}]", "neighbours: got 4; valid: 1 to 3 edges"),
        ("builds: [{robot: planar_5, task: pose, rotations: 0}]", "rotations: got 0"),
        ("builds: [{robot: planar_5, task: position, rotations: 3}]", "rotations: got 3; valid: none"),
        ("builds: [{robot: planar_5, bounds: [[1, 0], [0, 1]]}]", "bounds: got ((1.0, 0.0), (0.0, 1.0))"),
        ("builds: [{robot: planar_5, seeds: [[0, 0]]}]", "seeds have shape (1, 2)"),
        ("builds: [{robot: planar_5, task: rotate}]", "Did you mean 'fixed-rotation'?"),
        ("builds: [{robot: planar_5, task: position, rotation: [0, 0, 1]}]", "none for the task 'position'"),
        ("builds: [{robot: planar_5, seeds: none.csv}]", "none.csv: does not exist"),
        ("builds: [{robot: planar_5}, {robot: planar_5, seed: 0}]", "build 2 and build 1 are the same roadmap"),
        ("defaults: {robot: planar_5}\ngrid: {seed: [0, 1, 0]}", "grid (seed: 0) and grid (seed: 0) are the same"),
        ("builds: [{robot: planar_5}, {robot: planar_5, needs: {cpus: 2}}]", "contradict each other"),
        ("builds: [{robot: planar_5, seed: 1, seed: 2}]", "'seed' is given twice"),
        ("defaults: {robot: planar_5, seed: 1}\ngrid: {seed: [1, 2]}", "'seed' is in defaults and in grid"),
        ("grid: {robot: planar_5}", "grid: robot: got 'planar_5'; valid: a list"),
        ("builds: {robot: planar_5}", "builds: got"),
        ("defaults: [robot]", "defaults: got"),
        ("- robot", "is not a sweep"),
        ("builds: [", "is not YAML"),
        ("builds: [!!python/object/apply:os.getcwd []]", "is not YAML"),
        ("{1: 2}", "1 is no name"),
        ("grid: !!map [1, 2]", "is not YAML"),
        ("defaults: {refine: !!bool maybe}", "is not YAML"),
        ("[" * 3000, "is not YAML"),
        (f"builds: [{{robot: planar_5, seed: {'9' * 401}}}]", "seed: got 999"),
        ("builds: [{robot: planar_5, margin: .inf}]", "margin: got inf"),
        ("builds: [{robot: planar_5, needs: {gpus: 1.5}}]", "needs: gpus: got 1.5; valid: 0, a share of one"),
        ("builds: [{robot: planar_5, needs: {gpus: 0.00001}}]", "needs: gpus: got 1e-05"),
        ("", "is not a sweep"),
        ("defaults: {robot: planar_5}", "asks for 0 builds"),
        (f"grid: {{seed: {list(range(400))}, points: {list(range(400))}}}", "asks for 160,000 builds"),
    ],
)  # fmt: skip
def test_a_mistake_in_a_sweep_is_named_with_its_place(tmp_path, text, complaint):
    with pytest.raises(FileFormatError) as raised:
        orders_of(tmp_path, text)
    assert complaint in str(raised.value)
    assert str(raised.value).startswith(f"{tmp_path / 'sweep.yaml'}: ")
    assert "\n" not in str(raised.value)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fleet")
    orders = orders_of(folder, FLEET)
    told = []
    rows = run_sweep(orders, folder / "out", LocalEngine(), told=lambda order, error: told.append((order, error)))
    return folder / "out", orders, rows, told


def test_a_failing_build_is_reported_and_the_rest_goes_on(fleet):
    _, orders, rows, told = fleet
    assert [order for order, _ in told] == list(orders)
    assert [error is None for _, error in told] == [True, True, False, True]
    by_hash = {row["hash"]: row for row in rows}
    assert [by_hash[order.hash]["status"] for order in orders] == ["done", "done", "failed", "done"]
    assert "no point within reach" in by_hash[orders[2].hash]["error"]
    assert by_hash[orders[2].hash]["smoothness"] is None


def test_a_file_of_a_fleet_is_what_build_makes(fleet, planar_5):
    folder, orders, _, _ = fleet
    found = grr_torch.Roadmap.load(folder / f"{orders[1].hash}.grr")
    alone = grr_torch.build(planar_5, points=60, refine=False, seed=1)
    for name in ("points", "configurations", "resolved", "edges", "connected", "wave"):
        torch.testing.assert_close(getattr(found, name), getattr(alone, name), rtol=0, atol=0, equal_nan=True)


def test_the_catalogue_is_what_the_files_say(fleet):
    folder, _, rows, _ = fleet
    table = {row["hash"]: row for row in parquet.read_table(folder / "catalogue.parquet").to_pylist()}
    assert set(table) == {row["hash"] for row in rows}
    for row in rows:
        stored = table[row["hash"]]
        assert (stored["points"], stored["status"], stored["error"]) == (60, row["status"], row["error"])
        if row["status"] == "done":
            quality = grr_torch.Roadmap.load(folder / row["file"]).quality().to_dict()
            assert {name: stored[name] for name in quality} == pytest.approx(quality)
            assert 0.0 < stored["build_seconds"] < stored["seconds"]
            assert stored["peak_memory_mib"] > 10.0


def test_a_second_run_does_only_what_is_missing(fleet, tmp_path):
    folder, orders, _, _ = fleet
    copy = tmp_path / "copy"
    copy.mkdir()
    for path in folder.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    gone, truncated = orders[0].path(copy), orders[1].path(copy)
    gone.unlink()
    truncated.write_bytes(truncated.read_bytes()[:-100])
    (copy / f".{gone.name}.x.partial.grr").touch()
    (copy / f".{gone.stem}.failed.json.x.partial.json").touch()
    assert {row["hash"] for row in read_catalogue_quietly(copy)} == {order.hash for order in orders[2:]}
    before, done = stamps(copy), []
    within_reach = replace(orders[2], options={**orders[2].options, "bounds": [[0.0, 0.2], [0.0, 0.2]]})
    with pytest.warns(GrrWarning, match="is built again"):
        rows = run_sweep(
            [*orders[:2], within_reach, orders[3]],
            copy,
            LocalEngine(),
            told=lambda order, error: done.append(order.hash),
        )
    assert done == [order.hash for order in orders[:3]]
    assert stamps(copy)[orders[3].path(copy).name] == before[orders[3].path(copy).name]
    assert {row["status"] for row in rows} == {"done"}
    assert not list(copy.glob("*.failed.json"))
    assert not list(copy.glob(".*partial*"))


def read_catalogue_quietly(folder):
    with pytest.warns(GrrWarning, match="left out of the catalogue") as warned:
        rows = read_catalogue(folder)
    assert len(warned) == 1  # what is half written is not a file of the fleet's yet
    return rows


def test_two_sweeps_in_one_folder_exclude_each_other(fleet, tmp_path):
    _, orders, _, _ = fleet

    def second(order, folder, progress):
        run_sweep([order], folder, LocalEngine())

    rows = run_sweep(orders[:1], tmp_path, LocalEngine(second))
    assert "another sweep is using it" in rows[0]["error"]
    with pytest.raises(OutputError, match="cannot write"):
        run_sweep(orders[:1], tmp_path / "catalogue.parquet" / "under a file", LocalEngine())


def test_an_interrupt_leaves_what_is_done_and_a_true_catalogue(fleet, tmp_path):
    _, orders, _, _ = fleet

    def until_the_second(order, folder, progress):
        if order == orders[1]:
            raise KeyboardInterrupt
        make_roadmap(order, folder, progress)

    with pytest.raises(KeyboardInterrupt):
        run_sweep(orders, tmp_path, LocalEngine(until_the_second))
    assert [row["hash"] for row in parquet.read_table(tmp_path / "catalogue.parquet").to_pylist()] == [orders[0].hash]


@given(st.lists(st.tuples(st.sampled_from("abc"), st.one_of(st.none(), st.floats(0, 9))), max_size=12), st.booleans())
def test_the_best_is_the_best_of_its_group(entries, more):
    figure = "coverage" if more else "smoothness"
    rows = [{"hash": str(k), "orientation": group, figure: value} for k, (group, value) in enumerate(entries)]
    found = {row["orientation"]: row[figure] for row in best(rows, figure, ["orientation"] if rows else [])}
    for group in "abc":
        values = [value for name, value in entries if name == group and value is not None]
        assert found.get(group) == ((max if more else min)(values) if values else None)


def test_unknown_figures_and_columns_are_refused(fleet):
    with pytest.raises(UnknownNameError, match="Did you mean 'smoothness'"):
        best(fleet[2], "smothness")
    with pytest.raises(UnknownNameError, match="Did you mean 'orientation'"):
        best(fleet[2], "smoothness", ["orientaton"])
