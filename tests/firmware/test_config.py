"""Other numbers in config.h: they work, or the compiler says which one can't."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import firmware_tools
import pytest

Build = Callable[..., str]


@pytest.fixture
def build(tmp_path: Path) -> Build:
    """`build(NAME="value", ...)` compiles with these. Returns what the compiler complains of."""

    def compiled(**changes: str) -> str:
        return firmware_tools.build_changed(tmp_path, "atmega328p", **changes)[1]

    return compiled


@pytest.mark.parametrize(
    "changes",
    [
        {"BAUD_RATE": "9600UL", "FEEDBACK_RATE": "25", "WINDOW_LINES": "1"},
        {
            "COUNTS_PER_TURN": "4192",
            "ENCODER_CHANNELS": "1",
            "FULL_SPEED": "23.0",
            "MAX_SPEED": "20.0",
        },
        {"TRAILING_COMMA": "1", "WATCHDOG": "0", "MOTOR_REVERSED": "{1, 0, 1, 0}"},
    ],
)
def test_other_numbers_compile(build: Build, changes: dict[str, str]) -> None:
    assert build(**changes) == ""


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"BAUD_RATE": "9600UL"}, "FEEDBACK_RATE"),
        ({"COUNTS_PER_TURN": "8384"}, "COUNTS_PER_TURN"),
        ({"STALL_MS": "70000"}, "STALL_MS"),
    ],
)
def test_impossible_numbers_are_named(build: Build, changes: dict[str, str], told: str) -> None:
    assert f'"{told}: ' in build(**changes)
