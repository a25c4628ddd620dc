"""LiDARs: the contract, the sensor that observes their ranges, and the replayed one."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.config.footprint import Outline, outline_reach
from acsar_gym.errors import LidarError, show_value
from acsar_gym.links.base import Link, ScannedLink
from acsar_gym.odometry import Odometry
from acsar_gym.physics.body import GroundTruth
from acsar_gym.recording.types import MAX_DISTANCE, MAX_STAMP
from acsar_gym.sensors.base import LIDAR, Sensor
from acsar_gym.sensors.scan import (
    FULL_TURN,
    Revolution,
    Scan,
    Trail,
    fill_scan,
    make_rays,
    ray_spec,
)
from acsar_gym.sensors.simulated import OLDEST_SIMULATED, SimulatedLidar, draw_episode
from acsar_gym.worlds import Scene
from acsar_gym.worlds.geometry import RaySpec

STALE_PERIODS = 2.0
"""A scan that is older than this many periods of the LiDAR counts as stale."""
MAX_AHEAD = 60.0
"""A revolution may end so long after the time on the link's clock, and reconnect_timeout: that
stands still where the link is recorded and a device starts. One further ahead has another clock
[s]."""


class Lidar(Protocol):
    """A LiDAR, simulated or real. Times are on the clock of the robot's link.

    One that must see every tick, as the simulated one does, has a method `poll(truth, now)` as
    well; see `Sensor.poll`.
    """

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Begin an episode; opens a device that is closed.

        Args:
            scene: the world, and the robot's start in it.
            rng: for the noise.

        Raises:
            LidarError: the device can't be opened, or doesn't measure.
        """

    def scan(self) -> Revolution:
        """Return the newest complete revolution; doesn't wait for one.

        Raises:
            LidarError: the device is gone. That a revolution is older than the configured time-out
                is found out by `LidarSensor`.
        """

    def close(self) -> None:
        """Stop the motor and close the device; idempotent."""


class LidarSensor(Sensor):
    """Adds a LiDAR's ranges to the observation: range / `max_range`, 0 to 1, one for each ray.

    It remembers where the robot was, by its odometry, and tells what the newest revolution's
    measurements mean for where the robot is now; see `scan.fill_scan`.

    Attributes: `lidar`, which measures, at its own rate; `revolution`, its newest at the end of the
    last tick; `scan`, what it means now.
    """

    name, low, high = LIDAR, 0.0, 1.0

    def __init__(self, lidar: Lidar, config: RobotConfig) -> None:
        self.lidar = lidar
        self.config = config
        self.size = config.lidar.rays
        self._poll_lidar: Any = getattr(lidar, "poll", None)
        self.uses_truth = self._poll_lidar is not None
        self._odometry = Odometry.of(config)
        self._rays = make_rays(config)
        self._trail = self._make_trail()
        self._now = 0.0
        self._revolution: Revolution | None = None
        self._checked: tuple[Revolution, Revolution] | None = None
        """As the LiDAR handed it over, and as compiled loops may have it."""
        self._scan: Scan | None = None
        nothing = np.zeros(0)  # compiles, before a robot waits for it
        fill_scan(nothing, nothing, nothing, self._trail.rows, 0, self._rays, np.empty(self.size))

    def _make_trail(self) -> Trail:
        """Reach back to the oldest measurement of the oldest revolution that isn't an error.

        An episode's simulated LiDAR may turn more slowly than the configured one.
        """
        config, reach = self.config, self.config.lidar.timeout + 1.0 / self.config.lidar.rate
        if isinstance(self.lidar, SimulatedLidar | ReplayedLidar):
            reach = max(reach, self.lidar.oldest)
        return Trail(reach, config.period)

    @property
    def revolution(self) -> Revolution:
        """The newest revolution at the end of the last tick. LidarError before a reset."""
        if self._trail.newest < 0:
            raise LidarError("the LiDAR has no scan yet", "call reset() first")
        if self._revolution is None:
            self._revolution = self._measure()
        return self._revolution

    def _measure(self) -> Revolution:
        """Take over the newest revolution.

        One that isn't our own is checked when it is new, and its age always.
        """
        newest = self.lidar.scan()
        if isinstance(self.lidar, SimulatedLidar):
            return newest
        named = type(self.lidar).__name__
        if self._checked is None or newest is not self._checked[0]:
            self._checked = newest, check_revolution(newest, named)
        checked = self._checked[1]
        if not isinstance(self.lidar, ReplayedLidar):  # in simulation it has no time-out
            check_age(named, checked, self._now, self.config)
        return checked

    @property
    def scan(self) -> Scan:
        """The scan at the end of the last tick. LidarError before a reset."""
        bearings, distances, times, stamp = self.revolution
        if self._scan is None:
            ranges = np.empty(self.size)
            measured, trail = (bearings, distances, times), self._trail
            fill_scan(*measured, trail.rows, trail.newest, self._rays, ranges)
            self._scan = Scan(ranges, stamp)
        return self._scan

    def follow(self, odometry: Odometry) -> None:
        """Take over the robot's odometry."""
        self._odometry = odometry

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Begin an episode; opens a device that is closed. LidarError where that fails."""
        self.lidar.reset(scene, rng)
        self._trail = self._make_trail()

    def poll(self, truth: GroundTruth | None, now: float) -> None:
        """Mark where the robot is.

        Raises:
            LidarError: the newest scan is too old, or the device is gone.
        """
        self._now = now
        self._trail.mark(now, self._odometry.pose)
        self._revolution = self._scan = None
        if self._poll_lidar is None:
            self._revolution = self._measure()
        else:
            self._poll_lidar(truth, now)

    def read(self, truth: GroundTruth | None, now: float) -> NDArray[np.float64]:
        """Return range / `max_range` of each ray, (rays,)."""
        return self.scan.ranges / self.config.lidar.max_range

    def info(self, now: float) -> dict[str, float]:
        """`scan_age` [s], and `scan_stale`: 1 where the age is over two periods of the LiDAR."""
        age = max(now - self.scan.stamp, 0.0)  # a recorded link's clock stands still at a reset
        return {"scan_age": age, "scan_stale": float(age > stale_after(self.config))}

    def close(self) -> None:
        """Stop the motor and close the device; idempotent."""
        self.lidar.close()

    @property
    def layout(self) -> str:
        """Number of rays, field of view and longest range, in words."""
        lidar = self.config.lidar
        return f"{lidar.rays} ranges over {lidar.field_of_view:.4g} rad to {lidar.max_range:g} m"


def check_revolution(made: Revolution, source: str) -> Revolution:
    """Check what a LiDAR measured before compiled loops get it.

    Args:
        made: by the LiDAR; lists will do as well.
        source: name of the LiDAR, for messages.

    Returns:
        The same in arrays of float64.

    Raises:
        LidarError: it isn't a Revolution, or one of its fields is none of finite numbers, or out
            of the range that a recording can have.
    """
    fix = "see acsar_gym.sensors.scan.Revolution"
    try:
        bearings, distances, times = (np.ascontiguousarray(made[k], np.float64) for k in range(3))
        checked = Revolution(bearings, distances, times, float(made[3]))
    except (TypeError, ValueError, IndexError, KeyError):
        raise LidarError(
            f"{source}.scan() gave {show_value(made)}: must be a Revolution of numbers", fix
        ) from None
    values: Any
    for name, values in zip(Revolution._fields, checked, strict=True):
        shape = () if name == "stamp" else (len(bearings),)
        if np.shape(values) != shape:
            raise LidarError(
                f"{source}.scan(): {name} has shape {np.shape(values)}, bearings "
                f"{bearings.shape}: must be one number each for n measurements",
                fix,
            )
        if not np.isfinite(values).all():
            raise LidarError(
                f"{source}.scan(): {name} = {show_value(np.asarray(values).tolist())}: must be "
                "finite",
                fix + "; a distance that wasn't measured is 0",
            )
    for name, low, high, unit in (
        ("bearings", -FULL_TURN, FULL_TURN, "rad"),
        ("distances", 0.0, MAX_DISTANCE, "m"),
        ("times", -MAX_STAMP, MAX_STAMP, "s"),
        ("stamp", -MAX_STAMP, MAX_STAMP, "s"),
    ):
        values = np.atleast_1d(getattr(checked, name))
        wrong = values[(values < low) | (values > high)]
        if len(wrong):
            raise LidarError(
                f"{source}.scan(): {name} has {wrong[0]:g}: must be {low:.4g} to {high:.4g} {unit}",
                fix,
            )
    return checked


def check_age(source: str, revolution: Revolution, now: float, config: RobotConfig) -> None:
    """Check that a LiDAR still measures, by the clock of the robot's link.

    Args:
        source: name of the LiDAR, for messages.
        revolution: its newest one.
        now: on that clock [s].
        config: of the robot.

    Raises:
        LidarError: the revolution is older than lidar.timeout, or further ahead than it can be.
    """
    newest, timeout = revolution.stamp, config.lidar.timeout
    if now - newest > timeout:
        raise LidarError(
            f"{source}: no complete turn for {now - newest:.2f} s (lidar.timeout = {timeout:g} s)",
            "check its power and that its head turns freely, then reset",
        )
    newest = max(newest, revolution.times.max(initial=newest))
    if newest - now > MAX_AHEAD + config.reconnect_timeout:
        raise LidarError(
            f"{source}: measured {newest - now:g} s after now by the link's clock",
            "its times and stamp must be on that clock: see acsar_gym.links.base.clock_of",
        )


def find_lidar(sensors: Sequence[Sensor]) -> LidarSensor | None:
    """The LiDAR among a robot's sensors; None without one."""
    for sensor in sensors[:2]:  # the map may come before it
        if isinstance(sensor, LidarSensor):
            return sensor
    return None


def newest_scan(sensors: Sequence[Sensor]) -> Scan | None:
    """The newest scan of the LiDAR among a robot's sensors; None without a LiDAR."""
    lidar = find_lidar(sensors)
    return None if lidar is None else lidar.scan


def footprint_edges(config: RobotConfig) -> NDArray[np.float64]:
    """Distance from the LiDAR to the edge of the footprint along each ray, (rays,) [m]."""
    return _edges(config.outline, ray_spec(config), config.lidar_x_offset, config.lidar_y_offset)


@lru_cache(maxsize=16)
def _edges(outline: Outline, rays: RaySpec, x: float, y: float) -> NDArray[np.float64]:
    """As `footprint_edges`; the same array for the same robot."""
    return outline_reach(outline, (x, y), rays.angles())


def stale_after(config: RobotConfig) -> float:
    """Age from which a scan counts as stale [s]."""
    return STALE_PERIODS / config.lidar.rate


class ReplayedLidar:
    """Plays the revolutions of a recording, beside the bytes of its wire.

    Args:
        tape: the link that replays it.
        link: the robot's link, with the recorded ground truth where the recording was a simulation.
    """

    oldest = 0.0
    """Age that a measurement of a simulated LiDAR reaches in the episode, at most [s]."""

    def __init__(self, tape: ScannedLink, link: Link) -> None:
        self._tape = tape
        self._link = link
        self._measured: NDArray[np.float64] | None = None
        self._newest: Revolution | None = None

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Begin an episode."""
        self._newest = None
        if self._link.truth is not None:
            draw_episode(rng)  # as the simulated LiDAR did here
            self.oldest = min(self._tape.oldest_measurement(), OLDEST_SIMULATED)

    def scan(self) -> Revolution:
        """Return the revolution that was the newest one; LidarError where none was recorded."""
        found = self._tape.revolution()
        if found is None:
            raise LidarError(
                "the recording has no revolutions of a LiDAR",
                "it was made without one, or by a version that kept no more than the scans: "
                "record again",
            )
        stamp, measured = found
        if self._newest is None or measured is not self._measured:
            self._measured = measured
            self._newest = Revolution(measured[0], measured[1], measured[2], stamp)
        return self._newest

    def close(self) -> None:
        """Do nothing: there is no device."""
