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
SPEED = 0.3
RADIUS = 0.375
TURN = 1.4
"""The curve that is driven [m/s, m, rad]."""
MAX_TICKS = 2000


def drive_curve(emulated: Emulated, config: RobotConfig) -> tuple[Pose, Pose]:
    """Drive a curve to the left. Returns its end relative to its start, truly and by odometry."""
    x, y, theta = emulated.poses()[-1]
    with Robot(open_link(emulated.device, config), config) as robot:
        for _ in range(MAX_TICKS):
            robot.drive(SPEED, SPEED / RADIUS)
            if robot.odometry.pose[2] > TURN:
                break
        for _ in range(60):
            robot.drive(0.0, 0.0)
        odometry = robot.odometry.pose

    wait_until(emulated.stands, "a robot at rest")
    end_x, end_y, end_theta = emulated.poses()[-1]
    dx = end_x - x
    dy = end_y - y
    cos = math.cos(theta)
    sin = math.sin(theta)
    return (cos * dx + sin * dy, cos * dy - sin * dx, end_theta - theta), odometry


@pytest.fixture
def guess(config: RobotConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A robot's file before the board is examined, which takes less time than usual."""
    monkeypatch.setattr(board, "LISTEN_TIME", 0.5)
    monkeypatch.setattr(board, "DELAY_TRIALS", 2)
    monkeypatch.setattr(board, "LONGEST_TIMEOUT", 1.0)
    path = tmp_path / "guess.yaml"
    config.save(path)
    return path


def test_doctor_commissions_an_odd_board_that_is_driven_then(
    start_emulator: StartEmulator, call: Call, guess: Path, tmp_path: Path
) -> None:
    """Only eyes can tell that the sides are swapped at the motors."""
    odd = start_emulator("--quirk", *ODD.split())
    out = tmp_path / "found.yaml"
    report = tmp_path / "out.json"
    options = ("--robot", guess, "--out", out, "--json", report, "--saw", "b", "a", "d", "c")
    for _ in range(TRIALS):
        out.unlink(missing_ok=True)
        code, text, error = call("doctor", odd.device, "--spin", "--yes", *options)
        assert not error
        if code != 0:
            continue
        robot = RobotConfig.load(out)
        is_timely = robot.firmware.command_timeout == pytest.approx(0.3, abs=0.06)
        if is_timely and robot.firmware.feedback_rate == 50.0:
            break
    assert code == 0, text
    assert is_timely
    assert robot.firmware.feedback_rate == 50.0
    assert "left and right motors are swapped" in " ".join(report.read_text().split())
    assert [wheel.motor + wheel.encoder for wheel in robot.wheels.each] == ["ba", "ab", "dc", "cd"]
    assert [wheel.sign for wheel in robot.wheels.each] == [1, -1, 1, 1]

    true, odometry = drive_curve(odd, robot)
    arc = (RADIUS * math.sin(true[2]), RADIUS * (1.0 - math.cos(true[2])))
    assert true[2] > TURN - 0.1
    assert true == pytest.approx((*arc, odometry[2]), abs=0.1)
    assert odometry == pytest.approx(true, abs=0.1)


def test_doctor_writes_no_file_for_a_wheel_that_its_board_drives_away(
    start_emulator: StartEmulator, call: Call, guess: Path, tmp_path: Path
) -> None:
    emulated = start_emulator("--quirk", "runaway=a")
    out = tmp_path / "found.yaml"
    report = tmp_path / "out.json"
    options = ("--robot", guess, "--out", out, "--json", report)
    for _ in range(TRIALS):
        code, _, error = call("doctor", emulated.device, "--spin", "--yes", *options)
        assert (code, error) == (1, "")
        if "set ENCODER_REVERSED" in report.read_text():
            break
    assert "set ENCODER_REVERSED in the board's program" in report.read_text()
    assert "isn't written" in report.read_text()
    assert not out.exists()
    wait_until(emulated.is_stopped, "zero as the newest command")


@pytest.fixture(scope="module")
def dead_wheel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulated]:
    """A robot with a dead wheel."""
    folder = tmp_path_factory.mktemp("lame")
    emulated = start(folder / "emulator.jsonl", "--quirk", "dead-wheel=c")
    yield emulated
    emulated.end()


def test_evaluate_counts_faults(
    dead_wheel: Emulated, robot_file: RobotFile, call: Call, tmp_path: Path
) -> None:
    file = tmp_path / "run.json"
    options = ("--robot", robot_file(), "--episodes", "2", "--json", file)
    code, out, error = call("evaluate", "--link", dead_wheel.device, *options)
    assert code == 3
    fault = "rear_left stands still"
    assert_one_line(error, fault)
    assert f"Faults: 2 of 2: {fault}" in " ".join(out.split())
    data = json.loads(file.read_text())
    assert (data["fault_rate"], data["timeout_rate"]) == (1.0, 0.0)
    assert fault in data["per_episode"][0]["fault"]


def test_a_board_that_echoes_is_refused_in_one_line(
    start_emulator: StartEmulator, robot_file: RobotFile, call: Call
) -> None:
    device = start_emulator("--quirk", "echo").device
    robot = ("--robot", robot_file())
    code, out, _ = call("doctor", device, "--spin", "--yes", *robot)
    assert code == 1
    assert "this board echoes" in " ".join(out.split())

    code, _, error = call("identify", device, "--yes", *robot)
    assert code == 3
    assert_one_line(error, f"{device}: this board echoes: it sends each command back")
    assert "delete the echo from the board's program" in error
