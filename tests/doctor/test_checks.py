"""Findings as a table and as JSON."""

from __future__ import annotations

from typing import Any

from acsar_gym.doctor import checks
from acsar_gym.doctor.checks import Check


def test_the_table_holds_every_check() -> None:
    found = [Check(status, status, "found", "fix") for status in checks.MARKS]
    figures: dict[str, Any] = checks.as_json(found)
    assert checks.table(found).row_count == len(figures["checks"]) == 4
