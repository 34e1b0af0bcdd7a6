"""Output files: written whole, or the old one stays as it is."""

from __future__ import annotations

import resource

import pytest

from grr_torch.errors import GrrError, OutputError, ParameterError
from grr_torch.output import atomic_write, check_outputs, remove_partial


def interrupt(temporary, error):
    temporary.write_text("half")
    raise error


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "f.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), atomic_write(path) as temporary:
        interrupt(temporary, RuntimeError())
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_an_interrupted_write_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), atomic_write(tmp_path / "f.txt") as temporary:
        interrupt(temporary, KeyboardInterrupt())
    assert not list(tmp_path.iterdir())


def test_an_error_of_who_writes_names_the_file_itself(tmp_path):
    path = tmp_path / "file.onnx"
    with pytest.raises(OutputError, match="apart") as refused, atomic_write(path) as outer, atomic_write(outer):
        raise OutputError(outer, "what was written is apart from what was to be")
    assert refused.value.path == path
    assert str(path) in str(refused.value)
    assert list(tmp_path.iterdir()) == []


def test_no_file_is_written_over_another(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    read = tmp_path / "read.txt"
    read.touch()
    (tmp_path / "link.txt").symlink_to(read)
    check_outputs({"--out": tmp_path / "new.txt", "--record": None, "--json": "other.txt"}, [read, None, "no file"])
    for same in (read, "read.txt", "./read.txt", "link.txt"):
        with pytest.raises(ParameterError, match="--out: got .*; valid: another file than those that are read"):
            check_outputs({"--out": same}, [read])
    with pytest.raises(ParameterError, match="--json: got .*; valid: another file than that of --out"):
        check_outputs({"--out": tmp_path / "new.txt", "--json": "new.txt"})
    with pytest.raises(OutputError, match="it is a folder"):
        check_outputs({"--out": tmp_path})
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    check_outputs({"--out": tmp_path / "f.txt", "--record": tmp_path / "a"}, [tmp_path / "b", 300 * "x"])


def test_an_unwritable_output_is_a_clear_error(planar_roadmap, tmp_path):
    with pytest.raises(OutputError, match="does not exist"):
        planar_roadmap.save(tmp_path / "none" / "f.grr")
    with pytest.raises(OutputError, match="it is a folder"):
        planar_roadmap.save(tmp_path)
    assert issubclass(OutputError, GrrError)


def test_what_cannot_be_written_is_known_before_the_work(tmp_path):
    with pytest.raises(OutputError, match="File name too long"):
        check_outputs({"--out": tmp_path / (240 * "b" + ".csv")})
    (tmp_path / "link.csv").symlink_to(tmp_path / "none" / "file.csv")
    with pytest.raises(OutputError, match="folder '.*none' does not exist"):
        check_outputs({"--out": tmp_path / "link.csv"})
    with pytest.raises(OutputError, match="File name too long"), atomic_write(tmp_path / (240 * "b")):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["link.csv"]


def test_what_was_left_half_written_is_removed(tmp_path):
    (tmp_path / ".map.grr.abc.partial.grr").write_text("half")
    (tmp_path / ".arrays.abc.partial.npz").mkdir()
    (tmp_path / ".arrays.abc.partial.npz" / "q.npy").write_text("half")
    (tmp_path / "map.grr").write_text("whole")
    remove_partial(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["map.grr"]


def test_a_full_disk_is_a_clear_error_and_leaves_the_old_file(planar_roadmap, tmp_path):
    saved = tmp_path / "map.grr"
    planar_roadmap.save(saved)
    before = saved.read_bytes()
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, limit[1]))
    try:
        with pytest.raises(OutputError, match=f"cannot write {saved}: "):
            planar_roadmap.save(saved)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]
