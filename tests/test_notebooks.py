from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("*.ipynb"))


def _code(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def _errors(notebook):
    return [output for cell in _code(notebook) for output in cell.outputs if output.output_type == "error"]


def test_there_are_notebooks():
    assert {"01", "02", "03", "04", "05"} <= {path.name[:2] for path in NOTEBOOKS}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_stored_notebook_was_run_and_is_small(path):
    assert path.stat().st_size < 1_000_000
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    outputs = [output for cell in _code(notebook) for output in cell.outputs]
    assert [cell.execution_count for cell in _code(notebook)] == list(range(1, len(_code(notebook)) + 1))
    assert sum("image/png" in output.get("data", {}) for output in outputs) >= 2
    assert not _errors(notebook)
    assert not [output for output in outputs if output.get("name") == "stderr"]
    assert notebook.cells[0].cell_type == "markdown"
    assert "After this notebook you can" in notebook.cells[0].source


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_notebook_runs_from_top_to_bottom(path, monkeypatch, tmp_path):
    """At a reduced size; a cell that fails raises, and draws as many plots as are stored."""
    monkeypatch.setenv("GRR_NOTEBOOK_SIZE", "small")
    stored = nbformat.read(path, as_version=4)
    fresh = nbformat.from_dict(stored)
    for cell in _code(fresh):
        cell.outputs, cell.execution_count = [], None
    assert not [output for cell in _code(fresh) for output in cell.outputs]
    NotebookClient(fresh, timeout=120, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert not _errors(fresh)
    plots = [sum("image/png" in o.get("data", {}) for o in cell.outputs) for cell in _code(fresh)]
    stored = nbformat.read(path, as_version=4)
    assert plots == [sum("image/png" in o.get("data", {}) for o in cell.outputs) for cell in _code(stored)]
