"""The driver of one robot: sends commands over a Link, decodes feedback, and keeps odometry."""

from __future__ import annotations

import contextlib
import functools
import gc
import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from acsar_gym import kinematics
from acsar_gym.config import RobotConfig
from acsar_gym.errors import (
    EmergencyStopError,
    LinkError,
    SafetyWarning,
    WheelError,
    escape_unprintable,
)
from acsar_gym.guard.estop import StopListener, check_released, release_process
from acsar_gym.links.base import WHILE_WAITING, Link, arrivals_of
from acsar_gym.links.lateness import EpisodeStopwatch, EpisodeTiming
from acsar_gym.links.recorded import record_link
from acsar_gym.odometry import Odometry
from acsar_gym.protocol import ZERO, Decoder, Speeds
from acsar_gym.recording import Recorder
from acsar_gym.recording.encoder import Fault, Scanned, Tick
from acsar_gym.safety.layer import Safety
from acsar_gym.safety.wheel_watch import WheelWatch
from acsar_gym.sensors import Factory, Sensor, Sensors
from acsar_gym.sensors.lidar import find_lidar
from acsar_gym.sensors.suite import sensor_factories
from acsar_gym.wire import Wire
from acsar_gym.worlds import Scene

NO_TIMEOUT = (
    "this robot's board doesn't stop by itself (firmware.command_timeout: null): its wheels keep "
    "turning where the cable falls out or this computer fails; add a time-out to its program"
)
UNWATCHED = (
    "nothing stops this robot's wheels where this program hangs or is killed, the cable falls out "
    "or this computer fails: there is no watchdog ({}), and its board doesn't stop by itself "
    "(firmware.command_timeout: null); add a time-out to its program"
)
Method = TypeVar("Method", bound=Callable[..., Any])


def _deactivating(method: Method) -> Method:
    """Make any error of a method deactivate the robot."""

    @functools.wraps(method)
    def guarded(robot: Robot, *args: Any, **kwargs: Any) -> Any:
        try:
            return method(robot, *args, **kwargs)
        except BaseException as error:
            robot.deactivate(error)
            raise

    return guarded  # type: ignore[return-value]


class Robot:
    """Drives the robot, real or simulated, behind `link`.

    Attributes: `link`, `config`, `odometry`; `wire`, the lines to and from the board; `safety`,
    with the twist really sent and why it isn't the one asked for; `sensors`, the LiDAR first;
    `shares`, the wheel speeds [rad/s] that odometry integrated in the newest tick, and for how long
    each held [s].

    As a context manager it is active inside the block, and stopped and closed on any way out of it.

    Args:
        link: the wire to the robot.
        config: its parameters; None is the ACSAR robot.
        sensors: names ("lidar", "mine.rays:ThreeRays"), factories (subclasses of Sensor) or ready
            sensors. The robot owns them: it resets, polls and closes them.
        recorder: records what the robot does; the robot owns it as well.
    """

    def __init__(
        self,
        link: Link,
        config: RobotConfig | None = None,
        sensors: Iterable[str | Sensor | Factory] = (),
        recorder: Recorder | None = None,
    ) -> None:
        self.config = RobotConfig.of(config)
        self.link = link = record_link(link, recorder, self.config)
        self.odometry = Odometry.of(self.config)
        self.sensors = Sensors(sensor_factories(sensors), link, self.config, self.odometry)
        self.wire = Wire(link, self.config)
        self.shares: list[tuple[Speeds, float]] = []
        self.active = False
        self.safety = Safety(self.config)
        self._recorder = recorder
        self._scanned = -math.inf
        self._listener: StopListener | None = None
        self._held = self._warned = False
        self._stopwatch: EpisodeStopwatch | None = None
        self._watch: WheelWatch | None = None
        self._lateness: float | None = None
        self._period = self.config.period
        self._clocked = self.sensors.clocked

    def activate(self) -> None:
        """Reset, if the robot isn't active. Errors as for `reset`."""
        if not self.active:
            self.reset(Scene())

    @_deactivating
    def reset(self, scene: Scene, rng: np.random.Generator | None = None) -> None:
        """Open the link, stop, wait for standstill, and reset odometry and sensors.

        Warns (SafetyWarning) where `acsar-gym estop` can't reach a real robot, and where its board
        has no command time-out, the more so where there is no watchdog either.

        Args:
            scene: start, goal, world and physics; only simulated links use it.
            rng: for the noise of sensors; None for a new one with seed 0.

        Raises:
            LinkError: link or sensors don't work, the board is silent, or the wheels keep turning.
            EmergencyStopError: nobody has released an emergency stop, of any robot of this process.
        """
        self._listen_for_stops()
        token = WHILE_WAITING.set(self._check_released)
        try:
            self._begin(scene, np.random.default_rng(0) if rng is None else rng)
        finally:
            WHILE_WAITING.reset(token)
        if self.link.truth is None and not self._warned:  # an open link knows its watchdog
            self._warned = True
            if self.config.firmware.command_timeout is None:
                unwatched = getattr(self.link, "unwatched", "")
                said = UNWATCHED.format(unwatched) if unwatched else NO_TIMEOUT
                warnings.warn(said, SafetyWarning, 3)

    @_deactivating
    def connect(self) -> None:
        """Open the link and hear emergency stops, before an episode. Errors as for `reset`."""
        self._listen_for_stops()
        token = WHILE_WAITING.set(self._check_released)
        try:
            self._open_link()
        finally:
            WHILE_WAITING.reset(token)

    def _listen_for_stops(self) -> None:
        """Hear emergency stops of a real robot from now on."""
        if self.link.truth is None and self._listener is None:
            check_released()
            file = "" if self._recorder is None else self._recorder.file
            device = getattr(self.link, "device", "")
            self._listener = StopListener(device, self.config.name, file)
            self._listener.warn()
            self._warned = False

    def _open_link(self) -> None:
        self._check_released()
        if not self.active:
            self.link.open()
            self.active = True

    def _begin(self, scene: Scene, rng: np.random.Generator) -> None:
        """Open the link, and begin an episode; not after an emergency stop."""
        self._open_link()
        self.link.reset(scene)
        self.safety.reset()
        self.wire.reset()
        self._stopwatch = self._watch = None
        self.wire.settle()
        self.odometry.reset()
        if self.link.lateness is not None:
            gc.collect()  # takes 60 ms, so it is done before the wheels turn
            self._stopwatch = EpisodeStopwatch(self.config)
            if self.link.truth is None and self.config.wheel_check:
                self._watch = WheelWatch(self.config, getattr(self.link, "device", "DEVICE"))
        self.sensors.reset(scene, rng)
        self._scanned = -math.inf
        self._record_scan()

    @_deactivating
    def read(self) -> NDArray[np.float64]:
        """Return the numbers of all sensors, (sum of their sizes,), as in an observation.

        Raises:
            AcsarError: a sensor gives something else than its finite numbers.
            LinkError: a sensor's device fails.
        """
        numbers = self.sensors.read()
        self._record_scan()
        return numbers

    @_deactivating
    def add_sensor_info(self, info: dict[str, float]) -> None:
        """Add the sensors' info to an env's; ConfigError where it has one of the keys already."""
        self.sensors.info(info)

    @_deactivating
    def tick(self, speeds: Sequence[float]) -> None:
        """Do one control period: send four wheel speeds, read feedback, update odometry.

        All are scaled by one factor where one exceeds `max_wheel_speed`, or their twist the speed
        limits; only `drive` limits acceleration. Zeros are sent while `safety` holds the robot. Any
        error deactivates the robot.

        Args:
            speeds: four [rad/s], in the order front right, front left, rear left, rear right.

        Raises:
            CommandError: unless `speeds` are four finite numbers.
            LinkError: not active, link lost or silent for `feedback_timeout`, or a sensor fails.
        """
        self.check_estop()
        pose, age = self.odometry.pose, self.wire.age
        self._exchange(self.safety.bounded(speeds, pose, age))
        if self._clocked:
            self.sensors.poll()
        if self._recorder is not None:
            radii, separation = self.config.wheel_radii, self.config.effective_separation
            a, b, c, d = map(float, speeds)
            self._record_tick(*kinematics.compute_twist(a, b, c, d, *radii, separation))

    @_deactivating
    def drive(self, linear: float, angular: float) -> None:
        """Do one control period towards a twist, within the limits; (0, 0) stops at once.

        Errors as for `tick`.

        Args:
            linear: velocity [m/s], forward positive.
            angular: velocity [rad/s], counter-clockwise positive.
        """
        self.check_estop()
        pose, age = self.odometry.pose, self.wire.age
        self._exchange(self.safety.allowed(linear, angular, pose, age))
        if self._clocked:
            self.sensors.poll()
        if self._recorder is not None:
            self._record_tick(linear, angular)

    @_deactivating
    def listen(self) -> None:
        """Do one control period without a command, as where the board's own time-out is measured.

        Errors as for `tick`.
        """
        self.check_estop()
        self._exchange(None)
        self._record_tick(math.nan, math.nan)

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

    def check_estop(self) -> None:
        """Stop where `acsar-gym estop` asks for it, as every tick does.

        For programs that wait between two episodes: `safety.stopped` says whether it was asked for.

        Raises:
            LinkError: the robot isn't active.
        """
        if not self.active:
            raise LinkError("the robot isn't active", "call activate() or env.reset() first")
        if self._listener is not None and self._listener.is_requested():
            self._answer_stop(self._listener)

    def _answer_stop(self, listener: StopListener) -> None:
        """Stop, and answer whether that has reached the board."""
        reached = False
        try:
            self.safety.estop()
            self.stop()
            reached = self.active
        finally:
            listener.confirm(connected=reached)

    def _check_released(self) -> None:
        """Hear requests; raise EmergencyStopError where a stop holds."""
        if self._listener is None:
            if self._held:
                raise EmergencyStopError
            return
        if self._held:
            self._listener.hold()
            self._held = False
        if self._listener.is_requested():
            self._answer_stop(self._listener)
        check_released()

    @property
    def timing(self) -> EpisodeTiming | None:
        """How late ticks were since the reset; None for simulated links, whose time is exact."""
        return self._stopwatch.summary() if self._stopwatch else None

    def wheel_speeds(self, linear: float, angular: float) -> Speeds:
        """Return the wheel speeds [rad/s] of a twist; `max_wheel_speed` keeps its turn radius.

        Args:
            linear: velocity [m/s].
            angular: velocity [rad/s].
        """
        return self.safety.wheels(linear, angular)

    def estop(self) -> None:
        """Emergency stop: command zero now, and hold zero.

        `reset` and `activate` fail until somebody releases the stop: `release_estop`, `acsar-gym
        estop --release`, or `r` in `acsar-gym drive`. With real wheels this holds for all robots of
        this process.
        """
        if self._listener is None:
            self._held = True
        else:
            self._listener.hold()
        self.safety.estop()
        self.stop()

    def release_estop(self) -> None:
        """Release emergency stops; the next reset lets the robot drive again.

        For a person to call, who has looked after the robot, and not for a program on its own. With
        real wheels it releases all robots of this process.
        """
        self._held = False
        if self.link.truth is None:
            release_process()

    def stop(self) -> None:
        """Send a zero command; no time passes."""
        self.safety.halt(self.safety.reason)
        if self.active:
            self.wire.send(ZERO)

    def close(self, error: BaseException | None = None) -> None:
        """Command zero, close link, sensors and recording; idempotent.

        Args:
            error: what ended the drive; the recording tells it.
        """
        try:
            self.deactivate(error)
        finally:
            if self._listener is not None:
                self._listener.close()
                self._listener = None
            self.sensors.close()
            if self._recorder is not None:
                self._recorder.close()

    def deactivate(self, error: BaseException | None = None) -> None:
        """Command zero and close the link; idempotent. Sensors stay open.

        Args:
            error: what ended the episode; the recording tells it.
        """
        if not self.active:
            return
        try:
            with contextlib.suppress(LinkError):
                self.stop()
        finally:
            self.active = False
            self.link.close()
        if self._recorder is not None and isinstance(error, Exception):
            self._recorder.add(Fault(self.link.now(), str(error)))

    def _exchange(self, speeds: Speeds | None) -> None:
        """Send wheel speeds, if any, let one control period pass, and update odometry."""
        wire = self.wire
        heard, dt = wire.exchange(speeds)
        self.shares = wire.shares(heard, dt)
        for wheel_speeds, share in self.shares:
            self.odometry.update(wheel_speeds, share)
        if self._stopwatch is not None:
            self._lateness = self._stopwatch.tick(self.link.lateness or 0.0, wire.age)
            fastest = max(map(abs, wire.speeds))
            if self._stopwatch.commanded(wire.written, fastest, drives=any(speeds or ZERO)):
                self._stopwatch.heard(arrivals_of(self.link), wire.stamp)
        if self._watch is not None and speeds is not None:
            try:
                self._watch.tick(speeds, wire.speeds, dt, fresh=bool(heard))
            except WheelError as error:
                if not wire.decoder.notes:
                    raise
                reported = (
                    f"{error.found}; the board says {escape_unprintable(wire.decoder.notes[-1])}"
                )
                raise WheelError(reported, error.fix, error.wheel) from error
        elif self._watch is not None:
            self._watch.reset()  # the board may stop the wheels by itself

    def _record_tick(self, linear: float, angular: float) -> None:
        """Record a tick in which a twist was asked for [m/s, rad/s]; NaN where none was."""
        if self._recorder is None:
            return
        wire = self.wire
        tick = Tick(
            self._recorder.number - 1,
            wire.stamp,
            self.odometry.pose,
            self.odometry.twist,
            wire.speeds,
            self.odometry.wheel_positions,
            (float(linear), float(angular)),
            self.safety.sent,
            self.safety.reason,
            self._lateness,
            wire.age,
            sum(wire.decoder.refused.values()),
        )
        self._recorder.add(tick)
        self._record_scan(1.0 / self.config.lidar.rate - 0.5 * self._period)  # if nobody reads it

    def _record_scan(self, pause: float = 0.0) -> None:
        """Record the scan, unless the newest recorded one was read less than a pause before [s]."""
        lidar, stamp = find_lidar(self.sensors), self.wire.stamp
        if self._recorder is None or lidar is None or stamp - self._scanned <= pause:
            return
        self._scanned = stamp
        number = self._recorder.number - 1
        self._recorder.add(Scanned(number, stamp, lidar.scan.ranges, lidar.revolution))

    def __reduce__(self) -> tuple[Callable[..., Robot], tuple[Any, ...]]:
        """Copies and pickles are inactive robots with a link and sensors of their own."""
        return Robot, (self.link, self.config, tuple(self.sensors))

    def __enter__(self) -> Self:
        self.activate()
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self.close(error)
