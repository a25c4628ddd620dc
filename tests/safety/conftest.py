"""What tests of the emergency stop share."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from serial_tools import TIMEOUT

from acsar_gym.safety import estop


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of this test alone, with time to answer; paths of sockets must be short."""
    monkeypatch.setattr(estop, "ANSWER_TIMEOUT", TIMEOUT)
    with tempfile.TemporaryDirectory(prefix="acsar-", dir="/tmp") as base:
        monkeypatch.setenv("ACSAR_GYM_RUNTIME_DIR", base)
        yield Path(base)
