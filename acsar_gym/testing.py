"""Boards for tests of your own code: a scripted board and an emulated board.

Neither needs hardware. A `ScriptedLink` tests what a robot's driver, sensor or task does with the
bytes of a board, in simulated time. `emulated_board` tests code that opens a serial device, in real
time.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from acsar_gym.config import RobotConfig, RobotSource
from acsar_gym.errors import LinkError
from acsar_gym.links.base import Link
from acsar_gym.protocol import ZERO, Decoder
from acsar_gym.worlds import Scene

__all__ = ["Command", "EmulatedBoard", "ScriptedLink", "emulated_board", "wait_until"]

TIMEOUT = 30.0
"""Longest wait for anything that another process does [s]."""
Command = tuple[float | None, float | None, float | None, float | None]
"""Speeds of the wheels a to d in a line [rad/s]. None for a wheel that the line doesn't name."""


class ScriptedLink(Link):
    """A link in simulated time whose feedback is written beforehand.

    Args:
        *answers: Bytes that arrive in the first period, the second, and so on.
        then: Bytes that arrive in each later period, or a function of the newest command's wheel
            speeds that returns them.

    Attributes:
        written: Bytes that were written, one entry for each call.
        opened: Number of calls of `open`.
        closed: Number of calls of `close`.
        pause: Time by which the next period is longer than it should be [s].

    Example:
        A board whose wheels follow every command at once:

            from acsar_gym import Robot, protocol
            from acsar_gym.testing import ScriptedLink

            link = ScriptedLink(then=protocol.encode)
            with Robot(link) as robot:
                robot.drive(0.1, 0.0)
            assert link.commands[-1] == (0.0, 0.0, 0.0, 0.0)
    """

    def __init__(
        self, *answers: bytes, then: bytes | Callable[[Sequence[float]], bytes] = b""
    ) -> None:
        self.answers = list(answers)
        self.then = then
        self.written: list[bytes] = []
        self.opened = 0
        self.closed = 0
        self.pause = 0.0
        self._now = 0.0

    @property
    def commands(self) -> list[Command]:
        """The wheel speeds of each command line that was written [rad/s]."""
        return _decode_speeds(b"".join(self.written))

    def open(self) -> None:
        """Count the call."""
        self.opened += 1

    def reset(self, scene: Scene) -> None:
        """Do nothing: a board doesn't know of scenes."""

    def write(self, data: bytes) -> None:
        """Keep the bytes."""
        self.written.append(data)

    def advance(self, period: float) -> bytes:
        """Let a period pass, and return the next answer."""
        self._now += period + self.pause
        self.pause = 0.0
        # Answers that were written beforehand come first.
        if self.answers:
            return self.answers.pop(0)
        if isinstance(self.then, bytes):
            return self.then
        commands = _decode_speeds(self.written[-1]) if self.written else []
        # A board at rest answers before its first command.
        newest = commands[-1] if commands else ZERO
        return self.then([speed or 0.0 for speed in newest])

    def now(self) -> float:
        """Return the simulated time since the link was made [s]."""
        return self._now

    def close(self) -> None:
        """Count the call."""
        self.closed += 1


def _decode_speeds(data: bytes) -> list[Command]:
    """Return the wheel speeds of each line [rad/s]."""
    return [reading.speeds for reading in Decoder().feed(data)]


@dataclass
class EmulatedBoard:
    """A board that another process emulates on a pseudo-terminal. See `emulated_board`."""

    send_signal: Callable[[signal.Signals], None]
    """Sends a signal to that process."""
    device: str
    """Path that links open. Empty while the cable is pulled."""
    log: Path
    """File of the events at the board, one JSON line for each."""
    lidar_device: str | None = None
    """Path of the emulated LiDAR. None without a LiDAR."""
    _events: list[dict[str, Any]] = field(default_factory=list, init=False)
    _read_bytes: int = field(default=0, init=False)

    def events(self) -> list[dict[str, Any]]:
        """Return the log until now. "t" is the machine's monotonic clock [s].

        An event has one of these keys:

        - "rx": bytes that clients have written
        - "pose": true pose of the robot, once a loop of the firmware, with "hit" if it touches
          a mover, see `worlds.crowd`
        - "lost": time that wasn't simulated, because the computer was too busy [s]
        - "device": the path after the cable was pulled or plugged in
        """
        # The emulator may be in the middle of a line: only whole lines are read.
        with self.log.open("rb") as log:
            log.seek(self._read_bytes)
            complete, end, _ = log.read().rpartition(b"\n")
        self._events += map(json.loads, complete.splitlines())
        self._read_bytes += len(complete + end)
        return list(self._events)

    def received(self) -> bytes:
        """Return all bytes that clients have written."""
        return "".join(e["rx"] for e in self.events() if "rx" in e).encode("latin-1")

    def commands(self) -> list[Command]:
        """Return the wheel speeds of each command line until now [rad/s]."""
        return _decode_speeds(self.received())

    def poses(self) -> list[tuple[float, float, float]]:
        """Return the true poses of the robot, once a loop of the firmware [m, m, rad]."""
        return [tuple(event["pose"]) for event in self.events() if "pose" in event]

    def is_driven(self) -> bool:
        """Whether the newest command turns wheels."""
        commands = self.commands()
        return bool(commands) and commands[-1] != ZERO

    def is_stopped(self) -> bool:
        """Whether wheels were commanded to turn, and the newest command is zero."""
        commands = self.commands()
        # Before the first drive, zeros are no stop.
        return any(command != ZERO for command in commands) and commands[-1] == ZERO

    def stands(self, loops: int = 100) -> bool:
        """Whether the robot hasn't moved for a number of loops of the firmware.

        Args:
            loops: Number of loops, of 5 ms by default.
        """
        poses = self.poses()
        # Noise of the physics is far below a tenth of a millimetre.
        spread = [max(values) - min(values) for values in zip(*poses[-loops:], strict=True)]
        return len(poses) > loops and max(spread) < 1e-4

    def pause(self) -> None:
        """Freeze the board: it neither reads nor answers."""
        self.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Let a frozen board go on."""
        self.send_signal(signal.SIGCONT)

    def pull(self) -> None:
        """Pull the cable. The board goes on without it. Idempotent."""
        if self.device:
            self._move_cable(signal.SIGUSR1)

    def plug(self) -> None:
        """Plug the cable in again. `device` is its new path. Idempotent."""
        if not self.device:
            self._move_cable(signal.SIGUSR2)

    def _move_cable(self, number: signal.Signals) -> None:
        def list_devices() -> list[str]:
            return [event["device"] for event in self.events() if "device" in event]

        # The emulator logs the new path once it has moved the cable.
        moves = len(list_devices())
        self.send_signal(number)
        wait_until(lambda: len(list_devices()) > moves, "a cable that moves")
        self.device = list_devices()[-1]


@contextlib.contextmanager
def emulated_board(
    robot: RobotSource = None,
    *,
    body: str = "planar",
    world: str | Path | None = None,
    lidar: bool = False,
) -> Iterator[EmulatedBoard]:
    """Emulate a board in another process, as a context manager, as `acsar-gym emulate` does.

    Args:
        robot: The emulated robot, as `RobotConfig.of` takes it.
        body: Its physics: "planar", "bullet" or "mujoco".
        world: World with the robot at its start: a file, or a generated world like "clutter:7-7".
        lidar: Also emulate an RPLIDAR, at `lidar_device`.

    Yields:
        The board, which serves until the end of the block.

    Raises:
        ConfigError: The robot can't be read.
        LinkError: The emulator didn't start.

    Example:
        from acsar_gym import Robot, open_link
        from acsar_gym.testing import emulated_board

        with emulated_board() as board, Robot(open_link(board.device)) as robot:
            robot.drive(0.1, 0.0)
            assert board.commands()
    """
    from acsar_gym.tools.emulation.board import run_emulator  # noqa: PLC0415 - NumPy and numba

    with tempfile.TemporaryDirectory() as folder:
        # The emulator is another process, so it gets the robot as a file.
        file = Path(folder, "robot.yaml")
        log = Path(folder, "log.jsonl")
        RobotConfig.of(robot).save(file)
        options = ["--robot", str(file), "--body", body, "--log", str(log)]
        if world is not None:
            options += ["--world", str(world)]
        if lidar:
            options.append("--lidar")

        with run_emulator(*options) as devices:
            send_signal = partial(os.kill, devices.process)
            yield EmulatedBoard(send_signal, devices.robot, log, devices.lidar)


def wait_until(condition: Callable[[], bool], what: str, timeout: float = TIMEOUT) -> None:
    """Return when a condition holds.

    Args:
        condition: Called again and again.
        what: What is waited for, for the error.
        timeout: Longest wait [s].

    Raises:
        LinkError: The condition doesn't hold within this time.
    """
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            raise LinkError(f"{what}: not within {timeout:g} s")
        time.sleep(0.02)
