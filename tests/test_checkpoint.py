"""Checkpoints: a build that was killed ends with the same tensors, and nothing else is gone on from."""

from __future__ import annotations

import json
import random
import resource
import signal
import subprocess
import sys
import time

import pytest
import torch
from grr_torch.cli.main import app
from safetensors.torch import load_file, save_file
from typer.testing import CliRunner

import grr_torch
from grr_torch import output
from grr_torch.errors import FileFormatError, GrrWarning, OutputError, ParameterError
from grr_torch.resolution import checkpoint as checkpoints
from grr_torch.resolution.checkpoint import Checkpoint, Stage

TENSORS = ("points", "configurations", "resolved", "edges", "connected", "wave", "reachable")
# every stage has something to do
OPTIONS = {"points": 250, "seeds": "auto", "candidates": 12, "reachability": 8, "objectives": {"manipulability": 0.3}}


@pytest.fixture(autouse=True)
def written_at_once(monkeypatch):
    monkeypatch.setattr(checkpoints, "_INTERVAL", 0.0)
    monkeypatch.setattr(checkpoints, "_PATIENCE", 0.0)


@pytest.fixture(scope="module")
def undisturbed(planar_5):
    return grr_torch.build(planar_5, "position", **OPTIONS)


def equal(first, second, tensors=TENSORS):
    return all(torch.equal(getattr(first, t).nan_to_num(9.9), getattr(second, t).nan_to_num(9.9)) for t in tensors)


class Interrupted(Exception):
    pass


def interrupt_after(monkeypatch, writes):
    """Ends a build after so many files were written, as a kill would; returns the list of what was written."""
    written = []
    write = Checkpoint.write

    def counted(self, path, tensors):
        write(self, path, tensors)
        written.append(path.name)
        if len(written) == writes:
            raise Interrupted

    monkeypatch.setattr(Checkpoint, "write", counted)
    return written


def test_a_build_with_checkpoints_is_the_same(planar_5, undisturbed, tmp_path, monkeypatch):
    written = interrupt_after(monkeypatch, -1)
    roadmap = grr_torch.build(planar_5, "position", **OPTIONS, checkpoint=tmp_path / "new" / "c")
    assert equal(roadmap, undisturbed)
    stages = {name.split("-", 1)[1].removesuffix(".safetensors") for name in written}
    assert stages >= {"seeds", "expansion", "edges", "triangles", "repair", "relaxation", "spread", "reachability"}
    assert sorted(path.name for path in (tmp_path / "new" / "c").iterdir()) == ["build.json", "roadmap.grr"]


def test_interrupted_anywhere_it_ends_with_the_same_tensors(planar_5, undisturbed, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        written = interrupt_after(patch, -1)
        grr_torch.build(planar_5, "position", **OPTIONS, checkpoint=tmp_path / "whole")
    assert len(written) > 30
    for writes in random.Random(0).sample(range(1, len(written) + 1), 4):
        folder = tmp_path / str(writes)
        with monkeypatch.context() as patch:
            interrupt_after(patch, writes)
            with pytest.raises(Interrupted):
                grr_torch.build(planar_5, "position", **OPTIONS, checkpoint=folder)
        again = grr_torch.build(planar_5, "position", **OPTIONS, checkpoint=folder, resume=True)
        assert equal(again, undisturbed)
        assert again.build_seconds > 0.0


KILLED = """
import sys
import grr_torch
from grr_torch.resolution import checkpoint
checkpoint._INTERVAL = checkpoint._PATIENCE = 0.0
robot = grr_torch.load_robot("planar_5")
print("begins", flush=True)
grr_torch.build(robot, "position", points=900, checkpoint=sys.argv[1], resume=True).save(sys.argv[2])
"""


def test_killed_at_random_times_it_ends_with_the_same_tensors(planar_5, tmp_path):
    folder, out = tmp_path / "c", tmp_path / "map.grr"
    times, kills = random.Random(), 0
    for attempt in range(40):
        process = subprocess.Popen([sys.executable, "-P", "-c", KILLED, folder, out], stdout=subprocess.PIPE)
        process.stdout.readline()
        if attempt < 3:
            time.sleep(times.uniform(0.0, 1.0))
            process.send_signal(signal.SIGKILL)
        kills += process.wait() == -signal.SIGKILL
        if process.returncode == 0:
            break
    assert process.returncode == 0
    assert kills > 0
    undisturbed = grr_torch.build(planar_5, "position", points=900)
    assert equal(grr_torch.Roadmap.load(out), undisturbed, [name for name in TENSORS if name != "reachable"])
    assert not list(folder.glob(".*")), "what was half written is gone"


def test_a_finished_build_succeeds_at_once(planar_5, tmp_path, monkeypatch):
    first = grr_torch.build(planar_5, "position", points=150, checkpoint=tmp_path)
    monkeypatch.setattr("grr_torch.resolution.methods.expand", None)
    monkeypatch.setattr("grr_torch.resolution.cells.lead_to_centres", None)
    again = grr_torch.build(planar_5, "position", points=150, checkpoint=tmp_path, resume=True)
    assert torch.equal(again.configurations.nan_to_num(9.9), first.configurations.nan_to_num(9.9))
    assert again.quality() == first.quality()
    assert again.robot is planar_5


@pytest.mark.parametrize("present", [True, False])
def test_an_absent_or_empty_folder_starts_afresh(planar_5, tmp_path, present):
    folder = tmp_path / "c"
    if present:
        folder.mkdir()
        (folder / ".build.json.abc.partial.json").write_text("half")
    roadmap = grr_torch.build(planar_5, "position", points=100, refine=False, checkpoint=folder, resume=True)
    assert int(roadmap.resolved.sum()) > 50


@pytest.fixture
def interrupted(planar_5, tmp_path, monkeypatch):
    folder = tmp_path / "c"
    with monkeypatch.context() as patch:
        interrupt_after(patch, 12)
        with pytest.raises(Interrupted):
            grr_torch.build(planar_5, "position", points=200, checkpoint=folder)
    return folder


def test_a_checkpoint_is_not_overwritten_unasked(planar_5, interrupted):
    with pytest.raises(OutputError, match="not empty; valid: another folder, or --resume"):
        grr_torch.build(planar_5, "position", points=200, checkpoint=interrupted)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"points": 300}, "points"),
        ({"seed": 3}, r"seed \(0 there, 3 here\)"),
        ({"refine": False}, "refine"),
        ({"tolerances": grr_torch.Tolerances(position=1e-5)}, "tolerances"),
        ({"objectives": {"manipulability": 0.3}}, "objectives"),
        ({"task": "fixed-rotation"}, "task"),
        ({"seeds": [[0.0, 0.5, 0.5, 0.5, 0.5]]}, "seeds"),
    ],
)
def test_a_checkpoint_of_another_build_is_refused_by_name(planar_5, interrupted, options, named):
    given = {"task": "position", "points": 200, **options}
    with pytest.raises(FileFormatError, match=f"of another build: it differs in .*{named}"):
        grr_torch.build(planar_5, given.pop("task"), **given, checkpoint=interrupted, resume=True)


def test_a_checkpoint_of_another_arm_is_refused(interrupted):
    arm = grr_torch.load_robot("planar_5", held_joints={"joint_1": 0.2})
    seeds = [[0.5, 0.5, 0.5, 0.5]]
    with pytest.raises(FileFormatError, match="differs in arm"):
        grr_torch.build(arm, "position", points=200, seeds=seeds, checkpoint=interrupted, resume=True)


def damage(path, how):
    if how == "truncated":
        path.write_bytes(path.read_bytes()[:-50])
    elif how == "text":
        path.write_text("hello")
    else:
        tensors = load_file(path)
        name = next(name for name, tensor in tensors.items() if tensor.numel())
        tensors[name].view(-1)[0] = 0 if bool(tensors[name].view(-1)[0]) else 1
        save_file(tensors, path, metadata={"tensors_sha256": "{}", "seconds": "{}"})


@pytest.mark.parametrize("how", ["truncated", "text", "edited"])
def test_of_corrupt_files_an_older_one_is_used_with_a_warning(planar_5, interrupted, how):
    files = sorted(interrupted.glob("*.safetensors"))
    assert len(files) > 2
    damage(files[-1], how)
    with pytest.warns(GrrWarning, match=f"{files[-1].name}: .*; going on from {files[-2].name}"):
        again = grr_torch.build(planar_5, "position", points=200, checkpoint=interrupted, resume=True)
    plain = grr_torch.build(planar_5, "position", points=200)
    assert torch.equal(again.configurations.nan_to_num(9.9), plain.configurations.nan_to_num(9.9))


@pytest.mark.parametrize("how", ["truncated", "text", "edited"])
def test_a_corrupt_checkpoint_without_an_older_one_is_refused(planar_5, interrupted, how):
    first = min(interrupted.glob("*.safetensors"))
    damage(first, how)
    with pytest.raises(FileFormatError, match="nothing older is there to go on from") as caught:
        grr_torch.build(planar_5, "position", points=200, checkpoint=interrupted, resume=True)
    assert caught.value.path == first


@pytest.mark.parametrize("text", ["{", "3", "\x00"])
def test_a_corrupt_description_is_refused(planar_5, interrupted, text):
    (interrupted / "build.json").write_text(text)
    with pytest.raises(FileFormatError, match=r"build.json: "):
        grr_torch.build(planar_5, "position", points=200, checkpoint=interrupted, resume=True)


def test_a_corrupt_finished_roadmap_is_refused(planar_5, tmp_path):
    grr_torch.build(planar_5, "position", points=100, refine=False, checkpoint=tmp_path)
    path = tmp_path / "roadmap.grr"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match="corrupt: its tensors do not fit their SHA-256"):
        grr_torch.build(planar_5, "position", points=100, refine=False, checkpoint=tmp_path, resume=True)


def test_a_folder_with_other_files_is_refused(planar_5, tmp_path):
    (tmp_path / "thesis.tex").write_text("words")
    with pytest.raises(FileFormatError, match="holds other files, and no checkpoint"):
        grr_torch.build(planar_5, "position", points=100, checkpoint=tmp_path, resume=True)
    assert (tmp_path / "thesis.tex").read_text() == "words"


def test_no_space_left_is_a_clear_error_and_what_is_there_is_gone_on_from(planar_5, undisturbed, tmp_path):
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    # files may grow no longer than some of the stages' are
    resource.setrlimit(resource.RLIMIT_FSIZE, (24_000, limit[1]))
    try:
        with pytest.raises(OutputError, match=f"cannot write {tmp_path}/c/.*: "):
            grr_torch.build(planar_5, "position", **OPTIONS, checkpoint=tmp_path / "c")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert not list((tmp_path / "c").glob(".*"))
    again = grr_torch.build(planar_5, "position", **OPTIONS, checkpoint=tmp_path / "c", resume=True)
    assert equal(again, undisturbed)


@pytest.mark.skipif(output.fcntl is None, reason="no POSIX locks here")
def test_two_builds_do_not_share_a_folder(planar_5, tmp_path):
    refused = []
    options = {"points": 60, "checkpoint": tmp_path, "resume": True}

    def second(stage, done, total):
        if not refused:
            with pytest.raises(OutputError, match="another build is using it"):
                grr_torch.build(planar_5, **options)
            refused.append(stage)

    first = grr_torch.build(planar_5, **options, progress=second)
    assert refused
    assert torch.equal(grr_torch.build(planar_5, **options).connected, first.connected)


def test_resume_needs_a_checkpoint(planar_5):
    with pytest.raises(ParameterError, match=r"resume: got no checkpoint; valid: .*--checkpoint DIR"):
        grr_torch.build(planar_5, "position", points=100, resume=True)


def test_a_stage_is_written_at_most_every_few_seconds(tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoints, "_INTERVAL", 1000.0)
    stage = Checkpoint(tmp_path, {}).stage("long")
    assert isinstance(stage, Stage)
    for done in range(5):
        stage.keep({"done": torch.tensor(done)})
    assert not stage.path.exists()
    stage.keep({"done": torch.tensor(5)}, last=True)
    assert int(load_file(stage.path)["done"]) == 5


def test_the_command_goes_on_and_says_what_is_wrong(tmp_path):
    options = ["build", "--robot", "planar_5", "--task", "position", "--points", "120", "--no-record", "--json"]
    options += ["--checkpoint", str(tmp_path / "c"), "--out", str(tmp_path / "f.grr")]
    first = CliRunner().invoke(app, options)
    assert first.exit_code == 0, first.output
    again = CliRunner().invoke(app, [*options, "--resume"])
    assert again.exit_code == 0, again.output
    assert json.loads(again.stdout) == json.loads(first.stdout)
    for wrong in (options, [*options, "--resume", "--seed", "4"]):
        refused = CliRunner().invoke(app, wrong)
        assert refused.exit_code == 2
        assert "error: " in refused.output
        assert "Traceback" not in refused.output
