"""A zero command comes after every kind of fault of the driving program: `make stopping`."""

from __future__ import annotations

import math

import pytest
import stopping
from watchdog_tools import HASTY

from acsar_gym import RobotConfig

pytestmark = pytest.mark.usefixtures("deadline")
ACSAR = RobotConfig.preset("acsar")


@pytest.mark.parametrize("kind", stopping.KINDS)
def test_stopping_ends_in_a_zero_command(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """`make stopping` reports how soon, on a machine with nothing else to do."""
    monkeypatch.setattr(stopping, "QUIET_TIME", 0.1)
    (stops,) = stopping.measure(1, [kind], ACSAR.with_(watchdog_timeout=HASTY))
    assert stops.kind == kind
    assert math.isfinite(stops.times[0])


def test_stopping_without_a_watchdog_finds_no_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    """So the measurement can fail."""
    monkeypatch.setattr(stopping, "ZERO_TIMEOUT", 0.5)
    (kill,) = stopping.measure(1, ["kill"], ACSAR.with_(watchdog_timeout=None))
    assert kill.times == (math.inf,)
    assert not kill.is_sound
