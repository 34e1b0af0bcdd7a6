"""Tables: what is written is read back, however it is cut, and what people write is understood."""

from __future__ import annotations

import re

import numpy as np
import pytest
from grr_torch.cli.show import show_table

from grr_torch.errors import FileFormatError
from grr_torch.tables import read_points, table_writer, unique_names


@pytest.mark.parametrize(
    "text",
    [
        "\n\n x ; y ; z\n0.25;-0.5;7\n",
        "0.25\t-0.5\n\n",
        "\ufeff0.25,-5e-1",
        '"y","x"\r\n-0.5,0.25\r\n',
        "y,x,name\n-0.5,0.25,a\n",
    ],
)
def test_csv_files_are_read_as_people_write_them(tmp_path, text):
    (tmp_path / "p.csv").write_text(text, encoding="utf-8", newline="")
    (piece,) = read_points(tmp_path / "p.csv", 2)
    np.testing.assert_array_equal(piece, [[0.25, -0.5]])


@pytest.mark.parametrize("suffix", [".csv", ".npy", ".parquet"])
def test_tables_read_back_what_was_written_in_any_pieces(tmp_path, suffix):
    generator = np.random.default_rng(1)
    values = generator.standard_normal((40_000, 3)) * 10.0 ** generator.integers(-9, 9, (40_000, 3))
    cuts = np.sort(generator.integers(1, len(values), 5))
    file = tmp_path / f"t{suffix}"
    with table_writer(file, {"points": ["x", "y", "z"], "status": ["a, b"]}, len(values)) as write:
        for part in np.split(values, cuts):
            write({"points": part, "status": np.full(len(part), "too far")})
    pieces = list(read_points(file, 3))
    assert len(pieces) > 1
    np.testing.assert_array_equal(np.concatenate(pieces), values)


def write_and_stop(path):
    with table_writer(path, {"points": ["x", "y"]}, 10) as write:
        write({"points": np.zeros((5, 2))})
        raise RuntimeError("stop")


def test_a_table_that_fails_half_way_leaves_nothing(tmp_path):
    for suffix in (".csv", ".npy", ".npz", ".parquet"):
        with pytest.raises(RuntimeError, match="stop"):
            write_and_stop(tmp_path / f"t{suffix}")
    assert not list(tmp_path.iterdir())


def test_a_joint_named_like_a_coordinate_gets_a_column_of_its_own():
    assert unique_names(("x", "turn"), ("x", "y")) == ["joint x", "joint turn"]
    assert unique_names(("a", "b"), ("x", "y")) == ["a", "b"]


def test_points_of_a_file_must_be_there(tmp_path):
    with pytest.raises(FileFormatError, match="is not a file"):
        next(read_points(tmp_path / "p.csv", 2))


@pytest.mark.parametrize("terminal", [True, False])
def test_shown_tables_fit_a_terminal_and_are_markdown_elsewhere(monkeypatch, capsys, terminal):
    for name in ("NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("FORCE_COLOR" if terminal else "NO_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "80")
    figures = [f"0.{digit}{digit}{digit}{digit}{digit}" for digit in range(10)]
    show_table([f"figure {k}" for k in range(10)], [figures])
    whole = re.sub("\x1b\\[[0-9;]*m", "", capsys.readouterr().out)
    assert all(whole.count(str(digit)) >= 5 for digit in range(10))
    monkeypatch.setenv("COLUMNS", "40")
    show_table(["problem", "share [%]"], [["planar_5 fixed-rotation, refined", "99.5"], ["[b]", "1"]])
    lines = re.sub("\x1b\\[[0-9;]*m", "", capsys.readouterr().out).splitlines()
    text = "".join("".join(lines).split())
    assert "[b]" in text
    assert "99.5" in text
    if terminal:
        assert max(map(len, lines)) <= 40
    else:
        assert lines[0] == "| problem                          | share [%] |"
        assert set(lines[1]) == set("|- ")
