"""The microcontroller's twin in real time on a pseudo-terminal, for every serial code path.

Whoever opens the printed device talks to a simulated robot exactly as to a board. A wrong baud rate
garbles both directions, as on a real UART. The log, one JSON line per event, holds what was sent
to the board and where the robot really was, on the monotonic clock that all processes share.
"""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.emulation.pty import Cable
from acsar_gym.emulation.rplidar import RplidarEmulator, RplidarTwin
from acsar_gym.errors import ConfigError
from acsar_gym.links import Link, open_link, recording
from acsar_gym.worlds import Pose, Scene, World
from acsar_gym.worlds.geometry import look

Floats = NDArray[np.float64]
STALL = 0.1
"""Time lost to the operating system is made up for, unless it was this long at once [s]."""
SAMPLES = 200
"""Measurements of the LiDAR in a turn: 2000 a second at 10 Hz, as an RPLIDAR A1 makes them."""


class Emulator:
    """A simulated robot on a pseudo-terminal; `device` is what a SerialLink opens.

    `silent` never answers; `log` gets one JSON line per piece of input and, every loop, the true
    pose in the world. The robot stands at the start of `world`, or at the origin of an open floor;
    with `sees`, an RPLIDAR's twin looks around in it, and `lidar_device` is what its driver opens.

    `plugged` may be set to False and True at any time, from signal handlers too: the cable is
    pulled, and plugged in again as another device, which `name`, a symbolic link, follows.
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
    ) -> None:
        if body not in ("planar", "bullet"):
            raise ConfigError(f"body = {body!r}: must be planar or bullet")
        self._config = config
        self._silent = silent
        self.plugged = True
        with contextlib.ExitStack() as ours:
            self._link: Link = open_link(body, config)
            ours.callback(self._link.close)
            self._link.open()
            self._link.reset(Scene() if world is None else Scene(_start(world), world=world))
            self._lidar = _lidar(self._link, world, config) if sees else None
            if self._lidar is not None:
                ours.callback(self._lidar.close)
            self.lidar_device = self._lidar.device if self._lidar else None
            self._log = recording.opened(log) if log else None
            if self._log is not None:
                ours.callback(self._log.close)
            self._cable = Cable(config.baud_rate, name)
            ours.callback(self._cable.pull)
            self._ours = ours.pop_all()

    @property
    def device(self) -> str:
        """What a SerialLink opens; "" while the cable is out."""
        return self._cable.device

    def run(self, duration: float | None = None, until: Callable[[], bool] = lambda: False) -> None:
        """Emulate for `duration` [s], or until told or interrupted; deadlines are absolute.

        After a stall they start anew from now, for a board has no time to catch up with.
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
            time.sleep(max(0.0, remaining))
            self._turn(period)

    def _turn(self, period: float) -> None:
        """One loop of the firmware: bytes in, physics, bytes out."""
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
        if self.plugged:
            self._cable.plug()
        else:
            self._cable.pull()
        self._note({"device": self.device})

    def _over_uart(self, data: bytes) -> bytes:
        """The bytes as the other side sees them: garbage where the baud rates differ."""
        if self._cable.sound:
            return data
        return bytes((byte * 7 + 0x80) & 0xFF | 0x80 for byte in data)

    def _note(self, event: dict[str, object]) -> None:
        if self._log is not None:
            recording.written(self._log, json.dumps({"t": time.monotonic(), **event}) + "\n")

    def close(self) -> None:
        """Pull the cable, close terminals and log; twice is once."""
        self._ours.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _start(world: World) -> Pose:
    return world.start.x, world.start.y, world.start.theta or 0.0


def _lidar(link: Link, world: World | None, config: RobotConfig) -> RplidarEmulator:
    """A sensor that turns at the configured rate, where the robot carries it."""

    def ranges(bearings: Floats) -> Floats:
        x, y, theta = link.truth.pose if link.truth else (0.0, 0.0, 0.0)
        cos, sin = math.cos(theta), math.sin(theta)
        x += cos * config.lidar_x_offset - sin * config.lidar_y_offset
        y += sin * config.lidar_x_offset + cos * config.lidar_y_offset
        return look((x, y), bearings + theta, world)

    return RplidarEmulator(RplidarTwin(ranges, rate=config.lidar.rate, samples=SAMPLES))
