"""Commissioning of an odd board, and wrong wheels, over a pseudo-terminal."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import pytest
from cli_tools import Call, assert_one_line
from serial_tools import TRIALS, Emulated, RobotFile, StartEmulator, start, wait_until

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.tools.sysid import board
from acsar_gym.worlds import Pose

pytestmark = pytest.mark.usefixtures("deadline")


ODD = "at-comma unpadded swapped-motors reversed-encoder=b feedback-rate=50 command-timeout=0.3"
"""A board that differs in everything."""


SPEED, RADIUS, TURN = 0.3, 0.375, 1.4
"""Of the curve: speed [m/s], radius [m], and how far it turns [rad]."""
MOST_TICKS = 2000


def driven(emulated: Emulated, config: RobotConfig) -> tuple[Pose, Pose]:
    """Where a robot is after a curve to the left, really and by odometry, from where it began."""
    x, y, theta = emulated.poses()[-1]
    with Robot(open_link(emulated.device, config), config) as robot:
        for _ in range(MOST_TICKS):
            robot.drive(SPEED, SPEED / RADIUS)
            if robot.odometry.pose[2] > TURN:
                break
        for _ in range(60):
            robot.drive(0.0, 0.0)
        odometry = robot.odometry.pose
    wait_until(emulated.stands, "a robot that stands")
    ex, ey, end = emulated.poses()[-1]
    cos, sin = math.cos(theta), math.sin(theta)
    dx, dy = ex - x, ey - y
    return (cos * dx + sin * dy, cos * dy - sin * dx, end - theta), odometry


def test_an_odd_board_is_commissioned_and_driven(
    config: RobotConfig,
    start_emulator: StartEmulator,
    call: Call,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """The last of its answers only eyes can give: the sides are swapped at the motors."""
    monkeypatch.setattr(board, "LISTEN_TIME", 0.5)  # shorter than at the command line
    monkeypatch.setattr(board, "DELAY_TRIALS", 2)
    monkeypatch.setattr(board, "LONGEST_TIMEOUT", 1.0)
    odd = start_emulator("--quirk", *ODD.split())
    guess, found, report = (tmp_path / name for name in ("guess.yaml", "found.yaml", "out.json"))
    config.save(guess)
    options = ("--robot", guess, "--out", found, "--json", report, "--saw", "b", "a", "d", "c")
    for _ in range(TRIALS):
        found.unlink(missing_ok=True)
        code, out, error = call("doctor", odd.device, "--spin", "--yes", *options)
        assert not error
        if code != 0:
            continue
        known = RobotConfig.load(found)
        timely = known.firmware.command_timeout == pytest.approx(0.3, abs=0.06)
        if timely and known.firmware.feedback_rate == 50.0:
            break
    assert code == 0, out
    assert timely
    assert known.firmware.feedback_rate == 50.0
    assert "left and right motors are swapped" in " ".join(report.read_text().split())
    assert [wheel.motor + wheel.encoder for wheel in known.wheels.each] == ["ba", "ab", "dc", "cd"]
    assert [wheel.sign for wheel in known.wheels.each] == [1, -1, 1, 1]
    true, odometry = driven(odd, known)
    arc = RADIUS * math.sin(true[2]), RADIUS * (1.0 - math.cos(true[2]))
    assert true[2] > TURN - 0.1
    assert true == pytest.approx((*arc, odometry[2]), abs=0.1)
    assert odometry == pytest.approx(true, abs=0.1)


def test_no_file_is_written_of_a_wheel_that_its_board_drives_away(
    config: RobotConfig,
    start_emulator: StartEmulator,
    call: Call,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setattr(board, "LISTEN_TIME", 0.5)
    emulated = start_emulator("--quirk", "runaway=a")
    guess, found, report = (tmp_path / name for name in ("guess.yaml", "found.yaml", "out.json"))
    config.save(guess)
    options = ("--robot", guess, "--out", found, "--json", report)
    for _ in range(TRIALS):
        code, _, error = call("doctor", emulated.device, "--spin", "--yes", *options)
        assert (code, error) == (1, "")
        if "set ENCODER_REVERSED" in report.read_text():
            break
    assert "set ENCODER_REVERSED in the board's program" in report.read_text()
    assert "isn't written" in report.read_text()
    assert not found.exists()
    wait_until(emulated.is_stopped, "zero as the newest command")


SAID = "rear_left stands still"


@pytest.fixture(scope="module")
def lame(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulated]:
    """A robot with a dead wheel."""
    folder = tmp_path_factory.mktemp("lame")
    emulated = start(folder / "emulator.jsonl", "--quirk", "dead-wheel=c")
    yield emulated
    emulated.end()


@pytest.mark.parametrize(
    ("quirk", "twist", "said"),
    [
        ("runaway=a", ("--linear", "0.05"), "front_right turns too fast"),
        # By test_wheel_check it "answers front_left's command"; by late lines it may be too slow.
        ("swapped-encoders", ("--linear", "0.4", "--angular", "1.2"), "rad/s commanded"),
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


def test_an_evaluation_counts_faults(
    lame: Emulated, robot_file: RobotFile, call: Call, tmp_path: Path
) -> None:
    file = tmp_path / "run.json"
    arguments = ("--link", lame.device, "--robot", robot_file(), "--episodes", "2", "--json", file)
    code, output, error = call("evaluate", *arguments)
    assert code == 3
    assert_one_line(error, SAID)
    assert f"Faults: 2 of 2: {SAID}" in " ".join(output.split())
    data = json.loads(file.read_text())
    assert (data["fault_rate"], data["timeout_rate"]) == (1.0, 0.0)
    assert SAID in data["per_episode"][0]["fault"]


def test_the_check_can_be_switched_off(lame: Emulated, robot_file: RobotFile, call: Call) -> None:
    robot = robot_file(wheel_check=False)
    twist = ("--linear", "0.2", "--duration", "1")
    assert call("drive", "--link", lame.device, *twist, "--robot", robot)[::2] == (0, "")


def test_a_board_that_echoes_is_refused_in_one_line(
    start_emulator: StartEmulator, robot_file: RobotFile, call: Call
) -> None:
    device = start_emulator("--quirk", "echo").device
    robot = ("--robot", robot_file())
    code, output, _ = call("doctor", device, "--spin", "--yes", *robot)
    assert code == 1
    assert "this board echoes" in " ".join(output.split())
    assert "reset" not in output

    for command in (("identify", device, "--yes"), ("drive", "--link", device, "--linear", "0.1")):
        code, _, error = call(*command, *robot)
        assert code == 3
        assert_one_line(error, f"{device}: this board echoes: it sends each command back")
        assert "delete the echo from the board's program" in error
