"""Emulates the board in real time on a pseudo-terminal, in this process or in another one.

A program that opens the printed device talks to a simulated robot in the same way as to a board, so
all serial code is exercised. A wrong baud rate garbles both directions, as on a UART. The log has
one JSON line per event: what was sent to the board, the true poses of the robot, and whether it
touches a mover, with times of the machine's monotonic clock.
"""

from __future__ import annotations

import contextlib
import json
import math
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, Self, TextIO

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, LinkError, explain_error
from acsar_gym.links import open_link
from acsar_gym.physics.bodies import BODIES
from acsar_gym.protocol import encode
from acsar_gym.tools.emulation.cable import EmulatedCable
from acsar_gym.tools.emulation.lidar import LidarEmulator, RplidarTwin
from acsar_gym.worlds import Pose, Scene
from acsar_gym.worlds.crowd import NO_HIT, VX, VY, X, Y
from acsar_gym.worlds.geometry import measure_ranges

Floats = NDArray[np.float64]
LONGEST_CATCH_UP = 0.5
"""The emulator catches up with a delay by the operating system, unless it is longer than this [s].
Drivers give up after 0.5 s without feedback by default. Until then they assume that the robot goes
on."""
WARM_UP_TIME = 0.05
"""Simulated time before a client can connect [s]."""
LOG_MARK = '{"t": '
"""First characters of a log."""
PATIENCE = {"watchdog_timeout": 5.0, "feedback_timeout": 10.0, "connect_timeout": 60.0}
"""How an emulated robot, which can hurt nobody, is driven on a computer that may be busy [s]."""
LIDAR_SAMPLES = 200
"""Measurements of the LiDAR per turn: 2000/s at 10 Hz, as an RPLIDAR A1 has."""


class Emulator:
    """A simulated robot on a pseudo-terminal.

    Args:
        config: Robot configuration.
        body: Name of a simulated link, such as "planar".
        log: File for one JSON line per received chunk, per loop the true pose (world frame) and,
            if the robot touches a mover, who hit whom (see `worlds.crowd`), and lost time. None
            for no log.
        silent: Never answer.
        scene: Where the robot stands. None for the origin of an open floor. Among movers the
            episode starts with the first bytes that a client sends.
        sees: Also emulate an RPLIDAR, at `lidar_device`.
        name: Symbolic link that always points to the current device. None for no link.

    Attributes:
        plugged: Set it to False and True, at any time and also in signal handlers, to pull the
            cable and to plug it in again under a new device name.
        lost: Time that wasn't simulated, because the process was delayed for too long [s].
        lidar_device: Path of the LiDAR. None without a LiDAR.

    Raises:
        ConfigError: The body is unknown, `name` can't be created, or `log` can't be written.
    """

    def __init__(
        self,
        config: RobotConfig,
        *,
        body: str = "planar",
        log: Path | None = None,
        silent: bool = False,
        scene: Scene | None = None,
        sees: bool = False,
        name: Path | None = None,
    ) -> None:
        if body not in BODIES:
            raise ConfigError(f"body = {body!r}: must be {' or '.join(BODIES)}")
        self._config = config
        self._period = 1.0 / config.firmware.loop_rate
        self._silent = silent
        self._scene = scene or Scene()
        self.plugged = True
        self.lost = 0.0

        # What is open is closed again if something else can't be opened.
        with contextlib.ExitStack() as opened:
            self._link = open_link(body, config)
            opened.callback(self._link.close)
            # Compile what moves a robot, which would silence the board for a second at first.
            self._link.reset(self._scene)
            self._link.write(encode((1.0, 1.0, 1.0, 1.0)))
            self._link.advance(WARM_UP_TIME)
            self._start_episode()
            self._is_awaited = self._crowd is not None
            """Whether movers wait for a client."""

            self._lidar: LidarEmulator | None = None
            if sees:
                twin = RplidarTwin(self._look, rate=config.lidar.rate, samples=LIDAR_SAMPLES)
                self._lidar = LidarEmulator(twin)
                opened.callback(self._lidar.close)
            self.lidar_device = self._lidar.device if self._lidar else None
            self._log = opened.enter_context(_open_log(log)) if log is not None else None
            self._cable = EmulatedCable(config.baud_rate, name)
            opened.callback(self._cable.pull)
            self._opened = opened.pop_all()

    @property
    def device(self) -> str:
        """Path that a SerialLink opens. Empty while the cable is unplugged."""
        return self._cable.device

    def _start_episode(self) -> None:
        """Put the robot and the movers to where an episode starts."""
        self._link.reset(self._scene)
        truth = self._link.truth
        self._crowd = truth.crowd if truth else None
        self._pose = self._true_pose()
        self._last_pose = self._pose
        """The pose before the newest loop."""

    def _true_pose(self) -> Pose:
        """Where the robot is, in the frame of the world [m, m, rad]."""
        return self._link.truth.pose if self._link.truth else (0.0, 0.0, 0.0)

    def _look(self, bearings: Floats, ages: Floats) -> Floats:
        """Measure ranges [m], each from where the robot and the movers were at its time.

        The robot moves evenly from its pose before the loop to its pose after it. Movers go on
        from their newest tick.
        """
        # The robot moves during a loop, and the LiDAR measures meanwhile.
        x0, y0, theta0 = self._last_pose
        x, y, theta = self._pose
        # Shares of the loop, from its end backward.
        back = np.minimum(ages / self._period, 1.0)
        headings = theta - back * math.remainder(theta - theta0, 2.0 * math.pi)
        cos = np.cos(headings)
        sin = np.sin(headings)
        along = self._config.lidar_x_offset
        across = self._config.lidar_y_offset
        from_x = x - back * (x - x0) + cos * along - sin * across
        from_y = y - back * (y - y0) + sin * along + cos * across

        movers = None
        if self._crowd is not None:
            # Movers walk on straight between their own ticks.
            since = self._link.now() - self._crowd.now - ages
            velocities = self._crowd.states[:, VX : VY + 1]
            movers = self._crowd.states[:, X : Y + 1] + since[:, None, None] * velocities
        directions = bearings + (self._config.lidar_yaw or 0.0) + headings
        return measure_ranges((from_x, from_y), directions, self._scene.world, movers)

    def run(self, duration: float | None = None, until: Callable[[], bool] = lambda: False) -> None:
        """Run the emulator with absolute deadlines. After a long delay they restart from now.

        Args:
            duration: Time to run [s]. None for no limit.
            until: Called in every loop. Ends the run by returning True.

        Raises:
            ConfigError: `duration` is negative or not finite.
        """
        if duration is not None and not 0.0 <= duration < math.inf:
            raise ConfigError(f"duration = {duration:g}: must be a finite number of seconds")
        start = time.monotonic()
        deadline = start

        while not until() and (duration is None or deadline - start < duration):
            deadline += self._period
            # The emulator catches up with short delays, so that time isn't lost.
            remaining = deadline - time.monotonic()
            if remaining < -LONGEST_CATCH_UP:
                deadline -= remaining
                self.lost -= remaining
                self._log_event(lost=-remaining)
            time.sleep(max(0.0, remaining))
            self.run_loop()

    def run_loop(self) -> None:
        """Run one loop of the firmware: receive, simulate, send."""
        # A signal handler may have changed it.
        if self.plugged != bool(self.device):
            if self.plugged:
                self._cable.plug()
            else:
                self._cable.pull()
            self._log_event(device=self.device)

        data = self._cable.read()
        if data:
            self._log_event(rx=data.decode("latin-1"))

            # The first bytes of a client are the start of the episode.
            if self._is_awaited:
                self._start_episode()
                self._is_awaited = False
            self._link.write(self._cable.over_uart(data))
        answer = self._link.advance(self._period)
        self._last_pose = self._pose
        self._pose = self._true_pose()
        if self._lidar is not None:
            self._lidar.serve_once(self._period)

        # The truth, which no client can read from the wire.
        event: dict[str, object] = {"pose": self._pose}
        if self._crowd is not None and self._crowd.hit != NO_HIT:
            event["hit"] = self._crowd.hit
            self._crowd.hit = NO_HIT
        self._log_event(**event)
        if answer and self.device and not self._silent:
            self._cable.write(self._cable.over_uart(answer))

    def _log_event(self, **event: object) -> None:
        if self._log is None:
            return
        try:
            self._log.write(json.dumps({"t": time.monotonic(), **event}) + "\n")
        except OSError as error:  # such as a full disk
            with contextlib.suppress(OSError):  # it would write the line again
                self._log.close()
            raise _log_error(self._log.name, error) from error

    def close(self) -> None:
        """Unplug the cable and close terminals and log. Idempotent."""
        self._opened.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _open_log(path: Path) -> TextIO:
    try:
        return path.open("w", buffering=1, encoding="ascii")
    except OSError as error:
        raise _log_error(str(path), error) from error


def _log_error(name: str, error: OSError) -> ConfigError:
    return ConfigError(f"{name}: can't be written: {explain_error(error)}")


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
    """Paths of the emulated devices, and the number of the process that serves them."""

    process: int
    robot: str
    lidar: str | None = None


@contextlib.contextmanager
def run_emulator(*arguments: str) -> Iterator[EmulatedDevices]:
    """Run `acsar-gym emulate` in another process, as a context manager.

    It ends with the context, or with this process, even if that is killed. Ctrl-C reaches only
    this process.

    Args:
        *arguments: Command line arguments of `emulate`. With "--lidar" there are two devices.

    Yields:
        Paths of the emulated devices, and the process.

    Raises:
        LinkError: The emulator didn't start.
    """
    # A session of its own, so that Ctrl-C doesn't reach it.
    command = [sys.executable, "-c", EMULATOR_PROGRAM, "emulate", *arguments]
    pipe = subprocess.PIPE

    with subprocess.Popen(
        command, stdin=pipe, stdout=pipe, text=True, start_new_session=True
    ) as process:
        try:
            devices = []
            for _ in range(1 + ("--lidar" in arguments)):
                line = process.stdout.readline() if process.stdout else ""
                device = line.strip().split(" ")[-1]
                if not device.startswith("/"):
                    raise LinkError(
                        "the emulator didn't start",
                        f"run 'acsar-gym emulate {' '.join(arguments)}' to see why",
                    )
                devices.append(device)
            yield EmulatedDevices(process.pid, *devices)
        finally:
            process.kill()
