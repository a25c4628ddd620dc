"""The board's program behind a pseudo-terminal: doctor, and how soon its motors have no current.

`make firmware` also runs the suites of links, watchdog and emergency stop over it.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import firmware_tools
import pytest
import stopping
from serial_tools import Emulated, cli, start

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import WheelError
from acsar_gym.testing import wait_until

pytestmark = pytest.mark.usefixtures("deadline", "nursery")

TRIALS = 20
PATIENT = {"connect_timeout": 20.0, "feedback_timeout": 5.0, "watchdog_timeout": 2.0}
"""What a busy computer needs [s]. A program that was killed is noticed at once all the same."""
DOCTOR_TIMEOUT = 120.0
"""The doctor turns wheels for 40 s [s]."""
ATTEMPTS = 3
"""How often doctor is asked where the computer lets the simulated chip stand still."""
LIMIT = 0.1
"""From a zero command to motors without current, on the board's clock [s]."""


@pytest.fixture
def board(chip: str, tmp_path: Path) -> Iterator[Emulated]:
    command = shlex.join(firmware_tools.command(chip))
    emulated = start(tmp_path / "board.jsonl", board=command)
    yield emulated
    emulated.end()


def test_doctor_finds_nothing_to_warn_of(board: Emulated, tmp_path: Path) -> None:
    report = tmp_path / "doctor.json"
    robot = tmp_path / "patient.yaml"
    RobotConfig.preset("acsar_avr").with_(**PATIENT).save(robot)
    options = ("--robot", robot, "--spin", "--yes", "--saw", *"abcd", "--json")
    for _ in range(ATTEMPTS):
        board.forget()
        done = cli("doctor", board.device, *options, report, timeout=DOCTOR_TIMEOUT)
        if not any("lost" in event for event in board.events()):
            break
    else:
        pytest.skip("this computer is too busy for a simulated chip in real time")

    checks = json.loads(report.read_text())["checks"]
    faulty = {check["name"] for check in checks if check["status"] != "ok"}
    assert faulty <= {"serial ports", "emergency stop"}  # which are those of this computer
    assert done.returncode == 0, done.stderr


@pytest.fixture
def reversed_board(chip: str, tmp_path: Path) -> Iterator[Emulated]:
    """The encoder of wheel a counts backward."""
    command = shlex.join((*firmware_tools.command(chip), "--way", "-1,1,1,1"))
    emulated = start(tmp_path / "board.jsonl", board=command)
    yield emulated
    emulated.end()


def test_doctor_shows_that_a_motor_is_cut(reversed_board: Emulated, tmp_path: Path) -> None:
    report = tmp_path / "doctor.json"
    robot = tmp_path / "patient.yaml"
    RobotConfig.preset("acsar_avr").with_(**PATIENT).save(robot)
    options = ("--robot", robot, "--spin", "--yes", "--json", report)
    done = cli("doctor", reversed_board.device, *options, timeout=DOCTOR_TIMEOUT)
    assert done.returncode != 0
    checks = {check["name"]: check for check in json.loads(report.read_text())["checks"]}
    assert "a cut: turns against its motor" in checks["the board says"]["found"]
    assert "ENCODER_REVERSED" in checks["the board says"]["fix"]
    assert checks["line quality"]["status"] == "ok"


def test_wheel_check_ends_a_drive_with_a_reversed_encoder(reversed_board: Emulated) -> None:
    """The driver stops the robot before the board cuts the motor, after 0.14 s, and reports it."""
    config = RobotConfig.preset("acsar_avr").with_(**PATIENT)
    with (
        Robot(open_link(reversed_board.device, config), config) as robot,
        pytest.raises(WheelError, match="front_right"),
    ):
        for _ in range(3000):
            robot.drive(0.05, 0.0)
    speeds = [abs(event["speeds"][0]) for event in reversed_board.events() if "speeds" in event]
    assert max(speeds) < 8.0


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
    print(
        f"\nfrom kill -9 to motors without current: {min(fault_times):.3f} to "
        f"{max(fault_times):.3f} s, of which {min(command_times):.3f} to "
        f"{max(command_times):.3f} s are the board's"
    )


@pytest.mark.parametrize("chip", firmware_tools.CHIPS[:1])
def test_stopping_ends_every_kind_of_fault_in_a_zero_command(chip: str) -> None:
    config = RobotConfig.preset("acsar_avr")
    command = shlex.join(firmware_tools.command(chip))
    stops = list(stopping.measure(1, config=config, board=command))
    assert all(result.is_sound for result in stops), stops
