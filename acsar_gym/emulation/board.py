"""Emulates the board in real time on a pseudo-terminal, to exercise all serial code.

A program that opens the printed device talks to a simulated robot in the same way as to a board. A
wrong baud rate garbles both directions, as on a UART. The log has one JSON line per event: what was
sent to the board, and the true poses of the robot, with times of the machine's monotonic clock.
"""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.emulation.pty import Cable
from acsar_gym.emulation.quirks import QuirkyLink, of_config, parsed
from acsar_gym.emulation.rplidar import RplidarEmulator, RplidarTwin
from acsar_gym.errors import ConfigError
from acsar_gym.links import Link, open_link
from acsar_gym.protocol import encode
from acsar_gym.reading import lines
from acsar_gym.worlds import Pose, Scene, World
from acsar_gym.worlds.geometry import look

Floats = NDArray[np.float64]
STALL = 0.5
"""A delay by the operating system is caught up with, unless it is longer than this [s]. Drivers
give up after 0.5 s without feedback by default; until then they take it that the robot goes on."""
WARM_UP = 0.05
"""Simulated time before a client can connect [s]."""
SAMPLES = 200
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
        odd = parsed(quirks)
        config = of_config(odd, config)
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
            self._log = lines.opened(log) if log else None
            if self._log is not None:
                ours.callback(self._log.close)
            self._cable = Cable(config.baud_rate, name)
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
            if remaining < -STALL:
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
            lines.written(self._log, json.dumps({"t": time.monotonic(), **event}) + "\n")

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
    link.advance(WARM_UP)


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
        return look((x, y), bearings + theta, world)

    return RplidarEmulator(RplidarTwin(ranges, rate=config.lidar.rate, samples=SAMPLES))
