"""The driver of one robot: sends commands over a Link, decodes feedback, and keeps odometry."""

from __future__ import annotations

import contextlib
import gc
import math
import warnings
from collections.abc import Iterable, Sequence
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LinkError, SafetyWarning
from acsar_gym.lidars.factory import factories
from acsar_gym.links.base import Link
from acsar_gym.links.handshake import silence, still_turning
from acsar_gym.links.lateness import EpisodeTiming, Stopwatch
from acsar_gym.odometry import Odometry
from acsar_gym.protocol import ZERO, Decoder, Reading, Speeds, line_end, line_of
from acsar_gym.safety import rules
from acsar_gym.safety.estop import StopListener
from acsar_gym.safety.layer import Safety
from acsar_gym.sensors import Factory, Sensor, Sensors
from acsar_gym.worlds import Scene

STANDSTILL = 0.1
"""Wheels slower than this count as standing still [rad/s]."""
STANDSTILL_TIMEOUT = 5.0
"""How long a reset waits for the wheels to stand still [s]."""
STANDSTILL_TICKS = 2
"""How many fresh readings in a row must show standstill."""


class Robot:
    """Drives the robot, real or simulated, behind `link`.

    Attributes: `link`, `config`, `odometry`; `speeds`, the newest wheel speeds [rad/s], old ones
    for motors that a line doesn't name; `feedback_age`, the time since the last valid line [s];
    `decoder`, with the counters of refused input; `safety`, with the twist that was really sent
    and the reason where it isn't the one asked for; `sensors`, the LiDAR first.

    As a context manager it is active inside the block, and stopped and closed on any way out of it.

    Args:
        link: The wire to the robot.
        config: Its parameters; None is the ACSAR robot.
        sensors: Names ("lidar", "mine.rays:ThreeRays"), factories (subclasses of Sensor) or ready
            sensors. The robot owns them: it resets, polls and closes them.
    """

    def __init__(
        self,
        link: Link,
        config: RobotConfig | None = None,
        sensors: Iterable[str | Sensor | Factory] = (),
    ) -> None:
        self.link = link
        self.config = RobotConfig.of(config)
        self.sensors = Sensors(factories(sensors), link, self.config)
        self.odometry = Odometry(
            self.config.wheel_radius,
            self.config.wheel_separation,
            self.config.wheel_separation_multiplier,
        )
        self.decoder = Decoder()
        self.speeds: Speeds = ZERO
        self.feedback_age = 0.0
        self.active = False
        self.safety = Safety(self.config)
        self._listener: StopListener | None = None
        self._stopwatch: Stopwatch | None = None
        self._stamp = 0.0
        self._period = self.config.period
        self._end = line_end(trailing_comma=self.config.trailing_comma)
        self._encoded: Speeds = ZERO
        self._command = line_of(*ZERO, self._end)
        self._rules = rules.of(self.config)
        self._clocked = self.sensors.clocked

    def activate(self) -> None:
        """Reset, if the robot isn't active. Errors as for `reset`."""
        if not self.active:
            self.reset(Scene())

    def reset(self, scene: Scene, rng: np.random.Generator | None = None) -> None:
        """Open the link, stop, wait for standstill, and reset odometry and sensors.

        Where this raises, the link is closed. Warns (SafetyWarning) where `acsar-gym estop` can't
        reach a real robot. `rng` is for the noise of sensors.

        Raises:
            LinkError: link or sensors don't work, the board is silent, or the wheels keep turning.
        """
        if not self.active:
            self.link.open()
            self.active = True
        try:
            if self.link.truth is None and self._listener is None:
                self._listen()
            self.link.reset(scene)
            self.decoder.reset()
            self.safety.reset()
            self.speeds = ZERO
            self.feedback_age = 0.0
            self._stamp = self.link.now()
            self._stopwatch = None
            self._settle()
        except BaseException:
            self.deactivate()
            raise
        self.odometry.reset()
        if self.link.lateness is not None:
            gc.collect()  # takes 60 ms, so it is done before the wheels turn
            self._stopwatch = Stopwatch(self._period)
        try:
            self.sensors.reset(scene, np.random.default_rng(0) if rng is None else rng)
        except BaseException:
            self.deactivate()
            raise

    def read(self) -> NDArray[np.float64]:
        """Read the numbers of all sensors, as in an observation.

        Any error deactivates the robot.
        """
        try:
            return self.sensors.read()
        except BaseException:
            self.deactivate()
            raise

    def tell(self, info: dict[str, float]) -> None:
        """Add the sensors' info to an env's. Errors as for `read`."""
        try:
            self.sensors.info(info)
        except BaseException:
            self.deactivate()
            raise

    def _listen(self) -> None:
        """Listen for `acsar-gym estop`; a warning where that is impossible."""
        self._listener = StopListener()
        if self._listener.unavailable:
            said = f"'acsar-gym estop' can't stop this robot: {self._listener.unavailable}"
            warnings.warn(said, SafetyWarning, stacklevel=4)

    def _settle(self) -> None:
        """Command zero until the wheels stand still.

        Counts ticks, so that clock jumps don't matter.
        """
        standing = 0
        for _ in range(math.ceil(STANDSTILL_TIMEOUT / self._period)):
            self._exchange(ZERO)
            if self.feedback_age == 0.0:
                still = max(map(abs, self.speeds)) < STANDSTILL
                standing = standing + 1 if still else 0
            if standing == STANDSTILL_TICKS:
                return
        if max(map(abs, self.speeds)) < STANDSTILL:
            raise silence(self.feedback_age, sum(self.decoder.refused.values()))
        raise still_turning(STANDSTILL_TIMEOUT, self.speeds)

    def tick(self, speeds: Sequence[float]) -> None:
        """Do one control period: send four wheel speeds [rad/s], read feedback, update odometry.

        All are scaled by one factor where one exceeds `max_wheel_speed`, or their twist the speed
        limits; only `drive` limits acceleration. Zeros are sent while `safety` holds the robot. Any
        error deactivates the robot.

        Raises:
            CommandError: unless `speeds` are four finite numbers.
            LinkError: not active, link lost or silent for `feedback_timeout`, or a sensor fails.
        """
        try:
            self._heed()
            pose, age = self.odometry.pose, self.feedback_age
            self._exchange(self.safety.bounded(speeds, pose, age))
            if self._clocked:
                self.sensors.poll()
        except BaseException:
            self.deactivate()
            raise

    def drive(self, linear: float, angular: float) -> None:
        """Do one control period towards a twist (linear [m/s], angular [rad/s]), within the limits.

        (0, 0) stops at once. Errors as for `tick`.
        """
        try:
            self._heed()
            pose, age = self.odometry.pose, self.feedback_age
            self._exchange(self.safety.allowed(linear, angular, pose, age))
            if self._clocked:
                self.sensors.poll()
        except BaseException:
            self.deactivate()
            raise

    def _heed(self) -> None:
        """Stop where a stop was requested; LinkError where the robot isn't active."""
        if not self.active:
            raise LinkError("the robot isn't active", "call activate() or env.reset() first")
        if self._listener is not None and self._listener.is_requested():
            self.estop()
            self._listener.confirm()

    @property
    def timing(self) -> EpisodeTiming | None:
        """How late ticks were since the reset; None for simulated links, whose time is exact."""
        return self._stopwatch.summary() if self._stopwatch else None

    def wheel_speeds(self, linear: float, angular: float) -> Speeds:
        """Wheel speeds [rad/s] for a twist, scaled to `max_wheel_speed` at the same turn radius."""
        return self.safety.wheels(linear, angular)

    def estop(self) -> None:
        """Emergency stop: command zero now, and hold zero until the next reset."""
        self.safety.estop()
        self.stop()

    def stop(self) -> None:
        """Send a zero command; no time passes."""
        self.safety.halt(self.safety.reason)
        if self.active:
            self.link.write(self._line(ZERO))

    def close(self) -> None:
        """Command zero, close the link and the sensors; idempotent."""
        try:
            self.deactivate()
        finally:
            self.sensors.close()

    def deactivate(self) -> None:
        """Command zero, then close the link; idempotent. Sensors stay open for the next reset."""
        if not self.active:
            return
        try:
            with contextlib.suppress(LinkError):
                self.stop()
        finally:
            self.active = False
            if self._listener is not None:
                self._listener.close()
                self._listener = None
            self.link.close()

    def _exchange(self, speeds: Speeds) -> None:
        link = self.link
        if self._stopwatch is not None:
            turns = max(map(abs, self.speeds)) > STANDSTILL
            self._stopwatch.asked(self._stamp, drives=any(speeds), turns=turns)
        link.write(self._line(speeds))
        readings = self.decoder.feed(link.advance(self._period))
        stamp = link.now()
        dt = stamp - self._stamp
        self._stamp = stamp
        self.feedback_age = 0.0 if readings else self.feedback_age + dt
        self._integrate(readings, dt)
        if self._stopwatch is not None:
            self._stopwatch.tick(link.lateness or 0.0, self.feedback_age)
        if rules.silent(self.feedback_age, self._rules):
            raise silence(self.feedback_age, sum(self.decoder.refused.values()))

    def _line(self, speeds: Speeds) -> bytes:
        """The command line; encoded again only where the tuple of speeds is another object."""
        if speeds is not self._encoded:
            self._encoded, self._command = speeds, line_of(*speeds, self._end)
        return self._command

    def _integrate(self, readings: list[Reading], dt: float) -> None:
        """Update odometry with the newest reading; after a pause, with all, each for its share."""
        paused = dt > 2.0 * self._period and len(readings) > 1
        for reading in readings:
            self.speeds = reading.over(self.speeds)
            if paused:
                self.odometry.update(self.speeds, dt / len(readings))
        if not paused:
            self.odometry.update(self.speeds, dt)

    def __reduce__(self) -> tuple[type[Robot], tuple[Link, RobotConfig, tuple[Sensor, ...]]]:
        """Copies and pickles are inactive robots with a link and sensors of their own."""
        return Robot, (self.link, self.config, tuple(self.sensors))

    def __enter__(self) -> Self:
        self.activate()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
