"""Findings as a table and as JSON."""

from __future__ import annotations

from typing import Any

import pytest

from acsar_gym.doctor import checks
from acsar_gym.doctor.checks import Check


def test_the_table_holds_every_check() -> None:
    found = [Check(status, status, "found", "fix") for status in checks.MARKS]
    figures: dict[str, Any] = checks.as_json(found)
    assert checks.table(found).row_count == len(figures["checks"]) == 4


def test_a_computer_without_ports_is_a_warning_unless_a_device_is_given(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(checks, "ports", list)
    assert checks.port_list().status == "warn"
    assert checks.port_list("/dev/pts/7").status == "ok"
