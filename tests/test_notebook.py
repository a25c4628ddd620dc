"""agents/examples/first_policy.ipynb: fast checks of its code. `make test-slow` executes it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).resolve().parents[1] / "agents" / "examples" / "first_policy.ipynb"
PATIENCE = 1200
"""Longest wait for a cell, as the first one of a new installation compiles [s]."""


@pytest.mark.slow
@pytest.mark.xdist_group(__name__)
def test_notebook_trains_a_policy_that_drives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import nbformat
    from nbclient import NotebookClient

    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    where = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=PATIENCE, resources=where).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    text = "".join(output.get("text", "") for output in outputs)
    reached = re.search(r"(\d+) of 50 goals reached", text)
    assert reached is not None
    assert int(reached[1]) >= 45
    pages = "".join(output.get("data", {}).get("text/html", "") for output in outputs)
    assert "data:image/gif;base64,R0lGOD" in pages
    assert (tmp_path / "first.onnx").exists()
