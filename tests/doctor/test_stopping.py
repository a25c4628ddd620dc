"""How soon a zero command comes, by `acsar-gym doctor --stopping`."""

from __future__ import annotations

import contextlib
import json
import math
import os

import pytest
from rich.console import Console
from watchdog_tools import HASTY

from acsar_gym import RobotConfig
from acsar_gym.errors import AcsarError, ConfigError
from acsar_gym.tools.doctor import stopping, stopping_processes
from acsar_gym.tools.doctor.stopping_programs import CALLING, KINDS, PAUSED, SLOW_EXIT

pytestmark = [
    pytest.mark.usefixtures("deadline", "nursery"),
    pytest.mark.xdist_group("serial"),
]


@pytest.mark.parametrize(
    "kinds",
    [
        pytest.param(("exception", "fork", "thread-end"), id="some"),
        pytest.param(("waitpid", *PAUSED), id="suspended"),
        pytest.param((*CALLING, "to-thread"), id="signals in C calls"),
        pytest.param(("main-raises", "pool", "atexit"), id="ends of the main thread"),
        pytest.param(tuple(KINDS), id="all", marks=pytest.mark.slow),
    ],
)
def test_every_kind_of_fault_ends_in_a_zero_command(
    kinds: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`acsar-gym doctor --stopping` tells how soon, on a machine with nothing else to do."""
    monkeypatch.setattr(stopping_processes, "SURE", 0.1)
    told: list[str] = []
    config = RobotConfig.preset("acsar").with_(watchdog_timeout=HASTY)
    stops = stopping.measure(1, kinds, config, progress=lambda kind, _: told.append(kind))
    assert [one.kind for one in stops] == list(kinds)
    assert told == [one.kind for one in stops if not one.skipped]
    for one in stops:
        assert all(map(math.isfinite, one.times)), one
        assert one.times or one.skipped
        if one.kind == "atexit":
            assert max(one.times) < SLOW_EXIT, "before the program's own handler, not after it"
    report = json.loads(json.dumps(stopping.as_json(stops), allow_nan=False))
    assert set(report["stops"]) == set(kinds)


def test_without_a_watchdog_the_measurement_finds_no_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    """So it can fail."""
    monkeypatch.setattr(stopping_processes, "PATIENCE", 0.5)
    config = RobotConfig.preset("acsar").with_(watchdog_timeout=None)
    (kill,) = stopping.measure(1, ["kill"], config)
    assert kill.times == (math.inf,)
    assert kill.in_time == 0
    assert not kill.sound
    assert stopping.as_json([kill])["stops"]["kill"]["times"] == [None]


def test_bad_questions_to_the_measurement_are_errors() -> None:
    with pytest.raises(ConfigError, match="did you mean 'kill'"):
        stopping.measure(1, ["kil"])
    impossible = RobotConfig.preset("acsar").with_(connect_timeout=1e-6)
    with pytest.raises(AcsarError, match=r"kill: the program didn't drive: .* no byte"):
        stopping.measure(1, ["kill"], impossible)


def test_the_table_says_what_could_not_be_measured_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stopping, "no_namespace", lambda: "no PID namespace here (not permitted)")
    monkeypatch.setattr(stopping, "emulator", lambda *_: contextlib.nullcontext(Unused()))
    monkeypatch.setattr(stopping, "programs", lambda *_: contextlib.nullcontext())
    stops = stopping.measure(1, ["pid1-term", "pid1-hup"])
    stops.append(stopping.Stops("fork", (0.01, math.inf)))
    console = Console(record=True, width=100, file=open(os.devnull, "w"))  # noqa: SIM115
    console.print(stopping.table(stops))
    console.file.close()
    said = console.export_text()
    assert said.count("skipped") == 3
    assert "skipped: no PID namespace here (not permitted)" in said
    assert "1 of 2" in said
    assert max(map(len, said.splitlines())) <= 100
    assert [one.sound for one in stops] == [True, True, False]


class Unused:
    device = ""
