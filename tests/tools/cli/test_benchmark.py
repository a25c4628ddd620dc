"""`acsar-gym benchmark`: what it writes, and what it refuses to go on with."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_tools import Call

SMALL = ("--env", "point_goal", "--sets", "open/acsar", "--links", "planar", "--scenes", "2")


@pytest.fixture
def ran(call: Call, tmp_path: Path) -> Path:
    """The folder of a small benchmark."""
    out = tmp_path / "run"
    code, said, error = call(
        *("benchmark", *SMALL, "--agents", "packaged", "turn_drive", "--out", out),
        *("--json", tmp_path / "told.json", "--html", tmp_path / "page.html"),
    )
    assert code == 0, error
    assert "packaged" in said
    return out


def test_it_writes_json_and_a_page(ran: Path) -> None:
    told = json.loads((ran / "benchmark.json").read_text())
    assert told == json.loads((ran.parent / "told.json").read_text())
    assert {row["agent"]: row["success_rate"] for row in told["rows"]} == {
        "packaged": 1.0,
        "turn_drive": 1.0,
    }
    page = (ran.parent / "page.html").read_text()
    assert "turn_drive" in page
    assert str(ran.parent) not in page
