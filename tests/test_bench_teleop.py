from __future__ import annotations

import json
import sys

import numpy as np
import pytest
import torch
from grr_torch.cli.main import app
from typer.testing import CliRunner

from grr_torch.errors import FileFormatError, ParameterError, UnknownNameError
from grr_torch.experiments.metrics import measure
from grr_torch.experiments.paths import CLOSED, KINDS, draw_paths, read_paths
from grr_torch.experiments.teleoperation import MAX_STEP, aggregate, run_teleoperation, save_trajectories


@pytest.mark.parametrize("kind", KINDS)
def test_paths_are_what_their_names_say(planar_roadmap, kind):
    paths = draw_paths(planar_roadmap, kind, 20, waypoints=41)
    assert paths.shape == (20, 41, 2)
    assert torch.equal(paths, draw_paths(planar_roadmap, kind, 20, waypoints=41))
    assert not torch.equal(paths, draw_paths(planar_roadmap, kind, 20, waypoints=41, seed=1))
    if kind in CLOSED:
        assert torch.allclose(paths[:, 0], paths[:, -1])
        centre = 0.5 * (paths[:, 0] + paths[:, 20])
        radii = (paths - centre[:, None]).norm(dim=2)
        assert torch.allclose(radii, radii[:, :1].expand_as(radii))
    else:
        assert torch.allclose(paths.diff(n=2, dim=1), torch.zeros(1, dtype=torch.float64), atol=1e-12)
    if kind == "line_self":
        assert torch.allclose(paths[:, 0], -paths[:, -1])


def test_no_two_kinds_and_seeds_share_a_draw(planar_roadmap, monkeypatch):
    seen = []

    def circles(roadmap, kind, waypoints, generator):
        seen.append(generator.initial_seed())
        return torch.zeros(1, waypoints, 2)

    def ends(roadmap, kind, generator):
        return circles(roadmap, kind, 2, generator).unbind(1)

    monkeypatch.setattr("grr_torch.experiments.paths._circles", circles)
    monkeypatch.setattr("grr_torch.experiments.paths._ends", ends)
    for seed in (0, 1, 2, 3, 4, 2**63 - 1):
        for kind in KINDS:
            draw_paths(planar_roadmap, kind, 1, seed=seed)
    assert len(set(seen)) == len(seen)
    # the paths of the README
    assert seen[:4] == [0, 1, 2, 3]


def test_a_trajectory_on_its_path_has_no_deviation_and_one_beside_it_has(planar_roadmap):
    robot = planar_roadmap.robot
    q = torch.linspace(0.2, 0.8, 30, dtype=torch.float64)[:, None] * torch.ones(5, dtype=torch.float64)
    waypoints = robot.forward_kinematics(q)[0][:, :2]
    figures = measure(planar_roadmap, waypoints[None], q[None], 50.0, closed=True)
    assert float(figures.deviation) < 1e-12
    assert bool(figures.success)
    assert float(figures.closure) == pytest.approx(0.6)
    assert float(figures.joint_step) == pytest.approx(0.6 / 29)
    travelled = waypoints.diff(dim=0).norm(dim=1).sum()
    assert float(figures.smoothness) == pytest.approx(0.6 * 5**0.5 / float(travelled))
    beside = measure(planar_roadmap, waypoints[None] + torch.tensor([0.2, 0.0]), q[None], 50.0, closed=False)
    assert 0.0 < float(beside.deviation) <= 0.2
    assert not bool(beside.success)
    still = measure(planar_roadmap, waypoints[None], q[:1].expand(1, 30, 5), 50.0, closed=False)
    assert float(still.stall) > 0.3


def test_what_follows_the_end_does_not_count(planar_roadmap):
    q = planar_roadmap.robot.sample(30, torch.Generator().manual_seed(0))
    waypoints = planar_roadmap.robot.forward_kinematics(q)[0][None, :, :2]
    longer = torch.cat([q, torch.full((20, 5), torch.nan)])
    one, other = (measure(planar_roadmap, waypoints, t[None], 50.0, closed=True) for t in (q, longer))
    assert float(one.deviation) == float(other.deviation)
    assert float(one.smoothness) == float(other.smoothness)


def test_every_method_starts_alike_and_keeps_to_the_longest_step(planar_roadmap, tmp_path):
    paths = {"line_random": draw_paths(planar_roadmap, "line_random", 4, waypoints=60)}
    methods = ["expansion", "newton", "relaxed"]
    runs = run_teleoperation(planar_roadmap, paths=paths, methods=methods)
    assert [run.method for run in runs] == methods
    for run in runs:
        assert torch.equal(run.trajectories[:, 0], runs[0].trajectories[:, 0])
        assert float(run.figures.joint_step.max()) <= MAX_STEP * (1.0 + 1e-9)
    assert bool(runs[0].figures.success.all())
    save_trajectories(runs, tmp_path / "out.npz")
    with np.load(tmp_path / "out.npz", allow_pickle=False) as file:
        assert set(file) == {"line_random", *(f"{method}__line_random" for method in methods)}
        again = torch.from_numpy(file["newton__line_random"])
    recomputed = measure(planar_roadmap, paths["line_random"], again, 50.0, closed=False)
    assert torch.equal(recomputed.deviation, runs[1].figures.deviation)
    assert all(row["deviation_solved"] is None or row["deviation_solved"] >= 0.0 for row in aggregate(runs))


def test_repeated_waypoints_are_waited_at(planar_roadmap):
    point = draw_paths(planar_roadmap, "line_random", 1)[0, :1]
    (run,) = run_teleoperation(planar_roadmap, paths={"line_random": point.expand(1, 5, 2)}, methods=["expansion"])
    assert bool(run.figures.success)
    assert float(run.figures.joint_step) < 1e-6


def _npz(path, **arrays):
    np.savez(path, **arrays)
    return path


def test_bad_files_of_paths_are_refused(tmp_path):
    with pytest.raises(FileFormatError, match="does not exist"):
        read_paths(tmp_path / "none.npz", 3)
    (tmp_path / "empty.npz").touch()
    with pytest.raises(FileFormatError, match="cannot be read"):
        read_paths(tmp_path / "empty.npz", 3)
    with pytest.raises(UnknownNameError, match="line_random"):
        read_paths(_npz(tmp_path / "a.npz", line_rando=np.zeros((1, 2, 3))), 3)
    with pytest.raises(FileFormatError, match="shape"):
        read_paths(_npz(tmp_path / "b.npz", line_self=np.zeros((1, 2, 2))), 3)
    with pytest.raises(FileFormatError, match="finite"):
        read_paths(_npz(tmp_path / "c.npz", line_self=np.full((1, 2, 3), np.nan)), 3)
    with pytest.raises(FileFormatError, match="cannot be read"):
        read_paths(_npz(tmp_path / "d.npz", line_self=np.array([[[{}]]], dtype=object)), 3)


def test_paths_of_another_width_are_refused(planar_roadmap):
    with pytest.raises(ParameterError, match="line_self"):
        run_teleoperation(planar_roadmap, paths={"line_self": torch.zeros(1, 5, 3)}, methods=["expansion"])


@pytest.mark.parametrize("paths", [torch.zeros(0, 5, 2), torch.full((1, 5, 2), torch.nan)])
def test_no_path_and_nan_are_refused_before_the_work(planar_roadmap, paths):
    with pytest.raises(ParameterError, match="paths 'line_random': got (no path|NaN)"):
        run_teleoperation(planar_roadmap, paths={"line_random": paths}, methods=["random"])


def test_the_command_prints_a_table_and_json_and_writes_trajectories(planar_roadmap, tmp_path):
    file, out = tmp_path / "map.grr", tmp_path / "out.npz"
    planar_roadmap.save(file)
    paths = _npz(tmp_path / "p.npz", circle_out=draw_paths(planar_roadmap, "circle_out", 2, waypoints=40).numpy())
    arguments = [
        "bench",
        "teleop",
        str(file),
        "--paths",
        str(paths),
        "--methods",
        "expansion,newton",
        "--out",
        str(out),
    ]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "| circle_out | newton" in result.stdout
    with np.load(out, allow_pickle=False) as data:
        assert data["expansion__circle_out"].shape[::2] == (2, 5)
    result = CliRunner().invoke(app, [*arguments, "--json"])
    assert [run["method"] for run in json.loads(result.stdout)["runs"]] == ["expansion", "newton"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["none.grr"], "does not exist"),
        (["MAP", "--methods", "newtn"], "Did you mean 'newton'"),
        (["MAP", "--methods", ","], "--methods"),
        (["MAP", "--paths", "none.npz"], "does not exist"),
        (["MAP", "--out", "here.csv"], ".npz"),
        (["MAP", "--out", "no/folder/x.npz"], "does not exist"),
    ],
)
def test_mistakes_are_one_line(planar_roadmap, tmp_path, monkeypatch, arguments, complaint):
    monkeypatch.chdir(tmp_path)
    planar_roadmap.save("map.grr")
    words = ["map.grr" if word == "MAP" else word for word in arguments]
    result = CliRunner().invoke(app, ["bench", "teleop", *words])
    assert result.exit_code == 2
    assert complaint in result.stderr
    assert len(list(tmp_path.iterdir())) == 1


def test_a_misspelt_method_is_told_before_anything_is_built_or_missed(monkeypatch):
    monkeypatch.setitem(sys.modules, "dtw", None)
    monkeypatch.setattr("grr_torch.resolution.build.build", None)
    result = CliRunner().invoke(app, ["bench", "teleop", "--methods", "expansoin"])
    assert result.exit_code == 2
    assert "Did you mean 'expansion'?" in result.stderr
