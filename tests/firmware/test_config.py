"""Other numbers in config.h: they work, or the compiler says which one can't."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from acsar_gym.resources import ASSETS

Build = Callable[..., str]


@pytest.fixture
def build(tmp_path: Path) -> Build:
    """`build(NAME="value", ...)` compiles with these; returns what the compiler complains of."""
    folder = tmp_path / "firmware"
    shutil.copytree(ASSETS / "firmware", folder)

    def compiled(**changes: str) -> str:
        config = folder / "acsar" / "config.h"
        text = config.read_text()
        for name, value in changes.items():
            text, count = re.subn(rf"#define {name} .*", f"#define {name} {value}", text)
            assert count == 1
        config.write_text(text)
        command = ["make", "-s", "-C", str(folder), "build/atmega328p.elf"]
        return subprocess.run(command, check=False, capture_output=True, text=True).stderr

    return compiled


@pytest.mark.parametrize(
    "changes",
    [
        {"BAUD_RATE": "9600UL", "FEEDBACK_RATE": "25", "WINDOW_LINES": "1"},
        {"BAUD_RATE": "57600UL", "LOOP_RATE": "500", "TIME_CONSTANT": "0.2"},
        {"TRAILING_COMMA": "1", "WATCHDOG": "0", "MOTOR_REVERSED": "{1, 0, 1, 0}"},
    ],
)
def test_other_numbers_compile(build: Build, changes: dict[str, str]) -> None:
    assert build(**changes) == ""


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"BAUD_RATE": "9600UL"}, "FEEDBACK_RATE: more lines than BAUD_RATE can carry"),
        ({"BAUD_RATE": "230400UL"}, "BAUD_RATE: this clock makes none within 2.5 % of it"),
        ({"LOOP_RATE": "200"}, "LOOP_RATE: too low for these encoders and this TIME_CONSTANT"),
        ({"LOOP_RATE": "1024"}, "LOOP_RATE: must be a multiple of FEEDBACK_RATE"),
        ({"COUNTS_PER_TURN": "12000"}, "LOOP_RATE: too low for these encoders"),
        ({"MAX_SPEED": "120.0"}, "MAX_SPEED: the wire carries 99.99 rad/s"),
        ({"COMMAND_TIMEOUT_MS": "70000"}, "COMMAND_TIMEOUT_MS: must be less than 65536 loops"),
    ],
)
def test_impossible_numbers_are_named(build: Build, changes: dict[str, str], told: str) -> None:
    assert f'"{told}"' in build(**changes)
