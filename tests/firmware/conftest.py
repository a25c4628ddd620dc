"""Everything here needs avr-gcc and simavr, and is run by `make firmware` alone."""

from __future__ import annotations

import firmware_tools
import pytest
from firmware_tools import CHIPS, Script


@pytest.fixture(scope="session", autouse=True)
def _built() -> None:
    what = firmware_tools.missing()
    if what:
        pytest.skip(f"there is no {what}")
    firmware_tools.build()


@pytest.fixture(params=CHIPS)
def chip(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def script(chip: str) -> Script:
    return Script(chip)
