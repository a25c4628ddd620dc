"""Driving by hand and with a fixed twist, over the emulator's terminal."""

from __future__ import annotations

import itertools
import os
import pty
import select
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import gamepad_tools
import numpy as np
import pytest
from gamepad_tools import FULL, LB, LEFT, LET_GO, QUIT, REST, START, STOP, EmulatedPad
from processes import program
from serial_tools import CLI, HEEDING_CTRL_C, TIMEOUT, Emulated, RobotFile, no_leak, wait_until

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.guard.estop import stop_all
from acsar_gym.protocol import ZERO, Decoder, encode
from acsar_gym.recording import Recorder
from acsar_gym.recording.reader import read
from acsar_gym.testing import Command
from acsar_gym.tools import gamepad, teleop
from acsar_gym.tools.gamepad import Gamepad

pytestmark = pytest.mark.usefixtures("deadline")


ARROW_UP = "\x1b[A"


def on_the_wire(config: RobotConfig, linear: float, angular: float) -> Command:
    """The command for a twist, as its two decimals say it."""
    speeds = Robot(open_link("planar", config), config).wheel_speeds(linear, angular)
    return Decoder().feed(encode(speeds))[0].speeds


@pytest.mark.parametrize(
    ("keys", "now", "twist"),
    [
        ("wd", 0.4, (0.2, -0.2)),
        ("wwwwa", 0.1, (0.2, 0.2)),  # as a key that is held
        ("ws", 0.1, (-0.2, 0.0)),
        ("5w0", 0.1, (1.0, 0.0)),
        ("wa x", 0.1, (0.0, 0.0)),
        ("wd", 0.5, (0.0, -0.2)),  # each key has its own time
        ("w", 0.5, (0.0, 0.0)),
    ],
)
def test_drive_keys(keys: str, now: float, twist: tuple[float, float]) -> None:
    drive_keys = teleop.DriveKeys()
    for number, key in enumerate(keys):
        drive_keys.press(key, 0.01 * number)
    assert drive_keys.twist(now) == twist


@pytest.mark.parametrize(
    ("twist", "reached"), [((0.2, 0.3), (0.2, 0.3)), ((2.0, 0.0), (0.5, 0.0))], ids=["", "too fast"]
)
def test_drive_twist_stays_within_the_limits_and_stops(
    twist: tuple[float, float],
    reached: tuple[float, float],
    config: RobotConfig,
    emulator: Emulated,
    capsys: pytest.CaptureFixture[str],
) -> None:
    robot = Robot(open_link(emulator.device, config), config)
    with no_leak():
        teleop.drive_twist(robot, *twist, duration=0.5)

    assert not robot.active
    assert robot.odometry.pose[0] > 0.01
    status = capsys.readouterr().out
    assert "feedback" in status
    assert ("LIMITS" in status) == (twist != reached)
    wait_until(emulator.is_stopped, "zero as the last command")
    driven = [command for command in emulator.commands() if command != ZERO]
    assert len(driven) == 50
    assert driven[-1] == on_the_wire(config, *reached)
    fastest = [max(map(abs, filter(None, command))) for command in driven]
    assert fastest[0] < 0.8
    assert fastest == sorted(fastest)  # a ramp, and nothing faster before its end


def test_drive_twist_stops_upon_ctrl_c(emulator: Emulated, robot_file: RobotFile) -> None:
    options = ("--link", emulator.device, "--linear", "0.2", "--robot", str(robot_file()))
    with program(HEEDING_CTRL_C, "drive", *options) as process:
        wait_until(emulator.is_driven, "a command that turns the wheels")
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=TIMEOUT)
    assert process.returncode == 130
    assert "interrupted" in error
    assert "Traceback" not in error
    wait_until(emulator.is_stopped, "zero as the last command")


@dataclass
class Screen:
    """A person's terminal, in which `acsar-gym drive` runs."""

    process: subprocess.Popen[bytes]
    master: int
    shown: str = ""

    def press(self, keys: str) -> None:
        os.write(self.master, keys.encode())

    def look(self) -> str:
        """All that has been shown so far."""
        while select.select([self.master], [], [], 0.0)[0]:
            self.shown += os.read(self.master, 4096).decode(errors="replace")
        return self.shown

    def wait(self) -> int:
        deadline = time.monotonic() + TIMEOUT
        while self.process.poll() is None and time.monotonic() < deadline:
            self.look()
            time.sleep(0.02)
        return self.process.wait(0.0)


@pytest.fixture
def screen(emulator: Emulated, robot_file: RobotFile) -> Iterator[Screen]:
    master, slave = pty.openpty()
    # Blessed asks the terminal for its features, and nobody is here to answer.
    env = {**os.environ, "TERM": "xterm", "BLESSED_QUERY_TIMEOUT_SECONDS": "0"}

    process = subprocess.Popen(
        [*CLI, "drive", "--link", emulator.device, "--robot", str(robot_file())],
        stdin=slave,
        stdout=slave,
        stderr=slave,
        start_new_session=True,
        env=env,
    )
    yield Screen(process, master)
    process.kill()
    process.wait(TIMEOUT)
    os.close(master)
    os.close(slave)


def hold(screen: Screen, key: str, emulator: Emulated, command: Command) -> None:
    """Keep a key down, as the terminal repeats it, until the board has what it commands."""
    start = len(emulator.commands())

    def obeyed() -> bool:
        screen.press(key)
        return command in emulator.commands()[start:]

    wait_until(obeyed, f"what {key!r} commands")


def check_at_rest(emulator: Emulated, press: Callable[[], None] = lambda: None) -> None:
    """Wait until the robot is stopped, and check that nothing drives it then."""
    wait_until(emulator.is_stopped, "zero as the newest command")
    start = len(emulator.commands())
    press()
    wait_until(lambda: len(emulator.commands()) >= start + 20, "20 commands")
    assert set(emulator.commands()[start:]) == {ZERO}


def test_drive_keyboard(screen: Screen, emulator: Emulated, config: RobotConfig) -> None:
    wait_until(lambda: "feedback" in screen.look(), "the status line")
    assert "q quits" in screen.look()
    assert not emulator.is_driven()
    forward = on_the_wire(config, 0.2 * config.max_linear, 0.0)
    faster = on_the_wire(config, 0.5 * config.max_linear, 0.0)
    for key, command in (("w", forward), ("5", ZERO), (ARROW_UP, faster), (" ", ZERO)):
        hold(screen, key, emulator, command)

    hold(screen, "w", emulator, faster)
    check_at_rest(emulator)  # the key was let go
    assert "EMERGENCY" not in screen.look()
    screen.press("q")
    assert screen.wait() == 0
    assert "Traceback" not in screen.look()
    wait_until(emulator.is_stopped, "zero as the last command")
    top = max(filter(None, faster))
    assert all(max(map(abs, filter(None, c)), default=0.0) <= top for c in emulator.commands())


def test_drive_keyboard_releases_an_emergency_stop(
    screen: Screen, emulator: Emulated, config: RobotConfig
) -> None:
    wait_until(lambda: "feedback" in screen.look(), "the status line")
    forward = on_the_wire(config, 0.2 * config.max_linear, 0.0)
    for stop in (lambda: screen.press("e"), stop_all):
        screen.shown = ""
        hold(screen, "w", emulator, forward)
        stop()
        wait_until(lambda: "EMERGENCY_STOP: r releases it" in screen.look(), "the reason")
        check_at_rest(emulator, lambda: screen.press("w"))
        screen.press("r")
    hold(screen, "w", emulator, forward)
    screen.press("q")
    assert screen.wait() == 0


def test_drive_gamepad_stops_in_the_tick_in_which_lb_is_let_go_or_the_cable_pulled(
    config: RobotConfig,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """After a lost pad and after an emergency stop, LB has to be pressed again."""
    pad = EmulatedPad(tmp_path / "pad")
    happens: dict[int, Callable[[], None]] = {
        50: lambda: pad.deliver(FULL),  # a trigger alone
        60: lambda: pad.deliver(REST + LB + FULL),
        160: lambda: pad.deliver(LET_GO),
        200: lambda: pad.deliver(REST + LB + LEFT),
        260: pad.pull,
        270: pad.plug,
        350: lambda: pad.deliver(FULL),
        360: lambda: pad.deliver(REST + LB + FULL),
        420: lambda: pad.deliver(STOP),
        430: lambda: pad.deliver(LET_GO + REST + LB + FULL),
        450: lambda: pad.deliver(START),
        460: lambda: pad.deliver(REST + FULL),
        470: lambda: pad.deliver(LET_GO + REST + LB + FULL),
        520: lambda: pad.deliver(QUIT),
    }
    poll = Gamepad.poll
    ticks = itertools.count()

    def scripted(opened: Gamepad) -> list[gamepad.PadEvent]:
        if happening := happens.get(next(ticks)):
            happening()
        return poll(opened)

    monkeypatch.setattr(gamepad, "InputDevice", gamepad_tools.PadDevice)
    monkeypatch.setattr(Gamepad, "poll", scripted)
    path = tmp_path / "drive.mcap"
    robot = Robot(open_link("planar", config), config, recorder=Recorder(path, {"command": "test"}))
    teleop.drive_gamepad(robot, str(pad.path))
    pad.pull()
    driven, released = read(path).episodes
    commands = np.concatenate([driven.asked, released.asked])
    sent = np.concatenate([driven.sent, released.sent])
    zero = (0.0, 0.0)
    full = (config.max_linear, 0.0)
    turn = (0.0, config.max_angular)
    spans = ((0, 60, zero), (60, 160, full), (160, 200, zero), (200, 260, turn), (260, 360, zero))
    for start, end, twist in (*spans, (360, 420, full), (450, 470, zero), (470, 520, full)):
        assert set(map(tuple, commands[start:end].tolist())) == {twist}, start
        assert (sent[start:end] == 0.0).all() == (twist == zero)
        assert sent[end - 1].tolist() == pytest.approx(twist)
    assert (sent[420:450] == 0.0).all()
    assert (len(driven.asked), len(commands)) == (450, 520)
    error = capsys.readouterr().err
    assert "pad: lost; the robot is held until it is plugged in again" in error
    assert "pad: back; press LB to drive on" in error
