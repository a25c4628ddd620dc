"""Driving by hand and with a fixed twist, over the emulator's terminal."""

from __future__ import annotations

import contextlib
import itertools
import os
import pty
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import gamepad_tools
import pytest
from gamepad_tools import FULL, LB, LEFT, LET_GO, QUIT, REST, START, STOP, EmulatedPad
from serial_tools import (
    CLI,
    HEEDING_CTRL_C,
    TIMEOUT,
    Emulated,
    RobotFile,
    no_leak,
    program,
    wait_until,
)

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
WITH_PAD = (sys.executable, gamepad_tools.__file__)
"""The command line with emulated gamepads."""


def on_the_wire(config: RobotConfig, linear: float, angular: float) -> Command:
    """The command for a twist, as its two decimals say it."""
    speeds = Robot(open_link("planar", config), config).wheel_speeds(linear, angular)
    return Decoder().feed(encode(speeds))[0].speeds


@pytest.mark.parametrize(
    ("keys", "twist"),
    [
        ("w", (0.2, 0.0)),
        ("d", (0.0, -0.2)),
        ("wwww", (0.2, 0.0)),  # as a key that is held
        ("wa", (0.2, 0.2)),
        ("ws", (-0.2, 0.0)),
        ("5w", (0.5, 0.0)),
        ("w0", (1.0, 0.0)),
        ("wa ", (0.0, 0.0)),
        ("w x", (0.0, 0.0)),
    ],
)
def test_keys(keys: str, twist: tuple[float, float]) -> None:
    asked = teleop.DriveKeys()
    for key in keys:
        asked.press(key, 3.0)
    assert asked.twist(3.1) == twist


def test_a_key_drives_until_its_time_is_over_or_it_comes_again() -> None:
    keys = teleop.DriveKeys()
    assert keys.twist(0.0) == (0.0, 0.0)
    keys.press("w", 0.0)
    keys.press("d", 0.3)
    assert keys.twist(0.4) == (0.2, -0.2)
    assert keys.twist(0.5) == (0.0, -0.2)
    keys.press("w", 0.6)
    assert keys.twist(0.85) == (0.2, 0.0)
    keys.press("5", 1.0)
    assert keys.twist(1.2) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("asked", "reached"), [((0.2, 0.3), (0.2, 0.3)), ((2.0, 0.0), (0.5, 0.0))], ids=["", "too fast"]
)
def test_a_fixed_twist_is_reached_within_the_limits_and_then_stopped(
    asked: tuple[float, float],
    reached: tuple[float, float],
    config: RobotConfig,
    emulator: Emulated,
    capsys: pytest.CaptureFixture[str],
) -> None:
    robot = Robot(open_link(emulator.device, config), config)
    with no_leak():
        teleop.drive_twist(robot, *asked, duration=0.5)
    assert not robot.active
    assert robot.odometry.pose[0] > 0.01
    said = capsys.readouterr().out
    assert "feedback" in said
    assert ("LIMITS" in said) == (asked != reached)
    wait_until(emulator.is_stopped, "zero as the last command")
    driven = [command for command in emulator.commands() if command != ZERO]
    assert len(driven) == 50
    assert driven[-1] == on_the_wire(config, *reached)
    fastest = [max(map(abs, filter(None, command))) for command in driven]
    assert fastest[0] < 0.8
    assert fastest == sorted(fastest)  # a ramp, and nothing faster before its end


def test_ctrl_c_stops_a_fixed_twist(emulator: Emulated, robot_file: RobotFile) -> None:
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


@contextlib.contextmanager
def open_screen(*arguments: str, program: Sequence[str] = CLI) -> Iterator[Screen]:
    master, slave = pty.openpty()
    # Blessed asks the terminal what it can do; nobody is here to answer.
    env = {**os.environ, "TERM": "xterm", "BLESSED_QUERY_TIMEOUT_SECONDS": "0"}
    process = subprocess.Popen(
        [*program, "drive", *arguments],
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


@pytest.fixture
def screen(emulator: Emulated, robot_file: RobotFile) -> Iterator[Screen]:
    with open_screen("--link", emulator.device, "--robot", str(robot_file())) as shown:
        yield shown


def hold(screen: Screen, key: str, emulator: Emulated, command: Command) -> None:
    """Keep a key down, as the terminal repeats it, until the board has what it commands."""
    before = len(emulator.commands())

    def obeyed() -> bool:
        screen.press(key)
        return command in emulator.commands()[before:]

    wait_until(obeyed, f"what {key!r} commands")


def wait_for_commands(emulator: Emulated, count: int) -> None:
    wait_until(lambda: len(emulator.commands()) >= count, f"{count} commands")


def test_driving_with_the_keyboard(screen: Screen, emulator: Emulated, config: RobotConfig) -> None:
    wait_until(lambda: "feedback" in screen.look(), "the status line")
    assert "q quits" in screen.look()
    assert not emulator.is_driven()
    forward = on_the_wire(config, 0.2 * config.max_linear, 0.0)
    faster = on_the_wire(config, 0.5 * config.max_linear, 0.0)
    for key, command in (("w", forward), ("5", ZERO), (ARROW_UP, faster), (" ", ZERO)):
        hold(screen, key, emulator, command)
    screen.press("q")
    assert screen.wait() == 0
    assert "Traceback" not in screen.look()
    wait_until(emulator.is_stopped, "zero as the last command")
    top = max(filter(None, faster))
    assert all(max(map(abs, filter(None, c)), default=0.0) <= top for c in emulator.commands())


def test_hands_off_the_keyboard_stops_and_a_key_drives_on(
    screen: Screen, emulator: Emulated, config: RobotConfig
) -> None:
    wait_until(lambda: "feedback" in screen.look(), "the status line")
    forward = on_the_wire(config, 0.2 * config.max_linear, 0.0)
    for _ in range(2):
        hold(screen, "w", emulator, forward)
        wait_until(emulator.is_stopped, "zero as the newest command")
        stood = len(emulator.commands())
        wait_for_commands(emulator, stood + 100)
        assert set(emulator.commands()[stood:]) == {ZERO}
        assert screen.process.poll() is None
    assert "EMERGENCY" not in screen.look()


def test_after_an_emergency_stop_the_person_at_the_keyboard_releases_it(
    screen: Screen, emulator: Emulated, config: RobotConfig
) -> None:
    wait_until(lambda: "feedback" in screen.look(), "the status line")
    forward = on_the_wire(config, 0.2 * config.max_linear, 0.0)
    for stop in (lambda: screen.press("e"), stop_all):
        screen.shown = ""
        hold(screen, "w", emulator, forward)
        stop()
        wait_until(lambda: "EMERGENCY_STOP: r releases it" in screen.look(), "why it stands")
        stood = len(emulator.commands())
        screen.press("w")
        wait_for_commands(emulator, stood + 20)
        assert set(emulator.commands()[stood:]) == {ZERO}
        screen.press("r")
    hold(screen, "w", emulator, forward)
    screen.press("q")
    assert screen.wait() == 0


@pytest.fixture
def pad(tmp_path: Path) -> Iterator[EmulatedPad]:
    emulated = EmulatedPad(tmp_path / "pad")
    yield emulated
    emulated.pull()


def test_a_recorded_drive_stops_in_the_tick_in_which_the_deadman_is_let_go_or_the_cable_pulled(
    pad: EmulatedPad, config: RobotConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    happens: dict[int, Callable[[], None]] = {
        50: lambda: pad.deliver(FULL),  # a trigger alone
        60: lambda: pad.deliver(REST + LB + FULL),
        160: lambda: pad.deliver(LET_GO),
        200: lambda: pad.deliver(REST + LB + LEFT),
        260: pad.pull,
        270: pad.plug,
        350: lambda: pad.deliver(FULL),
        400: lambda: pad.deliver(QUIT),
    }
    poll, ticks = Gamepad.poll, itertools.count()

    def scripted(opened: Gamepad) -> list[gamepad.PadEvent]:
        if happening := happens.get(next(ticks)):
            happening()
        return poll(opened)

    monkeypatch.setattr(gamepad, "InputDevice", gamepad_tools.PadDevice)
    monkeypatch.setattr(Gamepad, "poll", scripted)
    path = tmp_path / "drive.mcap"
    robot = Robot(open_link("planar", config), config, recorder=Recorder(path, {"command": "test"}))
    teleop.drive_gamepad(robot, str(pad.path))
    (episode,) = read(path).episodes
    full, left = (config.max_linear, 0.0), (0.0, config.max_angular)
    spans = ((0, 60, (0.0, 0.0)), (60, 160, full), (160, 200, (0.0, 0.0)), (200, 260, left))
    for begin, end, twist in (*spans, (260, 400, (0.0, 0.0))):
        assert set(map(tuple, episode.asked[begin:end].tolist())) == {twist}, begin
        assert (episode.sent[begin:end] == 0.0).all() == (twist == (0.0, 0.0))
        assert episode.sent[end - 1].tolist() == pytest.approx(twist)
    assert len(episode.asked) == 400


def test_real_wheels_stop_when_the_deadman_is_let_go_and_when_the_pad_is_lost(
    pad: EmulatedPad, emulator: Emulated, robot_file: RobotFile, config: RobotConfig
) -> None:
    options = ("--link", emulator.device, "--robot", str(robot_file()))
    fastest = on_the_wire(config, config.max_linear, 0.0)
    with open_screen(*options, "--gamepad", str(pad.path), program=WITH_PAD) as screen:
        wait_until(lambda: "feedback" in screen.look(), "the status line")
        stops: tuple[Callable[[], None], ...] = (lambda: pad.send(LET_GO + REST), pad.pull)
        for stop in stops:
            pad.send(LB + FULL)
            wait_until(lambda: fastest in emulator.commands()[-10:], "full speed")
            stop()
            wait_until(emulator.is_stopped, "zero as the newest command")
            stood = len(emulator.commands())
            wait_for_commands(emulator, stood + 20)
            assert set(emulator.commands()[stood:]) == {ZERO}
        wait_until(lambda: "lost" in screen.look(), "the message")
        pad.plug()
        wait_until(lambda: "press LB to drive on" in screen.look(), "a pad that is back")
        pad.send(LB + FULL)
        wait_until(emulator.is_driven, "a command that turns the wheels")
        pad.send(QUIT)
        assert screen.wait() == 0
    wait_until(emulator.is_stopped, "zero as the last command")


def test_after_an_emergency_stop_start_releases_it_and_the_deadman_is_pressed_anew(
    pad: EmulatedPad, emulator: Emulated, robot_file: RobotFile
) -> None:
    options = ("--link", emulator.device, "--robot", str(robot_file()))
    with open_screen(*options, "--gamepad", str(pad.path), program=WITH_PAD) as screen:
        wait_until(lambda: "feedback" in screen.look(), "the status line")
        for stop in (lambda: pad.send(STOP), stop_all):
            screen.shown = ""
            pad.send(LB + FULL)
            wait_until(emulator.is_driven, "a command that turns the wheels")
            stop()
            wait_until(lambda: "Start releases it" in screen.look(), "why it stands")
            stood = len(emulator.commands())
            pad.send(LET_GO + REST + LB + FULL)
            wait_for_commands(emulator, stood + 20)
            pad.send(START)
            screen.shown = ""
            wait_until(lambda: "EMERGENCY" not in last_line(screen), "the release")
            wait_for_commands(emulator, len(emulator.commands()) + 20)
            assert set(emulator.commands()[stood:]) == {ZERO}
            pad.send(LET_GO + REST)
        pad.send(LB + FULL)
        wait_until(emulator.is_driven, "a command that turns the wheels")
        pad.send(QUIT)
        assert screen.wait() == 0


def last_line(screen: Screen) -> str:
    """The newest status line that is whole; "EMERGENCY" as long as there is none."""
    lines = screen.look().split("\r")
    return lines[-2] if len(lines) > 2 else "EMERGENCY"
