"""The board's program behind a pseudo-terminal: doctor, and how soon its motors have no current.

`make firmware` also runs the suites of links, watchdog and emergency stop over it.
"""

from __future__ import annotations

import contextlib
import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import firmware_tools
import pytest
import stopping
from serial_tools import Emulated, cli, start

from acsar_gym import RobotConfig
from acsar_gym.testing import wait_until

pytestmark = pytest.mark.usefixtures("deadline")

TRIALS = 20
PATIENT = {"connect_timeout": 20.0, "feedback_timeout": 5.0, "watchdog_timeout": 2.0}
"""What a busy computer needs [s]. A program that was killed is noticed at once all the same."""
DOCTOR_TIMEOUT = 120.0
"""The doctor turns wheels for 40 s [s]."""
ATTEMPTS = 3
"""How often doctor is asked where the computer lets the simulated chip stand still."""
LIMIT = 0.1
"""From a zero command to motors without current, on the board's clock [s]."""


@contextlib.contextmanager
def serve(chip: str, folder: Path, *options: str) -> Iterator[Emulated]:
    """A simulated board on a pseudo-terminal."""
    command = shlex.join((*firmware_tools.command(chip), *options))
    emulated = start(folder / "board.jsonl", board=command)
    try:
        yield emulated
    finally:
        emulated.end()


@pytest.fixture
def board(chip: str, tmp_path: Path) -> Iterator[Emulated]:
    with serve(chip, tmp_path) as emulated:
        yield emulated


def examine(board: Emulated, folder: Path, *options: str) -> tuple[int, dict[str, Any]]:
    """Run the doctor. Returns its status and its checks by name."""
    robot = folder / "patient.yaml"
    RobotConfig.preset("acsar_avr").with_(**PATIENT).save(robot)
    report = folder / "doctor.json"
    arguments: tuple[str | Path, ...] = ("--robot", robot, "--spin", "--yes", *options)
    done = cli("doctor", board.device, *arguments, "--json", report, timeout=DOCTOR_TIMEOUT)
    checks = json.loads(report.read_text())["checks"]
    return done.returncode, {check["name"]: check for check in checks}


def test_doctor_finds_nothing_to_warn_of(board: Emulated, tmp_path: Path) -> None:
    for _ in range(ATTEMPTS):
        board.forget()
        code, checks = examine(board, tmp_path, "--saw", *"abcd")
        if not any("lost" in event for event in board.events()):
            break
    else:
        pytest.skip("this computer is too busy for a simulated chip in real time")
    faulty = {name for name, check in checks.items() if check["status"] != "ok"}
    assert faulty <= {"serial ports", "emergency stop"}  # which are those of this computer
    assert code == 0


def test_doctor_shows_that_a_motor_is_cut(chip: str, tmp_path: Path) -> None:
    """The encoder of wheel a counts backward."""
    with serve(chip, tmp_path, "--way", "-1,1,1,1") as board:
        code, checks = examine(board, tmp_path)
    assert code != 0
    assert "a cut: turns against its motor" in checks["the board says"]["found"]
    assert "ENCODER_REVERSED" in checks["the board says"]["fix"]
    assert checks["line quality"]["status"] == "ok"


def off_after(board: Emulated, fault: float) -> tuple[float, float]:
    """Wait until the motors have no current after a fault.

    Returns:
        The seconds since the fault, and on the board's clock those since the zero command.
    """
    off: list[dict[str, Any]] = []

    def is_off() -> bool:
        off[:] = [
            e for e in board.events() if e["t"] > fault and "duty" in e and not any(e["duty"])
        ]
        return bool(off)

    wait_until(is_off, "motors without current")
    events = [event for event in board.events() if event["t"] <= off[0]["t"]]
    heard = [e["t"] for e in events if e["t"] > fault and "ap00.00,bp00.00" in e.get("rx", "")]
    stop_time = heard[0] if heard else fault
    driven = [event["own"] for event in events if "own" in event and event["t"] <= stop_time]
    return off[0]["t"] - fault, off[0]["own"] - driven[-1]


def test_motors_have_no_current_soon_after_kill_9(board: Emulated, tmp_path: Path) -> None:
    """The computer's part, from the fault to the command, is that of `make stopping`."""
    robot_file = tmp_path / "robot.yaml"
    config = RobotConfig.preset("acsar_avr").with_(**PATIENT)
    robot_file.write_text(config.model_dump_json())  # YAML contains JSON

    fault_times = []
    command_times = []
    for _ in range(TRIALS):
        with stopping.faulty_program("kill", board, Path(board.device), robot_file) as fault:
            since_fault, since_command = off_after(board, fault)
        fault_times.append(since_fault)
        command_times.append(since_command)
        board.forget()
    assert max(command_times) < LIMIT, command_times
    print("from kill -9 to motors without current [s]:", min(fault_times), max(fault_times))


@pytest.mark.parametrize("chip", firmware_tools.CHIPS[:1])
def test_stopping_ends_every_kind_of_fault_in_a_zero_command(chip: str) -> None:
    config = RobotConfig.preset("acsar_avr")
    command = shlex.join(firmware_tools.command(chip))
    stops = list(stopping.measure(1, config=config, board=command))
    assert all(result.is_sound for result in stops), stops
