"""The sensor that observes the ranges of a LiDAR."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.config.footprint import Outline, outline_reach
from acsar_gym.errors import LidarError
from acsar_gym.lidar.contract import Lidar, check_age, check_revolution
from acsar_gym.lidar.replayed import ReplayedLidar
from acsar_gym.lidar.scan import Revolution, Scan, Trail, fill_scan, make_rays, ray_spec
from acsar_gym.lidar.simulated import SimulatedLidar
from acsar_gym.odometry import Odometry
from acsar_gym.sensors.sensor import LIDAR, Floats, Sensor, SensorInput, find_sensor
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds.geometry import RaySpec

STALE_PERIODS = 2.0
"""A scan that is older than this many periods of the LiDAR counts as stale."""


class LidarSensor(Sensor):
    """Adds a LiDAR's ranges to the observation: range / `max_range`, 0 to 1, one for each ray.

    It remembers where the robot was, by its odometry, and computes what the newest revolution's
    measurements mean for where the robot is now, see `scan.fill_scan`.

    Attributes:
        lidar: The LiDAR, which measures at its own rate.
        revolution: Its newest revolution at the end of the last tick.
        scan: What that means now.
    """

    name = LIDAR
    low = 0.0
    high = 1.0

    def __init__(self, lidar: Lidar, config: RobotConfig) -> None:
        self.lidar = lidar
        self.config = config
        self.size = config.lidar.rays
        self._poll_lidar: Any = getattr(lidar, "poll", None)
        self.odometry = Odometry.of(config)
        self._rays = make_rays(config)
        self._trail = self._make_trail()
        self._now = 0.0
        self._revolution: Revolution | None = None
        self._unchecked: Revolution | None = None
        self._checked: Revolution
        self._scan: Scan | None = None

        # Compile the loop before a robot waits for it.
        nothing = Revolution(np.zeros(0), np.zeros(0), np.zeros(0), 0.0)
        fill_scan(nothing, self._trail.ring, self._rays, np.empty(self.size))

    def _make_trail(self) -> Trail:
        """Reach back to the oldest measurement of the oldest revolution that isn't an error.

        An episode's simulated LiDAR may turn more slowly than the configured one.
        """
        config = self.config
        reach = config.lidar.timeout + 1.0 / config.lidar.rate
        if isinstance(self.lidar, SimulatedLidar | ReplayedLidar):
            reach = max(reach, self.lidar.oldest)
        return Trail(reach, config.period)

    @property
    def revolution(self) -> Revolution:
        """The newest revolution at the end of the last tick. LidarError before a reset."""
        # Without a position, measurements have no place.
        if self._trail.newest < 0:
            raise LidarError("the LiDAR has no scan yet", "call reset() first")
        if self._revolution is None:
            self._revolution = self._measure()
        return self._revolution

    def _measure(self) -> Revolution:
        """Take over the newest revolution.

        A real LiDAR's is checked when it is new, and its age always.
        """
        newest = self.lidar.scan()
        if isinstance(self.lidar, SimulatedLidar):
            return newest
        name = type(self.lidar).__name__
        # Checking takes longer than a scan lasts, so each revolution is checked once.
        if newest is not self._unchecked or newest is None:
            self._checked = check_revolution(newest, name)
            self._unchecked = newest
        if not isinstance(self.lidar, ReplayedLidar):  # in simulation it has no time-out
            check_age(self._checked, self._now, name, config=self.config)
        return self._checked

    @property
    def scan(self) -> Scan:
        """The scan at the end of the last tick. LidarError before a reset."""
        revolution = self.revolution
        if self._scan is None:
            # Computed once a step at most, and only if it is read.
            ranges = np.empty(self.size)
            fill_scan(revolution, self._trail.ring, self._rays, ranges)
            self._scan = Scan(ranges, revolution.stamp)
        return self._scan

    def reset(self, robots: SensorInput) -> None:
        """Start an episode, and open a device that is closed."""
        self.lidar.reset(robots.scenes[0], robots.rngs[0])
        self._trail = self._make_trail()

    def poll(self, truth: GroundTruth | None, now: float) -> None:
        """Mark where the robot is.

        Raises:
            LidarError: The newest scan is too old, or the device is gone.
        """
        self._now = now

        # Measurements are moved by the odometry since their times.
        self._trail.mark(now, self.odometry.pose)
        self._revolution = None
        self._scan = None
        # A device measures by itself. The simulated LiDAR has to see each tick.
        if self._poll_lidar is None:
            self._revolution = self._measure()
        else:
            self._poll_lidar(truth, now)

    def read(self, robots: SensorInput, out: Floats) -> None:
        """Fill in range / `max_range` of each ray, (1, rays)."""
        out[0] = self.scan.ranges / self.config.lidar.max_range

    def info(self, robots: SensorInput) -> dict[str, Floats]:
        """`scan_age` [s], and `scan_stale`: 1 if the age is over two periods of the LiDAR."""
        age = np.maximum(robots.now - self.scan.stamp, 0.0)  # a recorded clock is still at a reset
        return {"scan_age": age, "scan_stale": age > stale_after(self.config)}

    def close(self) -> None:
        """Stop the motor and close the device. Idempotent."""
        self.lidar.close()

    @property
    def layout(self) -> str:
        """Number of rays, field of view and longest range, in words."""
        lidar = self.config.lidar
        return f"{lidar.rays} ranges over {lidar.field_of_view:.4g} rad to {lidar.max_range:g} m"


def find_lidar(sensors: Iterable[Sensor]) -> LidarSensor | None:
    """The LiDAR among a robot's sensors. None without a LiDAR."""
    return find_sensor(sensors, LIDAR)  # type: ignore[no-any-return]


def newest_scan(sensors: Iterable[Sensor]) -> Scan | None:
    """The newest scan of the LiDAR among a robot's sensors. None without a LiDAR."""
    lidar = find_lidar(sensors)
    return None if lidar is None else lidar.scan


def footprint_edges(config: RobotConfig) -> Floats:
    """Distance from the LiDAR to the edge of the footprint along each ray, (rays,) [m]."""
    return _edges(config.outline, ray_spec(config), config.lidar_x_offset, config.lidar_y_offset)


@lru_cache(maxsize=16)
def _edges(outline: Outline, rays: RaySpec, x: float, y: float) -> Floats:
    """As `footprint_edges`: the same array for the same robot."""
    return outline_reach(outline, (x, y), rays.angles())


def stale_after(config: RobotConfig) -> float:
    """Age from which a scan counts as stale [s]."""
    return STALE_PERIODS / config.lidar.rate
