"""A zero command comes after every kind of fault of the driving program: `make stopping`."""

from __future__ import annotations

import math

import pytest
import stopping
from processes import HASTY

from acsar_gym import RobotConfig

pytestmark = pytest.mark.usefixtures("deadline")
ACSAR = RobotConfig.preset("acsar")


def test_stopping_ends_every_kind_of_fault_in_a_zero_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`make stopping` reports how soon, on a machine with nothing else to do."""
    monkeypatch.setattr(stopping, "QUIET_TIME", 0.1)
    stops = stopping.measure(1, config=ACSAR.with_(watchdog_timeout=HASTY))
    times = {kind.kind: kind.times[0] for kind in stops}
    assert times.keys() == stopping.KINDS.keys()
    assert [kind for kind, time in times.items() if not math.isfinite(time)] == []


def test_stopping_finds_no_zero_command_without_a_watchdog(monkeypatch: pytest.MonkeyPatch) -> None:
    """So the measurement can fail."""
    monkeypatch.setattr(stopping, "ZERO_TIMEOUT", 0.5)
    (kill,) = stopping.measure(1, ["kill"], ACSAR.with_(watchdog_timeout=None))
    assert kill.times == [math.inf]
    assert not kill.is_sound
