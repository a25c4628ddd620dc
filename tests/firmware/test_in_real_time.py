"""The board's program behind a pseudo-terminal: doctor, and how soon its motors have no current.

`make firmware` also runs the suites of links, watchdog and emergency stop over it.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from pathlib import Path

import firmware_tools
import pytest
from serial_tools import Emulated, cli, start, wait_until

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.doctor import stopping
from acsar_gym.doctor.stopping_processes import programs
from acsar_gym.doctor.stopping_programs import KINDS
from acsar_gym.errors import WheelError

pytestmark = [
    pytest.mark.usefixtures("deadline", "nursery"),
    pytest.mark.xdist_group("serial"),
]

TRIALS = 20
LIMIT = 0.25
"""From the fault to motors without current [s]."""


@pytest.fixture
def board(chip: str, tmp_path: Path) -> Iterator[Emulated]:
    command = shlex.join(firmware_tools.command(chip))
    emulated = start(tmp_path / "board.jsonl", board=command)
    yield emulated
    emulated.end()


def test_doctor_finds_nothing_to_warn_of(board: Emulated, tmp_path: Path) -> None:
    found = tmp_path / "doctor.json"
    options = ("--robot", "acsar_avr", "--spin", "--yes", "--saw", *"abcd", "--json")
    done = cli("doctor", board.device, *options, found)
    assert done.returncode == 0, done.stderr
    checks = json.loads(found.read_text())["checks"]
    here = {"serial ports", "emergency stop"}  # of this computer
    assert [one for one in checks if one["status"] != "ok" and one["name"] not in here] == []


@pytest.fixture
def reversed_board(chip: str, tmp_path: Path) -> Iterator[Emulated]:
    """The encoder of wheel a counts backward."""
    command = shlex.join((*firmware_tools.command(chip), "--way", "-1,1,1,1"))
    emulated = start(tmp_path / "board.jsonl", board=command)
    yield emulated
    emulated.end()


def test_doctor_shows_that_a_motor_is_cut(reversed_board: Emulated, tmp_path: Path) -> None:
    found = tmp_path / "doctor.json"
    options = ("--robot", "acsar_avr", "--spin", "--yes", "--json", found)
    done = cli("doctor", reversed_board.device, *options)
    assert done.returncode != 0
    checks = {one["name"]: one for one in json.loads(found.read_text())["checks"]}
    assert "a cut: turns against its motor" in checks["the board says"]["found"]
    assert "ENCODER_REVERSED" in checks["the board says"]["fix"]
    assert checks["line quality"]["status"] == "ok"


def test_a_drive_ends_with_what_the_board_says(reversed_board: Emulated) -> None:
    patient = {"connect_timeout": 20.0, "feedback_timeout": 5.0, "watchdog_timeout": 2.0}
    config = RobotConfig.preset("acsar_avr").with_(**patient)
    with (
        Robot(open_link(reversed_board.device, config), config) as robot,
        pytest.raises(WheelError, match="the board says a cut: turns against its motor"),
    ):
        for _ in range(3000):
            robot.drive(0.05, 0.0)
    fastest = max(abs(event["speeds"][0]) for event in reversed_board.events() if "speeds" in event)
    assert fastest < 8.0


def off_after(board: Emulated, fault: float) -> float:
    """Wait until the motors have no current; returns the seconds from the fault to then."""
    found: list[float] = []

    def is_off() -> bool:
        events = (e for e in board.events() if e["t"] > fault and "duty" in e)
        found[:] = [event["t"] - fault for event in events if not any(event["duty"])]
        return bool(found)

    wait_until(is_off, "motors without current")
    return found[0]


def test_motors_have_no_current_soon_after_kill_9(board: Emulated) -> None:
    config = RobotConfig.preset("acsar_avr")
    took = []
    with programs(board.device, config) as program:
        for _ in range(TRIALS):
            fault = program.fault("kill")
            took.append(off_after(board, fault))
            program.bury()
            board.forget()
    assert max(took) < LIMIT, took
    print(f"\nfrom kill -9 to motors without current: {min(took):.3f} to {max(took):.3f} s")


@pytest.mark.parametrize("chip", firmware_tools.CHIPS[:1])
def test_every_kind_of_fault_ends_in_a_zero_command_in_time(chip: str) -> None:
    config = RobotConfig.preset("acsar_avr")
    command = shlex.join(firmware_tools.command(chip))
    stops = stopping.measure(1, tuple(KINDS), config, board=command)
    assert all(one.sound for one in stops), stops
