"""The driver of one robot: sends commands over a Link, decodes feedback, and keeps odometry."""

from __future__ import annotations

import contextlib
import gc
import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import (
    EmergencyStopError,
    LinkError,
    SafetyWarning,
    WheelError,
    escape_unprintable,
)
from acsar_gym.guard.estop import (
    StopListener,
    check_released,
    hold_process,
    release_process,
)
from acsar_gym.links.base import WHILE_WAITING, Link
from acsar_gym.links.lateness import EpisodeStopwatch, EpisodeTiming
from acsar_gym.odometry import Odometry
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.safety.layer import Safety
from acsar_gym.safety.wheel_check import WheelCheck
from acsar_gym.sensors import Factory, Sensor, Sensors
from acsar_gym.sensors.suite import sensor_factories
from acsar_gym.wire import Wire
from acsar_gym.worlds import Scene

NO_TIMEOUT = (
    "this robot's board doesn't stop by itself (firmware.command_timeout: null): its wheels keep "
    "turning if the cable falls out or this computer fails; add a time-out to its program"
)
UNWATCHED = (
    "nothing stops this robot's wheels if this program hangs or is killed, the cable falls out "
    "or this computer fails: there is no watchdog ({}), and its board doesn't stop by itself "
    "(firmware.command_timeout: null); add a time-out to its program"
)


class StepResult(NamedTuple):
    """What an environment's step, or its reset, returns to a policy."""

    step: int
    """Number of the step. 0 for the reset."""
    observation: NDArray[np.float32]
    reward: float = math.nan
    terminated: bool = False
    truncated: bool = False
    is_success: bool = False


class DriveObserver:
    """Gets to know what a `Robot` does. A recorder is an observer.

    A robot owns its observer, and closes it.
    """

    def watch(self, link: Link, config: RobotConfig) -> Link:
        """Return the link that the robot shall use, such as a wrapper that records its bytes."""
        return link

    def describe(self, info: Mapping[str, Any], **about: Any) -> None:
        """Called by an environment before it resets the robot.

        Args:
            info: Seed, goal, start and world of the episode, ready for JSON.
            about: What holds for all episodes: the env, its task, and names of observations.
        """

    def after_tick(self, robot: Robot, linear: float, angular: float) -> None:
        """Called after a control period.

        Args:
            robot: The robot.
            linear: Commanded velocity [m/s]. NaN if nothing was sent.
            angular: Commanded turn rate [rad/s]. NaN if nothing was sent.
        """

    def after_read(self, robot: Robot) -> None:
        """Called when the sensors have been reset or read."""

    def after_step(
        self, robot: Robot, result: StepResult, action: NDArray[np.floating] | None = None
    ) -> None:
        """Called by an environment after a step, or after a reset, which has no action."""

    def after_error(self, robot: Robot, error: Exception) -> None:
        """Called when an error has deactivated the robot."""

    def close(self) -> None:
        """Called when the robot is closed. Idempotent."""


class Robot:
    """Drives the robot, real or simulated, behind a link.

    As a context manager it is active inside the block, and stopped and closed on each way out.

    Attributes:
        link: The wire to the robot.
        config: Robot configuration.
        odometry: Pose and twist from the wheel speeds.
        wire: Lines to and from the board.
        safety: Safety layer, with the twist that was sent, and why it isn't the commanded twist.
        sensors: Sensors, the LiDAR first.
        shares: Wheel speeds [rad/s] that odometry integrated in the newest tick, and how long each
            held [s].
        lateness: Lateness of the newest tick [s]. None for the first tick, and in simulation.
        active: Whether the link is open, and the robot can be driven.

    Args:
        link: The wire to the robot.
        config: Robot configuration. None is the ACSAR robot.
        sensors: Names ("lidar", "mine.rays:ThreeRays"), factories (subclasses of Sensor) or ready
            sensors. The robot owns them: it resets, polls and closes them.
        recorder: Gets to know what the robot does.

    Example:
        >>> from acsar_gym import Robot, open_link
        >>> with Robot(open_link("planar")) as robot:
        ...     for _ in range(100):
        ...         robot.drive(0.2, 0.0)
        ...     round(robot.odometry.pose[0], 1)
        0.2
    """

    def __init__(
        self,
        link: Link,
        config: RobotConfig | None = None,
        sensors: Iterable[str | Sensor | Factory] = (),
        recorder: DriveObserver | None = None,
    ) -> None:
        self.config = RobotConfig.of(config)
        self._observer = recorder or DriveObserver()
        self.link = self._observer.watch(link, self.config)
        self.odometry = Odometry.of(self.config)
        self.sensors = Sensors(
            sensor_factories(sensors), self.link, self.config, odometry=self.odometry
        )
        self.wire = Wire(self.link, self.config)
        self.safety = Safety(self.config)

        self.shares: list[tuple[Speeds, float]] = []
        self.lateness: float | None = None
        self.active = False
        self._polls_sensors = self.sensors.clocked
        self._stops: StopListener | None = None
        self._stopwatch: EpisodeStopwatch | None = None
        self._wheel_check: WheelCheck | None = None
        self._is_held = False
        self._has_warned = False

    def activate(self) -> None:
        """Reset, unless the robot is active. Errors as for `reset`."""
        if not self.active:
            self.reset(Scene())

    def reset(self, scene: Scene, rng: np.random.Generator | None = None) -> None:
        """Open the link, stop, wait for standstill, and reset odometry and sensors.

        Warns (SafetyWarning) if `acsar-gym estop` can't reach a real robot, or if its board has no
        command time-out.

        Args:
            scene: Start, goal, world and physics. Only simulated links use it.
            rng: Generator for the noise of sensors. None for a new generator with seed 0.

        Raises:
            LinkError: Link or sensors don't work, the board is silent, or the wheels keep turning.
            EmergencyStopError: An emergency stop of any robot of this process isn't released yet.
        """
        try:
            with self._heeding_stops():
                self._open_link()
                self._start_episode(scene, rng or np.random.default_rng(0))

            if self.link.is_real and not self._has_warned:  # an open link knows its watchdog
                self._has_warned = True
                if self.config.firmware.command_timeout is None:
                    reason = self.link.unwatched
                    warnings.warn(
                        UNWATCHED.format(reason) if reason else NO_TIMEOUT,
                        SafetyWarning,
                        stacklevel=2,
                    )
        except BaseException as error:
            self.deactivate(error)
            raise

    def connect(self) -> None:
        """Open the link and listen for emergency stops before an episode. Errors as for `reset`."""
        try:
            with self._heeding_stops():
                self._open_link()
        except BaseException as error:
            self.deactivate(error)
            raise

    @contextlib.contextmanager
    def _heeding_stops(self) -> Iterator[None]:
        """Listen for emergency stops of a real robot, also while something is waited for."""
        if self.link.is_real and self._stops is None:
            check_released()
            self._stops = StopListener()
            self._stops.warn()
            self._has_warned = False

        # Waits of links and sensors call this again and again.
        token = WHILE_WAITING.set(self._check_released)
        try:
            yield
        finally:
            WHILE_WAITING.reset(token)

    def _check_released(self) -> None:
        """Answer requests. Raise EmergencyStopError while a stop holds."""
        if self._is_held:
            raise EmergencyStopError
        if self.link.is_real:
            if self.active:
                self.check_estop()
            check_released()

    def _open_link(self) -> None:
        self._check_released()
        if not self.active:
            self.link.open()
            self.active = True
            if self._stops is not None:
                self._stops.connect()

    def _start_episode(self, scene: Scene, rng: np.random.Generator) -> None:
        """Wait until the wheels are at rest, and reset what belongs to an episode."""
        # The link first: the rest starts from its clock and its wheels at rest.
        self.link.reset(scene)
        self.safety.reset()
        # Bytes and times of the episode before don't count any more.
        self.wire.reset()
        self._stopwatch = None
        self._wheel_check = None
        self.lateness = None
        self.wire.settle()
        self.odometry.reset()

        if self.link.lateness is not None:
            gc.collect()  # it takes 60 ms, so do it before the wheels turn
            self._stopwatch = EpisodeStopwatch(self.config)
        # Simulated wheels follow commands as well as the physics of an episode allows.
        if self.link.is_real and self.config.wheel_check:
            self._wheel_check = WheelCheck(self.config, self.link.device or "DEVICE")

        self.sensors.reset(scene, rng)
        self._observer.after_read(self)

    def read(self) -> NDArray[np.float64]:
        """Return the numbers of all sensors, (sum of their sizes,), as in an observation.

        Raises:
            AcsarError: A sensor returns something else than its finite numbers.
            LinkError: A sensor's device fails.
        """
        try:
            numbers = self.sensors.read()
            self._observer.after_read(self)
        except BaseException as error:
            self.deactivate(error)
            raise
        return numbers

    def add_sensor_info(self, info: dict[str, float]) -> None:
        """Add the sensors' info to an env's. ConfigError if it has one of the keys already."""
        try:
            self.sensors.info(info)
        except BaseException as error:
            self.deactivate(error)
            raise

    def tick(self, speeds: Sequence[float]) -> None:
        """Do one control period: send four wheel speeds, read feedback, update odometry.

        All speeds are scaled by one factor if a speed exceeds `max_wheel_speed`, or their twist the
        speed limits. Only `drive` limits acceleration. Zeros are sent while `safety` holds the
        robot. Any error deactivates the robot.

        Args:
            speeds: Four speeds [rad/s], in the order front right, front left, rear left, rear
                right.

        Raises:
            CommandError: `speeds` aren't four finite numbers.
            LinkError: Not active, link lost or silent for `feedback_timeout`, or a sensor fails.
        """
        try:
            self.check_estop()
            self._exchange(self.safety.bounded(speeds, self.odometry.pose, self.wire.age))
            self._observer.after_tick(self, *self.safety.twist(map(float, speeds)))
        except BaseException as error:
            self.deactivate(error)
            raise

    def drive(self, linear: float, angular: float) -> None:
        """Do one control period towards a twist, within the limits. (0, 0) stops at once.

        Errors as for `tick`.

        Args:
            linear: Velocity [m/s], forward positive.
            angular: Turn rate [rad/s], counter-clockwise positive.
        """
        try:
            self.check_estop()
            self._exchange(self.safety.allowed(linear, angular, self.odometry.pose, self.wire.age))
            self._observer.after_tick(self, linear, angular)
        except BaseException as error:
            self.deactivate(error)
            raise

    def listen(self) -> None:
        """Do one control period without a command, to measure the board's own time-out.

        Errors as for `tick`.
        """
        try:
            self.check_estop()
            self._exchange(None)
            self._observer.after_tick(self, math.nan, math.nan)
        except BaseException as error:
            self.deactivate(error)
            raise

    def _exchange(self, speeds: Speeds | None) -> None:
        """Send wheel speeds, if any, let one control period pass, and update odometry."""
        lines, duration = self.wire.exchange(speeds)
        # Odometry takes each line for as long as it held, also if several arrived.
        self.shares = self.wire.shares(lines, duration)
        for wheel_speeds, share in self.shares:
            self.odometry.update(wheel_speeds, share)

        if self._stopwatch is not None:
            self._measure_timing(self._stopwatch, speeds or ZERO)
        if self._wheel_check is not None:
            self._check_wheels(self._wheel_check, speeds, duration, fresh=bool(lines))
        # Last, as sensors use the odometry of this tick.
        if self._polls_sensors:
            self.sensors.poll()

    def _measure_timing(self, stopwatch: EpisodeStopwatch, speeds: Speeds) -> None:
        self.lateness = stopwatch.tick(self.link.lateness or 0.0, self.wire.age)
        fastest = max(map(abs, self.wire.speeds))
        if stopwatch.commanded(self.wire.written, fastest, drives=any(speeds)):
            stopwatch.heard(self.link.arrivals, self.wire.stamp)

    def _check_wheels(
        self, check: WheelCheck, speeds: Speeds | None, duration: float, *, fresh: bool
    ) -> None:
        """Compare measured with commanded speeds. WheelError quotes what the board reports."""
        if speeds is None:
            check.reset()  # the board may stop the wheels by itself
            return
        try:
            check.tick(speeds, self.wire.speeds, duration, fresh=fresh)
        except WheelError as error:
            # Boards often state the cause in a line of text.
            notes = self.wire.decoder.notes
            if not notes:
                raise
            report = f"{error.found}; the board reports {escape_unprintable(notes[-1])}"
            raise WheelError(report, error.fix, error.wheel) from error

    @property
    def speeds(self) -> Speeds:
        """The newest wheel speeds [rad/s]."""
        return self.wire.speeds

    @property
    def feedback_age(self) -> float:
        """Time since the newest valid line [s]."""
        return self.wire.age

    @property
    def timing(self) -> EpisodeTiming | None:
        """Timing of the ticks since the reset. None for simulated links, whose time is exact."""
        return self._stopwatch.summary() if self._stopwatch else None

    def wheel_speeds(self, linear: float, angular: float) -> Speeds:
        """Return the wheel speeds [rad/s] of a twist. `max_wheel_speed` keeps its turn radius.

        Args:
            linear: Velocity [m/s].
            angular: Turn rate [rad/s].
        """
        return self.safety.wheels(linear, angular)

    def check_estop(self) -> None:
        """Stop if `acsar-gym estop` requests it, as every tick does.

        Programs that wait between two episodes call this. `safety.stopped` is True after a request.

        Raises:
            LinkError: The robot isn't active.
        """
        if not self.active:
            raise LinkError("the robot isn't active", "call activate() or env.reset() first")
        # Stop before confirming: `acsar-gym estop` relies on the answer.
        if self._stops is not None and self._stops.is_requested():
            self.safety.estop()
            self.stop()
            self._stops.confirm()

    def estop(self) -> None:
        """Emergency stop: command zero now, and hold zero.

        `reset` and `activate` fail until a person releases the stop: `release_estop`, `acsar-gym
        estop --release`, or `r` in `acsar-gym drive`. With real wheels this holds for all robots of
        this process.
        """
        # All robots of a process share the button that a person presses.
        if self.link.is_real:
            hold_process()
        else:
            self._is_held = True
        self.safety.estop()
        self.stop()
        if self._stops is not None:
            self._stops.confirm()

    def release_estop(self) -> None:
        """Release emergency stops. The next reset lets the robot drive again.

        For a person to call, who has looked after the robot, not for a program. With real wheels it
        releases all robots of this process.
        """
        self._is_held = False
        if self.link.is_real:
            release_process()

    def stop(self) -> None:
        """Send a zero command. No time passes."""
        self.safety.halt(self.safety.reason)
        if self.active:
            self.wire.send(ZERO)

    def deactivate(self, error: BaseException | None = None) -> None:
        """Command zero and close the link. Idempotent. Sensors stay open.

        Args:
            error: What ended the episode, for the recording.
        """
        if not self.active:
            return
        # A lost link can't be commanded, but is closed all the same.
        try:
            with contextlib.suppress(LinkError):
                self.stop()
        finally:
            self.active = False
            self.link.close()
            if self._stops is not None:
                self._stops.disconnect()
        # KeyboardInterrupt is no fault of the robot.
        if isinstance(error, Exception):
            self._observer.after_error(self, error)

    def close(self, error: BaseException | None = None) -> None:
        """Command zero, close link, sensors and recording. Idempotent.

        Args:
            error: What ended the drive, for the recording.
        """
        try:
            self.deactivate(error)
        finally:
            if self._stops is not None:
                self._stops.close()
                self._stops = None
            # Recording ends last, so that it has the stop.
            self.sensors.close()
            self._observer.close()

    def __reduce__(self) -> tuple[type[Robot], tuple[Any, ...]]:
        """Copies and pickles are inactive robots with their own link and sensors."""
        return Robot, (self.link, self.config, tuple(self.sensors))

    def __enter__(self) -> Self:
        self.activate()
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self.close(error)
