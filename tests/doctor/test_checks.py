"""Findings as a table and as JSON."""

from __future__ import annotations

from typing import Any

import pytest

from acsar_gym.tools.doctor import checks
from acsar_gym.tools.doctor.checks import Check


def test_the_table_holds_every_check() -> None:
    found = [Check(status, status, "found", "fix") for status in checks.STATUS_MARKS]
    figures: dict[str, Any] = checks.checks_as_json(found)
    assert checks.draw_checks(found).row_count == len(figures["checks"]) == 4


def test_a_computer_without_ports_is_a_warning_unless_a_device_is_given(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(checks, "find_ports", list)
    assert checks.check_ports().status == "warn"
    assert checks.check_ports("/dev/pts/7").status == "ok"
