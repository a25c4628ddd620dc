"""agents/examples/first_policy.ipynb: fast checks of its code; `make test-slow` executes it."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

NOTEBOOK = Path(__file__).resolve().parents[1] / "agents" / "examples" / "first_policy.ipynb"
PATIENCE = 1200
"""Longest wait for a cell, as the first one of a new installation compiles [s]."""


def code() -> list[dict[str, Any]]:
    """The cells of code."""
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


@pytest.mark.slow
@pytest.mark.xdist_group(__name__)
def test_it_trains_a_policy_that_drives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import nbformat
    from nbclient import NotebookClient

    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    where = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=PATIENCE, resources=where).execute()
    told = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    said = "".join(output.get("text", "") for output in told)
    found = re.search(r"(\d+) of 50 goals reached", said)
    assert found is not None
    assert int(found[1]) >= 45
    pages = "".join(output.get("data", {}).get("text/html", "") for output in told)
    assert "data:image/gif;base64,R0lGOD" in pages
    assert (tmp_path / "first.onnx").exists()
