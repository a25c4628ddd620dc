"""`acsar-gym benchmark`: what it writes, and what it refuses to go on with."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from cli_tools import Call, assert_one_line

from acsar_gym.resources import AGENTS
from acsar_gym.tools.benchmark.result import ROW_SUFFIX

SMALL = ("--env", "point_goal", "--sets", "open/acsar", "--links", "planar", "--scenes", "2")


@pytest.fixture
def ran(call: Call, tmp_path: Path) -> Path:
    """The folder of a small benchmark."""
    out = tmp_path / "run"
    code, said, error = call(
        *("benchmark", *SMALL, "--agents", "packaged", "turn_drive", "--out", out),
        *("--table", tmp_path / "table.md", "--json", tmp_path / "told.json"),
        *("--html", tmp_path / "page.html"),
    )
    assert code == 0, error
    assert f"tables: {tmp_path / 'table.md'}" in said.replace("\n", "")
    return out


def test_it_writes_tables_json_and_a_report(ran: Path, call: Call) -> None:
    told = json.loads((ran / "benchmark.json").read_text())
    assert told == json.loads((ran.parent / "told.json").read_text())
    assert {row["agent"]: row["success_rate"] for row in told["rows"]} == {
        "packaged": 1.0,
        "turn_drive": 1.0,
    }
    page = (ran / "benchmark.md").read_text()
    assert "| **packaged** | planar |" in page
    assert str(ran.parent) not in page
    assert page == (ran.parent / "table.md").read_text()
    assert "turn_drive" in (ran.parent / "page.html").read_text()
    again = call("benchmark", "--combine", ran, "--out", ran.parent / "both")
    assert again[0] == 0, again[2]
    assert (ran.parent / "both" / "benchmark.md").read_text() == page


def test_another_plan_in_the_same_folder(ran: Path, call: Call) -> None:
    other = ("benchmark", *SMALL, "--agents", "navfn", "--out", ran)
    code, _, error = call(*other)
    assert code == 2
    assert_one_line(error, "holds a benchmark with another plan (agents differs)")
    assert call(*other, "--no-resume")[0] == 0


def test_anybodys_policy_gets_a_row(call: Call, tmp_path: Path) -> None:
    shutil.copy(AGENTS / "policies" / "point_goal.onnx", tmp_path / "mine.onnx")
    own = ("--links", "planar", "--scenes", "1", "--out", tmp_path / "run")
    code, said, error = call("benchmark", "--policy", tmp_path / "mine.onnx", *own)
    assert code == 0, error
    row = tmp_path / "run" / f"mine{ROW_SUFFIX}"
    assert "row to submit" in said
    code, said, error = call("benchmark", "--check", row)
    assert code == 0, error
    assert "sound: mine" in said
    row.write_text(row.read_text().replace('"success_rate":1.0', '"success_rate":0.9'))
    code, _, error = call("benchmark", "--check", row)
    assert code == 2
    assert_one_line(error, "was changed after it was written")
