"""Emulates the board in real time on a pseudo-terminal, here or in a process of its own.

A program that opens the printed device talks to a simulated robot in the same way as to a board, so
all serial code is exercised. A wrong baud rate garbles both directions, as on a UART. The log has
one JSON line per event: what was sent to the board, the true poses of the robot, and whether it
touches somebody, with times of the machine's monotonic clock.
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
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.links import Link, open_link
from acsar_gym.physics.bodies import BODIES
from acsar_gym.protocol import encode
from acsar_gym.tools.emulation.cable import EmulatedCable
from acsar_gym.tools.emulation.lidar import LidarEmulator, RplidarTwin
from acsar_gym.worlds import Scene
from acsar_gym.worlds.crowd import NO_HIT, VX, VY, X, Y
from acsar_gym.worlds.geometry import measure_ranges

Floats = NDArray[np.float64]
LONGEST_CATCH_UP = 0.5
"""A delay by the operating system is caught up with, unless it is longer than this [s]. Drivers
give up after 0.5 s without feedback by default; until then they take it that the robot goes on."""
WARM_UP_TIME = 0.05
"""Simulated time before a client can connect [s]."""
LOG_MARK = '{"t": '
"""How a log begins."""
PATIENCE = {"watchdog_timeout": 5.0, "feedback_timeout": 10.0, "connect_timeout": 60.0}
"""How an emulated robot is driven where the computer may be busy: it can hurt nobody [s]."""
LIDAR_SAMPLES = 200
"""Measurements of the LiDAR per turn: 2000/s at 10 Hz, as an RPLIDAR A1 has."""


class Emulator:
    """A simulated robot on a pseudo-terminal.

    Set `plugged` to False and True, at any time and also in signal handlers, to pull the cable and
    plug it in again under a new device name.

    Args:
        config: configuration of the robot.
        body: name of a simulated link, such as "planar".
        log: file for one JSON line per received chunk, per loop the true pose (world frame) and,
            in a tick in which the robot touches a mover, who hit whom (see `worlds.crowd`), and
            lost time; None for no log.
        silent: never answer.
        scene: where the robot stands; None for the origin of an open floor. Among movers the
            episode begins with the first bytes that a client sends.
        sees: also emulate an RPLIDAR, at `lidar_device`.
        name: symbolic link that always points to the current device; None for no link.
        make_link: makes the simulated robot of a body's name and the config.

    Raises:
        ConfigError: for an unknown body, or if `log` or `name` can't be created.
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
        make_link: Callable[[str, RobotConfig], Link] = open_link,
    ) -> None:
        if body not in BODIES:
            raise ConfigError(f"body = {body!r}: must be {' or '.join(BODIES)}")
        self._period = 1.0 / config.firmware.loop_rate
        self._silent = silent
        self.plugged = True
        self.lost = 0.0
        """Time that wasn't simulated, because the process was delayed for too long [s]."""
        with contextlib.ExitStack() as ours:
            self._link = make_link(body, config)
            ours.callback(self._link.close)
            self._scene = scene or Scene()
            # Compile what moves a robot, which would silence the board for a second at first.
            self._link.reset(self._scene)
            self._link.write(encode((1.0, 1.0, 1.0, 1.0)))
            self._link.advance(WARM_UP_TIME)
            self._begin_episode()
            self._is_awaited = self._crowd is not None
            """Whether movers wait for a client."""
            self._lidar = ours.enter_context(self._make_lidar(config)) if sees else None
            self.lidar_device = self._lidar.device if self._lidar else None
            self._log = log.open("w", buffering=1, encoding="ascii") if log else None
            if self._log is not None:
                ours.callback(self._log.close)
            self._cable = EmulatedCable(config.baud_rate, name)
            ours.callback(self._cable.pull)
            self._ours = ours.pop_all()

    def _begin_episode(self) -> None:
        """Put the robot and what moves around it where an episode begins."""
        self._link.reset(self._scene)
        truth = self._link.truth
        self._crowd = truth.crowd if truth else None
        self._poses = self._true_pose(), self._true_pose()
        """Before and after the newest loop."""

    def _make_lidar(self, config: RobotConfig) -> LidarEmulator:
        """Make an emulated LiDAR at its place on the robot, at the configured rate."""

        def look(bearings: Floats, ages: Floats) -> Floats:
            """Return ranges [m], each from where the robot was when it was measured.

            The robot goes evenly from its pose before the loop to that after it; movers go on from
            their newest tick.
            """
            (x0, y0, theta0), (x, y, theta) = self._poses
            back = np.minimum(ages / self._period, 1.0)
            turned = math.remainder(theta - theta0, 2.0 * math.pi)
            headings = theta - back * turned
            cos, sin = np.cos(headings), np.sin(headings)
            across, along = config.lidar_y_offset, config.lidar_x_offset
            from_x = x - back * (x - x0) + cos * along - sin * across
            from_y = y - back * (y - y0) + sin * along + cos * across
            crowd, moved = self._crowd, None
            if crowd is not None:
                since = self._link.now() - crowd.now - ages
                places, velocities = crowd.states[:, X : Y + 1], crowd.states[:, VX : VY + 1]
                moved = places + since[:, None, None] * velocities
            return measure_ranges((from_x, from_y), bearings + headings, self._scene.world, moved)

        return LidarEmulator(RplidarTwin(look, rate=config.lidar.rate, samples=LIDAR_SAMPLES))

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
        start = deadline = time.monotonic()
        while not until() and (duration is None or deadline - start < duration):
            deadline += self._period
            remaining = deadline - time.monotonic()
            if remaining < -LONGEST_CATCH_UP:
                deadline -= remaining
                self.lost -= remaining
                self._log_event({"lost": -remaining})
            time.sleep(max(0.0, remaining))
            self._run_loop()

    def _run_loop(self) -> None:
        """Run one loop of the firmware: receive, simulate, send."""
        if self.plugged != bool(self.device):
            if self.plugged:
                self._cable.plug()
            else:
                self._cable.pull()
            self._log_event({"device": self.device})
        data = self._cable.read()
        if data:
            self._log_event({"rx": data.decode("latin-1")})
            if self._is_awaited:
                self._begin_episode()
                self._is_awaited = False
            self._link.write(self._cable.over_uart(data))
        answer = self._link.advance(self._period)
        self._poses = self._poses[1], self._true_pose()
        if self._lidar is not None:
            self._lidar.serve_once(self._period)
        event: dict[str, object] = {"pose": self._poses[1]}
        if self._crowd is not None and self._crowd.hit != NO_HIT:
            event["hit"] = self._crowd.hit
            self._crowd.hit = NO_HIT
        self._log_event(event)
        if answer and self.device and not self._silent:
            self._cable.write(self._cable.over_uart(answer))

    def _true_pose(self) -> tuple[float, float, float]:
        """Where the robot is, in the frame of the world [m, m, rad]."""
        return self._link.truth.pose if self._link.truth else (0.0, 0.0, 0.0)

    def _log_event(self, event: dict[str, object]) -> None:
        if self._log is not None:
            self._log.write(json.dumps({"t": time.monotonic(), **event}) + "\n")

    def close(self) -> None:
        """Unplug the cable and close terminals and log. Idempotent."""
        self._ours.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


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
    """Paths of the emulated devices, and the number of the process that serves them."""

    process: int
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
        Paths of the emulated devices, and the process.

    Raises:
        LinkError: the emulator didn't start.
    """
    command = [sys.executable, "-c", EMULATOR_PROGRAM, "emulate", *arguments]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            devices = []
            for _ in range(1 + ("--lidar" in arguments)):
                line = process.stdout.readline() if process.stdout else ""
                devices.append(line.strip().split(" ")[-1])
                if not devices[-1].startswith("/"):
                    raise LinkError(
                        "the emulator didn't start",
                        f"run 'acsar-gym emulate {' '.join(arguments)}' to see why",
                    )
            yield EmulatedDevices(process.pid, *devices)
        finally:
            process.terminate()
            try:
                process.wait(EMULATOR_END_TIMEOUT)
            except subprocess.TimeoutExpired:
                process.kill()
