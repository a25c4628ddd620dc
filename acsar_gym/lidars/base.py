"""The contract of LiDARs, and the sensor that puts their ranges into the observation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from acsar_gym.bodies.base import GroundTruth
from acsar_gym.config import RobotConfig
from acsar_gym.config.footprint import Outline, reach
from acsar_gym.errors import LidarError
from acsar_gym.odometry import Odometry
from acsar_gym.sensors import LIDAR, Sensor
from acsar_gym.worlds import Scene
from acsar_gym.worlds.geometry import RaySpec

STALE = 2.0
"""A scan that is older than this many periods of the LiDAR counts as stale."""


@dataclass(frozen=True, eq=False, slots=True)
class Scan:
    """One revolution of a LiDAR."""

    ranges: NDArray[np.float64]
    """(rays,): range in each direction [m], within min_range to max_range, counter-clockwise from
    -field_of_view / 2 of the robot's x axis; max_range where nothing was measured."""
    stamp: float
    """When the revolution ended, on the link's clock [s]."""


class Lidar(Protocol):
    """A LiDAR, simulated or real. Its scans are stamped on the clock of the robot's link."""

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Begin an episode; opens a device that is closed.

        Args:
            scene: the world, and the robot's start in it.
            rng: for the noise.

        Raises:
            LidarError: the device can't be opened, or doesn't measure.
        """

    def scan(self) -> Scan:
        """Return the newest scan; doesn't wait for one.

        Raises:
            LidarError: it is older than the configured time-out, or the device is gone.
        """

    def close(self) -> None:
        """Stop the motor and close the device; idempotent."""


class LidarSensor(Sensor):
    """Adds a LiDAR's ranges to the observation: range / `max_range`, 0 to 1, one for each ray.

    Attributes: `lidar`, which measures, at its own rate; `scan`, its newest scan.
    """

    name, low, high = LIDAR, 0.0, 1.0
    uses_truth = False

    def __init__(self, lidar: Lidar, config: RobotConfig) -> None:
        self.lidar = lidar
        self.config = config
        self.size = config.lidar.rays
        self._scan: Scan | None = None

    @property
    def scan(self) -> Scan:
        """The newest scan at the end of the last tick. LidarError before a reset."""
        if self._scan is None:
            raise LidarError("the LiDAR has no scan yet", "call reset() first")
        return self._scan

    def follow(self, odometry: Odometry) -> None:
        """Tell a LiDAR that has a method `follow` how the robot moves."""
        if callable(follow := getattr(self.lidar, "follow", None)):
            follow(odometry)

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Begin an episode; opens a device that is closed. LidarError where that fails."""
        self.lidar.reset(scene, rng)

    def poll(self, truth: GroundTruth | None, now: float) -> None:
        """Take the newest scan. LidarError where it is too old, or the device is gone."""
        self._scan = self.lidar.scan()

    def read(self, truth: GroundTruth | None, now: float) -> NDArray[np.float64]:
        """Return range / `max_range` of each ray, (rays,)."""
        return self.scan.ranges / self.config.lidar.max_range

    def info(self, now: float) -> dict[str, float]:
        """`scan_age` [s], and `scan_stale`: 1 where the age is over two periods of the LiDAR."""
        age = now - self.scan.stamp
        return {"scan_age": age, "scan_stale": float(age > stale_after(self.config))}

    def close(self) -> None:
        """Stop the motor and close the device; idempotent."""
        self.lidar.close()

    @property
    def layout(self) -> str:
        """Number of rays, field of view and longest range, in words."""
        lidar = self.config.lidar
        return f"{lidar.rays} ranges over {lidar.field_of_view:.4g} rad to {lidar.max_range:g} m"


def newest_scan(sensors: Sequence[Sensor]) -> Scan | None:
    """The newest scan of the LiDAR among a robot's sensors; None without a LiDAR."""
    first = sensors[0] if sensors else None
    return first.scan if isinstance(first, LidarSensor) else None


def ray_spec(config: RobotConfig) -> RaySpec:
    """The rays of a robot's LiDAR."""
    lidar = config.lidar
    return RaySpec(lidar.rays, lidar.max_range, lidar.field_of_view)


def edges(config: RobotConfig) -> NDArray[np.float64]:
    """Distance from the LiDAR to the edge of the footprint along each ray, (rays,) [m]."""
    return _edges(config.outline, ray_spec(config), config.lidar_x_offset, config.lidar_y_offset)


@lru_cache(maxsize=16)
def _edges(outline: Outline, rays: RaySpec, x: float, y: float) -> NDArray[np.float64]:
    """As `edges`; the same array for the same robot."""
    found: NDArray[np.float64] = np.array(
        [reach(outline, (x, y), angle) for angle in rays.angles().tolist()]
    )
    return found


def stale_after(config: RobotConfig) -> float:
    """Age from which a scan counts as stale [s]."""
    return STALE / config.lidar.rate
