"""Tables: what is written is read back, however it is cut, and what people write is understood."""

from __future__ import annotations

import re

import numpy as np
import pyarrow
import pytest
from grr_torch.cli.show import show_table
from pyarrow import parquet

from grr_torch.errors import FileFormatError, ParameterError
from grr_torch.resolution.seeds import read_seeds
from grr_torch.tables import read_points, table_writer, unique_names
from grr_torch.tensor_file import stream_tensors


@pytest.mark.parametrize(
    "text",
    [
        "\n\n x ; y ; z\n0.25;-0.5;7\n",
        "0.25\t-0.5\n\n",
        "\ufeff0.25,-5e-1",
        '"y","x"\r\n-0.5,0.25\r\n',
        "y,x,name\n-0.5,0.25,a\n",
        "Y,X,Z\n-0.5,0.25,7\n",
        "X,x,y\n7,0.25,-0.5\n",
        "left,right\n0.25,-0.5\n",
        "# x y\n\n  0.25   -0.5  # the only one\n",
        "x y # in metres\n0.25\t-0.5\n#",
        'name,y,x\n"a # b",-0.5,0.25\n',
    ],
)
def test_csv_files_are_read_as_people_write_them(tmp_path, text):
    (tmp_path / "p.csv").write_text(text, encoding="utf-8", newline="")
    (piece,) = read_points(tmp_path / "p.csv", ("x", "y"))
    np.testing.assert_array_equal(piece, [[0.25, -0.5]])


@pytest.mark.parametrize("header", ["z,y", "x,right", "left,Y,right", "X,X,y", "x,y,y"])
def test_columns_of_which_only_some_are_named_like_coordinates_are_not_guessed(tmp_path, header):
    (tmp_path / "p.csv").write_text(f"{header}\n{','.join('1' for _ in header.split(','))}\n")
    names = header.replace(",", ", ")
    with pytest.raises(FileFormatError, match=f"has columns named {names}; valid: each of x, y once, or none of them"):
        list(read_points(tmp_path / "p.csv", ("x", "y")))


def test_columns_are_found_by_name_in_every_kind_of_file(tmp_path):
    values = np.random.default_rng(1).standard_normal((7, 3))
    for suffix in (".csv", ".npy", ".parquet"):
        file = tmp_path / f"t{suffix}"
        with table_writer(file, {"q": ["B", "note #1", "A"]}, 7) as write:
            write({"q": values})
        (piece,) = read_points(file, ("a", "b"))
        np.testing.assert_array_equal(piece, values[:, [2, 0]])
        with pytest.raises(FileFormatError, match="has columns named B, note #1, A; valid: each of a, c once"):
            list(read_points(file, ("a", "c")))


@pytest.mark.parametrize("first", ["0.1,O.2", "0.1,NA", "a,0.2", "0.1,"])
def test_a_first_row_with_a_bad_value_is_no_header(tmp_path, first):
    (tmp_path / "p.csv").write_text(f"{first}\n0.3,0.4\n")
    with pytest.raises(FileFormatError, match="row 1 holds"):
        list(read_points(tmp_path / "p.csv", ("x", "y")))


def test_a_parquet_file_whose_columns_share_a_name_is_refused(tmp_path):
    columns = [pyarrow.array([0.1, 0.2]), pyarrow.array([0.3, 0.4])]
    parquet.write_table(pyarrow.Table.from_arrays(columns, names=["a", "a"]), tmp_path / "p.parquet")
    with pytest.raises(FileFormatError, match="has columns named a, a; valid: names that differ"):
        list(read_points(tmp_path / "p.parquet", ("x", "y")))


def test_what_is_wrong_is_said_wherever_in_a_long_file_it_is(tmp_path):
    (tmp_path / "p.csv").write_text("x,y\n" + "0.123456,0.654321\n" * 200_000 + "# two more\n1,2\n3,\n")
    with pytest.raises(FileFormatError, match="row 200002 holds NaN, infinite or missing"):
        list(read_points(tmp_path / "p.csv", ("x", "y")))


def test_seeds_are_read_as_points_are(tmp_path):
    table = np.array([[0.1, 0.2, 0.3], [1.0, 1.1, 1.2]])
    with (tmp_path / "s.NPY").open("wb") as file:
        np.save(file, table)
    texts = {
        "a.csv": "# two\n0.1; 0.2; 0.3\n\n1;1.1;1.2\n",
        "b.txt": "0.1 0.2 0.3\n1, 1.1, 1.2 # the last\n",
        "c.csv": "one,TWO,three,time\n0.1,0.2,0.3,0\n1,1.1,1.2,1\n",
        "d": "three two one\n0.3 0.2 0.1\n1.2 1.1 1\n",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    with table_writer(tmp_path / "e.parquet", {"q": ["one", "two", "three"]}, 2) as write:
        write({"q": table})
    for name in ("s.NPY", "e.parquet", *texts):
        assert read_seeds(tmp_path / name, ("one", "two", "three")).tolist() == table.tolist()
    for name in ("s.NPY", "a.csv", "b.txt"):
        assert read_seeds(tmp_path / name).tolist() == table.tolist()
    for name in ("c.csv", "d", "e.parquet"):
        with pytest.raises(FileFormatError, match="has columns named .*; valid: rows of numbers, without a header"):
            read_seeds(tmp_path / name)


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY\x01\x00", b"PK\x05\x06" + bytes(18), b"PK\x03\x04"])
def test_what_is_no_array_is_a_clear_error(tmp_path, content):
    (tmp_path / "p.npy").write_bytes(content)
    with pytest.raises(FileFormatError, match="is not a table of numbers: .|holds several arrays"):
        list(read_points(tmp_path / "p.npy", ("x", "y")))


@pytest.mark.parametrize("suffix", [".csv", ".npy", ".parquet"])
def test_tables_read_back_what_was_written_in_any_pieces(tmp_path, suffix):
    generator = np.random.default_rng(1)
    values = generator.standard_normal((40_000, 3)) * 10.0 ** generator.integers(-9, 9, (40_000, 3))
    cuts = np.sort(generator.integers(1, len(values), 5))
    file = tmp_path / f"t{suffix}"
    with table_writer(file, {"points": ["x", "y", "z"], "status": ["a, b"]}, len(values)) as write:
        for part in np.split(values, cuts):
            write({"points": part, "status": np.full(len(part), "too far")})
    pieces = list(read_points(file, ("x", "y", "z")))
    assert len(pieces) > 1
    np.testing.assert_array_equal(np.concatenate(pieces), values)


def write_and_stop(path):
    with table_writer(path, {"points": ["x", "y"]}, 10) as write:
        write({"points": np.zeros((5, 2))})
        raise RuntimeError("stop")


def write_parts(path, *sizes):
    with table_writer(path, {"points": ["x", "y"]}, 10) as write:
        for size in sizes:
            write({"points": np.zeros((size, 2))})


@pytest.mark.parametrize("suffix", [".csv", ".npy", ".npz", ".parquet"])
def test_a_table_that_fails_half_way_leaves_nothing(tmp_path, suffix):
    with pytest.raises(RuntimeError, match="stop"):
        write_and_stop(tmp_path / f"t{suffix}")
    for sizes in ((), (5,), (5, 4), (5, 6), (11,), (10, 1)):
        with pytest.raises(ParameterError, match=f"rows of a table: got {sum(sizes)}.*; valid: 10"):
            write_parts(tmp_path / f"t{suffix}", *sizes)
    with pytest.raises(ParameterError, match="rows of a table: got 0"), table_writer(tmp_path / f"t{suffix}", {}, 0):
        pass
    assert not list(tmp_path.iterdir())
    write_parts(tmp_path / f"t{suffix}", 5, 5)
    assert len(list(tmp_path.iterdir())) == 1


def test_arrays_of_a_table_have_equally_many_rows(tmp_path):
    columns = {"points": ["x"], "valid": ["valid"]}
    arrays = {"points": np.zeros((5, 1)), "valid": np.zeros(4, dtype=bool)}
    with pytest.raises(ParameterError, match=r"got \[4, 5\]"), table_writer(tmp_path / "t.npy", columns, 5) as write:
        write(arrays)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("size", [0, 4, 6])
def test_tensors_that_are_streamed_are_counted(tmp_path, size):
    file = tmp_path / "t.safetensors"
    with pytest.raises(ParameterError, match=f"got {size}.*; valid: 5"), stream_tensors(file, 5, {}) as write:
        write({"points": np.zeros((size, 2))})


def test_a_joint_named_like_a_coordinate_gets_a_column_of_its_own():
    assert unique_names(("x", "turn"), ("x", "y")) == ["joint x", "joint turn"]
    assert unique_names(("a", "b"), ("x", "y")) == ["a", "b"]


def test_points_of_a_file_must_be_there(tmp_path):
    with pytest.raises(FileFormatError, match="does not exist"):
        next(read_points(tmp_path / "p.csv", ("x", "y")))


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
