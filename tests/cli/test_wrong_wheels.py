"""A wrong wheel of a board in another process stops whatever drives it, and is named."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from cli_tools import Call, assert_one_line
from serial_tools import Emulated, RobotFile, StartEmulator, start, wait_until

pytestmark = [pytest.mark.xdist_group("serial"), pytest.mark.usefixtures("deadline")]

SAID = "rear_left stands still"


@pytest.fixture(scope="module")
def lame(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulated]:
    """A robot with a dead wheel."""
    folder = tmp_path_factory.mktemp("lame")
    emulated = start(folder / "emulator.jsonl", "--quirk", "dead-wheel=c")
    yield emulated
    emulated.end()


def test_drive_ends_with_the_wheels_name(lame: Emulated, robot_file: RobotFile, call: Call) -> None:
    lame.forget()
    twist = ("--linear", "0.2", "--duration", "5")
    code, _, error = call("drive", "--link", lame.device, *twist, "--robot", robot_file())
    assert code == 3
    assert_one_line(error, SAID)
    wait_until(lame.is_stopped, "zero as the newest command")


@pytest.mark.parametrize(
    ("quirk", "twist", "said"),
    [
        ("runaway=a", ("--linear", "0.05"), "front_right turns too fast"),
        ("swapped-encoders", ("--linear", "0.4", "--angular", "1.2"), "answers"),
        ("feedback-factor=9.55", ("--linear", "0.05"), "turns too fast"),
    ],
)
def test_drive_ends_on_boards_that_a_sign_in_the_file_cannot_mend(
    quirk: str,
    twist: tuple[str, ...],
    said: str,
    start_emulator: StartEmulator,
    robot_file: RobotFile,
    call: Call,
) -> None:
    board = start_emulator("--quirk", quirk)
    robot = robot_file(wheels={"a": {"sign": -1}} if "runaway" in quirk else {})
    code, _, error = call("drive", "--link", board.device, *twist, "--robot", robot)
    assert code == 3
    assert_one_line(error, said)
    wait_until(board.is_stopped, "zero as the newest command")


def test_a_run_has_a_fault(
    lame: Emulated, robot_file: RobotFile, call: Call, tmp_path: Path
) -> None:
    file = tmp_path / "run.json"
    arguments = ("--link", lame.device, "--robot", robot_file(), "--json", file, "--yes")
    code, output, error = call("run", "1.5", "0", *arguments)
    assert code == 3
    assert_one_line(error, SAID)
    assert "fault" in output
    data = json.loads(file.read_text())
    assert (data["fault_rate"], data["timeout_rate"]) == (1.0, 0.0)
    assert SAID in data["per_episode"][0]["fault"]


def test_an_evaluation_counts_faults(lame: Emulated, robot_file: RobotFile, call: Call) -> None:
    arguments = ("--link", lame.device, "--robot", robot_file(), "--episodes", "2")
    code, output, error = call("evaluate", *arguments)
    assert code == 3
    assert_one_line(error, SAID)
    assert f"Faults: 2 of 2: {SAID}" in " ".join(output.split())


def test_the_check_can_be_switched_off(lame: Emulated, robot_file: RobotFile, call: Call) -> None:
    robot = robot_file(wheel_check=False)
    twist = ("--linear", "0.2", "--duration", "1")
    assert call("drive", "--link", lame.device, *twist, "--robot", robot)[::2] == (0, "")
