"""Everything here needs avr-gcc and simavr, and is run by `make firmware` alone."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent / "tools"))

import firmware_tools
from firmware_tools import CHIPS, Script


@pytest.fixture(scope="session", autouse=True)
def _built() -> None:
    missing_tools = firmware_tools.missing()
    if missing_tools:
        pytest.skip(f"there is no {missing_tools}")
    firmware_tools.build()


@pytest.fixture(params=CHIPS)
def chip(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def script(chip: str) -> Script:
    return Script(chip)
