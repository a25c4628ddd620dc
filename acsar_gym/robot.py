"""The driver of one robot: sends commands over a Link, decodes feedback, and keeps odometry."""

from __future__ import annotations

import contextlib
import gc
import warnings
from collections.abc import Iterable, Sequence
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LinkError, SafetyWarning
from acsar_gym.journal import Journal
from acsar_gym.lidars.factory import factories
from acsar_gym.links.base import Link, arrivals_of
from acsar_gym.links.lateness import EpisodeTiming, Stopwatch
from acsar_gym.links.recorded import recorded
from acsar_gym.odometry import Odometry
from acsar_gym.protocol import ZERO, Decoder, Speeds
from acsar_gym.recording import Recorder
from acsar_gym.safety.estop import StopListener
from acsar_gym.safety.layer import Safety
from acsar_gym.safety.wheel_watch import WheelWatch
from acsar_gym.sensors import Factory, Sensor, Sensors
from acsar_gym.wire import Wire
from acsar_gym.worlds import Scene


class Robot:
    """Drives the robot, real or simulated, behind `link`.

    Attributes: `link`, `config`, `odometry`; `wire`, the lines to and from the board; `safety`,
    with the twist that was really sent and the reason where it isn't the one asked for; `sensors`,
    the LiDAR first.

    As a context manager it is active inside the block, and stopped and closed on any way out of it.

    Args:
        link: The wire to the robot.
        config: Its parameters; None is the ACSAR robot.
        sensors: Names ("lidar", "mine.rays:ThreeRays"), factories (subclasses of Sensor) or ready
            sensors. The robot owns them: it resets, polls and closes them.
        recorder: Records what the robot does; the robot owns it as well.
    """

    def __init__(
        self,
        link: Link,
        config: RobotConfig | None = None,
        sensors: Iterable[str | Sensor | Factory] = (),
        recorder: Recorder | None = None,
    ) -> None:
        self.config = RobotConfig.of(config)
        self.link = link = recorded(link, recorder, self.config)
        self.sensors = Sensors(factories(sensors), link, self.config)
        self.odometry = Odometry(
            self.config.wheel_radius,
            self.config.wheel_separation,
            self.config.wheel_separation_multiplier,
            left_wheel_radius_multiplier=self.config.left_wheel_radius_multiplier,
            right_wheel_radius_multiplier=self.config.right_wheel_radius_multiplier,
        )
        self.wire = Wire(link, self.config)
        self.active = False
        self.safety = Safety(self.config)
        self._journal = Journal(recorder, link, self.config, self.wire, self.safety, self.sensors)
        self._listener: StopListener | None = None
        self._stopwatch: Stopwatch | None = None
        self._watch: WheelWatch | None = None
        self._period = self.config.period
        self._clocked, self._recorded = self.sensors.clocked, recorder is not None

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
            self.safety.reset()
            self.wire.reset()
            self._stopwatch = self._watch = None
            self.wire.settle()
        except BaseException as error:
            self.deactivate(error)
            raise
        self.odometry.reset()
        if self.link.lateness is not None:
            gc.collect()  # takes 60 ms, so it is done before the wheels turn
            self._stopwatch = Stopwatch(self._period)
            if self.link.truth is None and self.config.wheel_check:
                self._watch = WheelWatch(self.config, getattr(self.link, "device", "DEVICE"))
        try:
            self.sensors.reset(scene, np.random.default_rng(0) if rng is None else rng)
            self._journal.began()
        except BaseException as error:
            self.deactivate(error)
            raise

    def read(self) -> NDArray[np.float64]:
        """Read the numbers of all sensors, as in an observation.

        Any error deactivates the robot.
        """
        try:
            return self.sensors.read()
        except BaseException as error:
            self.deactivate(error)
            raise

    def tell(self, info: dict[str, float]) -> None:
        """Add the sensors' info to an env's. Errors as for `read`."""
        try:
            self.sensors.info(info)
        except BaseException as error:
            self.deactivate(error)
            raise

    def _listen(self) -> None:
        """Listen for `acsar-gym estop`; a warning where that is impossible."""
        device = getattr(self.link, "device", "")
        self._listener = StopListener(device, self.config.name, self._journal.recording)
        if self._listener.unavailable:
            said = f"'acsar-gym estop' can't stop this robot: {self._listener.unavailable}"
            warnings.warn(said, SafetyWarning, stacklevel=4)

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
            pose, age = self.odometry.pose, self.wire.age
            self._exchange(self.safety.bounded(speeds, pose, age))
            if self._clocked:
                self.sensors.poll()
            self._journal.turned(self.odometry, speeds)
        except BaseException as error:
            self.deactivate(error)
            raise

    def drive(self, linear: float, angular: float) -> None:
        """Do one control period towards a twist (linear [m/s], angular [rad/s]), within the limits.

        (0, 0) stops at once. Errors as for `tick`.
        """
        try:
            self._heed()
            pose, age = self.odometry.pose, self.wire.age
            self._exchange(self.safety.allowed(linear, angular, pose, age))
            if self._clocked:
                self.sensors.poll()
            if self._recorded:
                self._journal.ticked(self.odometry, linear, angular)
        except BaseException as error:
            self.deactivate(error)
            raise

    def listen(self) -> None:
        """Do one control period without a command, as where the board's own time-out is measured.

        Errors as for `tick`.
        """
        try:
            self._heed()
            self._exchange(None)
            self._journal.listened(self.odometry)
        except BaseException as error:
            self.deactivate(error)
            raise

    @property
    def decoder(self) -> Decoder:
        """The wire's decoder."""
        return self.wire.decoder

    @property
    def speeds(self) -> Speeds:
        """The newest wheel speeds [rad/s]."""
        return self.wire.speeds

    @property
    def feedback_age(self) -> float:
        """Time since the newest valid line [s]."""
        return self.wire.age

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
            self.wire.send(ZERO)

    def close(self, error: BaseException | None = None) -> None:
        """Command zero, close link, sensors and recording, which tells `error`; idempotent."""
        try:
            self.deactivate(error)
        finally:
            self.sensors.close()
            self._journal.close()

    def deactivate(self, error: BaseException | None = None) -> None:
        """Command zero, close the link, record `error`; idempotent. Sensors stay open."""
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
        self._journal.ended(error)

    def _exchange(self, speeds: Speeds | None) -> None:
        """Send wheel speeds, if any, let one control period pass, and update odometry."""
        wire = self.wire
        heard, dt = wire.exchange(speeds)
        self._integrate(heard, dt)
        if self._stopwatch is not None:
            self._stopwatch.tick(self.link.lateness or 0.0, wire.age)
            fastest = max(map(abs, wire.speeds))
            if self._stopwatch.commanded(wire.written, fastest, drives=any(speeds or ZERO)):
                self._stopwatch.heard(arrivals_of(self.link), wire.stamp)
        if self._watch is not None and speeds is not None:
            self._watch.tick(speeds, wire.speeds, dt, fresh=bool(heard))
        elif self._watch is not None:
            self._watch.reset()  # the board may stop the wheels by itself

    def _integrate(self, heard: list[Speeds], dt: float) -> None:
        """Update odometry with the newest speeds; after a pause, with all, each for its share."""
        if dt > 2.0 * self._period and len(heard) > 1:
            for speeds in heard:
                self.odometry.update(speeds, dt / len(heard))
        else:
            self.odometry.update(self.wire.speeds, dt)

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
        self.close(error)
