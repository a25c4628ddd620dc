"""Commissioning of an odd board, and wrong wheels, over a pseudo-terminal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from serial_tools import TRIALS, RobotFile, StartEmulator, wait_until

from acsar_gym import RobotConfig
from acsar_gym.tools.sysid import board

pytestmark = pytest.mark.usefixtures("deadline")

ODD = "at-comma unpadded swapped-motors reversed-encoder=b feedback-rate=50 command-timeout=0.3"
"""A board that differs in everything."""


@pytest.fixture
def guess(config: RobotConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A robot's file before the board is examined, which takes less time than usual."""
    monkeypatch.setattr(board, "LISTEN_TIME", 0.5)
    monkeypatch.setattr(board, "DELAY_TRIALS", 2)
    monkeypatch.setattr(board, "LONGEST_TIMEOUT", 1.0)
    path = tmp_path / "guess.yaml"
    config.save(path)
    return path


def test_doctor_commissions_an_odd_board(
    start_emulator: StartEmulator, call: Any, guess: Path, tmp_path: Path
) -> None:
    """Only eyes can tell that the sides are swapped at the motors."""
    odd = start_emulator("--quirk", *ODD.split())
    out = tmp_path / "found.yaml"
    report = tmp_path / "out.json"
    files = f"--robot {guess} --out {out} --json {report}"
    for _ in range(TRIALS):
        out.unlink(missing_ok=True)
        code, text, error = call(f"doctor {odd.device} --spin --yes {files} --saw b a d c")
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


def test_doctor_writes_no_file_for_a_wheel_that_its_board_drives_away(
    start_emulator: StartEmulator, call: Any, guess: Path, tmp_path: Path
) -> None:
    emulated = start_emulator("--quirk", "runaway=a")
    out = tmp_path / "found.yaml"
    report = tmp_path / "out.json"
    files = f"--robot {guess} --out {out} --json {report}"
    for _ in range(TRIALS):
        code, _, error = call(f"doctor {emulated.device} --spin --yes {files}")
        assert (code, error) == (1, "")
        if "set ENCODER_REVERSED" in report.read_text():
            break
    assert "set ENCODER_REVERSED in the board's program" in report.read_text()
    assert "isn't written" in report.read_text()
    assert not out.exists()
    wait_until(emulated.is_stopped, "zero as the newest command")


def test_a_board_that_echoes_is_refused_in_one_line(
    start_emulator: StartEmulator, robot_file: RobotFile, call: Any
) -> None:
    device = start_emulator("--quirk", "echo").device
    options = f"{device} --yes --robot {robot_file()}"
    code, out, _ = call(f"doctor {options} --spin")
    assert code == 1
    assert "this board echoes" in " ".join(out.split())

    call.refuse("delete the echo from the board's program", f"identify {options}", code=3)
