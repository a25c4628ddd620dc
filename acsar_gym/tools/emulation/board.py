"""Emulates the board in real time on a pseudo-terminal, here or in a process of its own.

To exercise all serial code.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.config import BAUD_RATES, RobotConfig
from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.links import Link, open_link
from acsar_gym.protocol import encode
from acsar_gym.tools.emulation.quirks import QuirkyLink, apply_to_config, parse_quirks
from acsar_gym.tools.emulation.rplidar import RplidarEmulator, RplidarTwin
from acsar_gym.worlds import Pose, Scene, World
from acsar_gym.worlds.geometry import measure_ranges

try:
    import pty
    import termios
    import tty
except ImportError:
    raise ConfigError("this operating system has no pseudo-terminals to emulate on") from None

CABLE_CHUNK = 4096
BAUD_CODES = {getattr(termios, f"B{rate}"): rate for rate in BAUD_RATES}


class EmulatedCable:
    """The emulated cable of a board.

    Args:
        baud_rate: baud rate of the board.
        name: symbolic link that always points to the current device, as udev maintains in
            /dev/serial/by-id; None for no link.

    Attributes:
        device: path of the device; empty while unplugged.

    Raises:
        ConfigError: the symbolic link can't be created.
    """

    def __init__(self, baud_rate: int, name: Path | None = None) -> None:
        self.device = ""
        self._baud_rate = baud_rate
        self._name = name
        self._descriptors: tuple[int, ...] = ()
        self.plug()

    def plug(self) -> None:
        """Create the device: raw mode, with the board's baud rate until a client sets another one.

        Idempotent.
        """
        if self._descriptors:
            return
        self._master, self._slave = self._descriptors = pty.openpty()
        tty.setraw(self._slave)
        attributes = termios.tcgetattr(self._slave)
        attributes[4] = attributes[5] = getattr(termios, f"B{self._baud_rate}")
        termios.tcsetattr(self._slave, termios.TCSANOW, attributes)
        os.set_blocking(self._master, False)
        self.device = os.ttyname(self._slave)
        self._link()

    def _link(self) -> None:
        """Let the symbolic link point to the device."""
        if self._name is None:
            return
        try:
            if self._name.is_symlink():
                self._name.unlink()
            self._name.symlink_to(self.device)
        except FileExistsError:
            self.pull()
            raise ConfigError(
                f"{self._name}: exists and isn't a symbolic link: name another"
            ) from None
        except OSError as error:
            self.pull()
            raise ConfigError(f"{self._name}: can't be made a symbolic link: {error}") from None

    def pull(self) -> None:
        """Remove the device. Idempotent."""
        descriptors, self._descriptors = self._descriptors, ()
        if self._name is not None and descriptors:
            with contextlib.suppress(OSError):  # it may be missing or not a symbolic link
                if str(self._name.readlink()) == self.device:
                    self._name.unlink()
        self.device = ""
        for descriptor in descriptors:
            os.close(descriptor)

    @property
    def sound(self) -> bool:
        """Whether client and board have the same baud rate."""
        return BAUD_CODES.get(termios.tcgetattr(self._slave)[4]) == self._baud_rate

    def read(self) -> bytes:
        """Read what the client has sent; nothing while unplugged."""
        with contextlib.suppress(BlockingIOError):
            return os.read(self._master, CABLE_CHUNK) if self._descriptors else b""
        return b""

    def write(self, data: bytes) -> None:
        """Send to the client; data that nobody reads is lost, as on a UART."""
        if self._descriptors:
            with contextlib.suppress(BlockingIOError):
                os.write(self._master, data)


EMULATOR_END_TIMEOUT = 30.0
"""Time after which an emulator that doesn't end is killed [s]."""
EMULATOR_PROGRAM = """
import os, threading

def follow():
    os.read(0, 1)  # returns when the other end of the pipe is closed, or its process has ended
    os._exit(0)

threading.Thread(target=follow, daemon=True).start()
from acsar_gym.tools.cli import main
main()
"""
"""Runs `acsar-gym` and exits when the parent process does, for whatever reason."""


class EmulatedDevices(NamedTuple):
    """Paths of the emulated devices."""

    robot: str
    lidar: str | None = None


@contextlib.contextmanager
def run_emulator(*arguments: str) -> Iterator[EmulatedDevices]:
    """Run `acsar-gym emulate` in another process, as a context manager.

    It ends with the context, or with this process, even if that is killed. Ctrl-C reaches this
    process only.

    Args:
        *arguments: command line arguments of `emulate`; with "--lidar" there are two devices.

    Yields:
        Paths of the emulated devices.

    Raises:
        LinkError: the emulator didn't start.
    """
    command = [sys.executable, "-c", EMULATOR_PROGRAM, "emulate", *arguments]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            robot = _device(process, arguments)
            yield EmulatedDevices(
                robot, _device(process, arguments) if "--lidar" in arguments else None
            )
        finally:
            _end(process)


def _device(process: subprocess.Popen[str], arguments: tuple[str, ...]) -> str:
    """Read the line that names the next device."""
    line = process.stdout.readline() if process.stdout else ""
    device = line.strip().split(" ")[-1]
    if not device.startswith("/"):
        said = f"run 'acsar-gym emulate {' '.join(arguments)}' to see why"
        raise LinkError("the emulator didn't start", said)
    return device


def _end(process: subprocess.Popen[str]) -> None:
    """Terminate the emulator; kill it after END_TIMEOUT."""
    process.terminate()
    try:
        process.wait(EMULATOR_END_TIMEOUT)
    except subprocess.TimeoutExpired:
        process.kill()


Floats = NDArray[np.float64]
LONGEST_CATCH_UP = 0.5
"""A delay by the operating system is caught up with, unless it is longer than this [s]. Drivers
give up after 0.5 s without feedback by default; until then they take it that the robot goes on."""
WARM_UP_TIME = 0.05
"""Simulated time before a client can connect [s]."""
LIDAR_SAMPLES = 200
"""Measurements of the LiDAR per turn: 2000/s at 10 Hz, as an RPLIDAR A1 has."""


class Emulator:
    """A simulated robot on a pseudo-terminal.

    Set `plugged` to False and True, at any time and also in signal handlers, to pull the cable and
    plug it in again under a new device name.

    Args:
        config: configuration of the robot.
        body: "planar" or "bullet".
        log: file for one JSON line per received chunk, per loop the true pose (world
            frame), and lost time; None for no log.
        silent: never answer.
        world: the world, at whose start the robot stands; None for the origin of an open floor.
        sees: also emulate an RPLIDAR, at `lidar_device`.
        name: symbolic link that always points to the current device; None for no link.
        quirks: how the board differs, such as "at-comma"; see emulation/quirks.py.

    Raises:
        ConfigError: for an unknown body or quirk, or if `log` or `name` can't be created.
    """

    def __init__(
        self,
        config: RobotConfig,
        *,
        body: str = "planar",
        log: Path | None = None,
        silent: bool = False,
        world: World | None = None,
        sees: bool = False,
        name: Path | None = None,
        quirks: Sequence[str] = (),
    ) -> None:
        if body not in ("planar", "bullet"):
            raise ConfigError(f"body = {body!r}: must be planar or bullet")
        odd = parse_quirks(quirks)
        config = apply_to_config(odd, config)
        self._config = config
        self._silent = silent
        self.plugged = True
        self.lost = 0.0
        """Time that wasn't simulated, because the process was delayed for too long [s]."""
        with contextlib.ExitStack() as ours:
            self._link: Link = open_link(body, config)
            ours.callback(self._link.close)
            self._link.open()
            _warm_up(self._link)
            if odd:
                self._link = QuirkyLink(self._link, config, odd)
            self._link.reset(Scene() if world is None else Scene(_start(world), world=world))
            self._lidar = _lidar(self._link, world, config) if sees else None
            if self._lidar is not None:
                ours.callback(self._lidar.close)
            self.lidar_device = self._lidar.device if self._lidar else None
            self._log = reading.open_lines(log) if log else None
            if self._log is not None:
                ours.callback(self._log.close)
            self._cable = EmulatedCable(config.baud_rate, name)
            ours.callback(self._cable.pull)
            self._ours = ours.pop_all()

    @property
    def device(self) -> str:
        """Path that a SerialLink opens; empty while the cable is unplugged."""
        return self._cable.device

    def run(self, duration: float | None = None, until: Callable[[], bool] = lambda: False) -> None:
        """Run the emulator with absolute deadlines; after a long delay they restart from now.

        Args:
            duration: time to run [s]; None for no limit.
            until: called in every loop; ends the run by returning True.

        Raises:
            ConfigError: `duration` is negative or not finite.
        """
        if duration is not None and not 0.0 <= duration < math.inf:
            raise ConfigError(f"duration = {duration}: must be a finite number of seconds")
        period = 1.0 / self._config.firmware.loop_rate
        start = deadline = time.monotonic()
        while not until() and (duration is None or deadline - start < duration):
            deadline += period
            remaining = deadline - time.monotonic()
            if remaining < -LONGEST_CATCH_UP:
                deadline -= remaining
                self.lost -= remaining
                self._note({"lost": -remaining})
            time.sleep(max(0.0, remaining))
            self._turn(period)

    def _turn(self, period: float) -> None:
        """Run one loop of the firmware: receive, simulate, send."""
        if self.plugged != bool(self.device):
            self._replug()
        data = self._cable.read()
        if data:
            self._note({"rx": data.decode("latin-1")})
            self._link.write(self._over_uart(data))
        answer = self._link.advance(period)
        if self._lidar is not None:
            self._lidar.serve_once(period)
        if self._log is not None:
            self._note({"pose": self._link.truth.pose if self._link.truth else None})
        if answer and self.device and not self._silent:
            self._cable.write(self._over_uart(answer))

    def _replug(self) -> None:
        """Plug or unplug the cable, and log it."""
        if self.plugged:
            self._cable.plug()
        else:
            self._cable.pull()
        self._note({"device": self.device})

    def _over_uart(self, data: bytes) -> bytes:
        """Transfer bytes over the UART, which garbles them if the baud rates differ."""
        if self._cable.sound:
            return data
        return bytes((byte * 7 + 0x80) & 0xFF | 0x80 for byte in data)

    def _note(self, event: dict[str, object]) -> None:
        """Write an event to the log, if there is one."""
        if self._log is not None:
            reading.write_line(self._log, json.dumps({"t": time.monotonic(), **event}) + "\n")

    def close(self) -> None:
        """Unplug the cable and close terminals and log. Idempotent."""
        self._ours.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _warm_up(link: Link) -> None:
    """Compile what moves a robot, which would silence the board for a second at first."""
    link.reset(Scene())
    link.write(encode((1.0, 1.0, 1.0, 1.0)))
    link.advance(WARM_UP_TIME)


def _start(world: World) -> Pose:
    """Return the pose at which the robot starts in a world."""
    return world.start.x, world.start.y, world.start.theta or 0.0


def _lidar(link: Link, world: World | None, config: RobotConfig) -> RplidarEmulator:
    """Make an emulated LiDAR at its place on the robot, at the configured rate."""

    def ranges(bearings: Floats) -> Floats:
        """Return ranges [m] at bearings [rad] in the sensor's frame."""
        x, y, theta = link.truth.pose if link.truth else (0.0, 0.0, 0.0)
        cos, sin = math.cos(theta), math.sin(theta)
        x += cos * config.lidar_x_offset - sin * config.lidar_y_offset
        y += sin * config.lidar_x_offset + cos * config.lidar_y_offset
        return measure_ranges((x, y), bearings + theta, world)

    return RplidarEmulator(RplidarTwin(ranges, rate=config.lidar.rate, samples=LIDAR_SAMPLES))
