"""A zero command comes after every kind of fault of the driving program: `make stopping`."""

from __future__ import annotations

import math

import pytest
import stopping
from watchdog_tools import HASTY

from acsar_gym import RobotConfig

pytestmark = pytest.mark.usefixtures("deadline")
ACSAR = RobotConfig.preset("acsar")


@pytest.mark.parametrize(
    "kinds",
    [
        pytest.param(
            ("exception", "fork", "thread-end", "thread-term", *stopping.CONTAINED), id="some"
        ),
        pytest.param(("waitpid", *stopping.PAUSED), id="suspended"),
        pytest.param((*stopping.CALLING, "to-thread"), id="signals in C calls"),
        pytest.param(("main-raises", "pool", "atexit"), id="ends of the main thread"),
        pytest.param(stopping.BY_HAND, id="hands that let go"),
        pytest.param(tuple(stopping.KINDS), id="all", marks=pytest.mark.slow),
    ],
)
def test_every_kind_of_fault_ends_in_a_zero_command(
    kinds: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`make stopping` tells how soon, on a machine with nothing else to do."""
    monkeypatch.setattr(stopping, "QUIET_TIME", 0.1)
    stops = list(stopping.measure(1, kinds, ACSAR.with_(watchdog_timeout=HASTY)))
    assert [one.kind for one in stops] == list(kinds)
    for one in stops:
        assert all(map(math.isfinite, one.times)), one
        assert one.times or one.skipped
        if one.kind == "atexit":
            assert max(one.times) < stopping.SLOW_EXIT, "before the program's handler, not after it"


def test_without_a_watchdog_the_measurement_finds_no_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    """So it can fail."""
    monkeypatch.setattr(stopping, "ZERO_TIMEOUT", 0.5)
    (kill,) = stopping.measure(1, ["kill"], ACSAR.with_(watchdog_timeout=None))
    assert kill.times == (math.inf,)
    assert not kill.sound
