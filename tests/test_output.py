"""Output files: written whole, or the old one stays as it is."""

from __future__ import annotations

import resource

import pytest

from grr_torch.errors import GrrError, OutputError
from grr_torch.output import atomic_write


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


def test_an_unwritable_output_is_a_clear_error(planar_roadmap, tmp_path):
    with pytest.raises(OutputError, match="does not exist"):
        planar_roadmap.save(tmp_path / "none" / "f.grr")
    with pytest.raises(OutputError, match="it is a folder"):
        planar_roadmap.save(tmp_path)
    assert issubclass(OutputError, GrrError)


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
