"""From sensor_msgs/LaserScan to revolutions and back, without ROS.

A message has rays at equal steps in the scanner's own frame, and its stamp is the time of the first
ray. Ranges follow REP 117: inf if nothing is near enough to be seen, -inf if something is too near,
NaN for a failure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acsar_gym.errors import LidarError, show_value
from acsar_gym.lidar.scan import FULL_TURN, MAX_DISTANCE, Floats, Revolution

MAX_TURNS = 2.0  # a scan covers at most this number of turns; angles in degrees cover more
MAX_TILT = math.radians(5.0)  # a scanner may lean by up to this angle [rad]
MIN_RATE = 0.1
"""Heads turn faster. If measurements suggest a lower rate, they were made at the same time
[rad/s]."""
MAX_DENSITY = 4  # `make_scan` makes at most this number of rays for each measurement


class LaserScan(NamedTuple):
    """Fields of a sensor_msgs/LaserScan."""

    angle_min: float
    """Direction of the first ray, counter-clockwise about the scanner's z axis [rad]."""
    angle_increment: float
    """From a ray to the next ray [rad]; negative for a scanner that turns clockwise."""
    time_increment: float
    """From a ray to the next ray [s]; negative if the head turns against the order of rays."""
    scan_time: float
    """From a scan to the next scan [s]."""
    range_min: float
    """Smaller ranges mean nothing [m]."""
    range_max: float
    """Larger ranges mean nothing [m]."""
    ranges: ArrayLike
    """(n,) [m]."""
    stamp: float
    """Time of the first ray on the clock of the robot's link [s]."""

    @property
    def angle_max(self) -> float:
        """Direction of the last ray [rad]."""
        return self.angle_min + (np.size(self.ranges) - 1) * self.angle_increment


class Mount(NamedTuple):
    """Pose of a scanner in the base frame."""

    x: float = 0.0
    """Forward [m]."""
    y: float = 0.0
    """To the left [m]."""
    yaw: float = 0.0
    """Direction of the scanner's x axis, counter-clockwise from the robot's [rad]."""


def read_mount(translation: Sequence[float], rotation: Sequence[float], source: str) -> Mount:
    """Read the pose of a scanner from the transform of its frame.

    Args:
        translation: x, y, z in the base frame [m].
        rotation: Quaternion x, y, z, w.
        source: Name of the scanner in messages.

    Raises:
        LidarError: The transform isn't finite, or the scanner isn't horizontal and upright.
    """
    length = math.hypot(*rotation)
    if not (math.isfinite(math.fsum(translation)) and 1e-6 < length < math.inf):
        raise LidarError(
            f"{source}: its transform is {show_value([*translation])}, {show_value([*rotation])}",
            "must be finite numbers and a quaternion of length 1: see which node publishes it",
        )

    x, y, z, w = (number / length for number in rotation)
    tilt = math.acos(max(min(1.0 - 2.0 * (x * x + y * y), 1.0), -1.0))  # of the z axis
    if tilt > MAX_TILT:
        raise LidarError(
            f"{source}: its frame is tilted by {math.degrees(tilt):.1f} degrees",
            "a LiDAR must be mounted horizontally and upright, and its joint in the URDF must say "
            "so; most drivers can flip the scans of a LiDAR that hangs upside down",
        )
    yaw = math.atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))  # of the x axis
    return Mount(float(translation[0]), float(translation[1]), yaw)


def read_scan(scan: LaserScan, mount: Mount, source: str, timeout: float) -> Revolution:
    """Read a revolution from a message.

    If `time_increment` is 0, a full turn takes `scan_time`. If that is also 0, as in scans of
    simulators, all rays have the time of the stamp.

    Args:
        scan: Message.
        mount: Pose of the scanner, of which only the yaw matters.
        source: Name of the scanner in messages, such as its topic.
        timeout: Longest time that the rays of a scan may take [s].

    Returns:
        Bearings from the robot's x axis, within half a turn. Distances are 0 for failed
        measurements, and range_min for things that are too near.

    Raises:
        LidarError: The message has no rays, or a field with an impossible value.
    """
    ranges = np.asarray(scan.ranges, np.float64)
    _check_fields(scan, len(ranges), source, timeout=timeout)

    rays = np.arange(len(ranges), dtype=np.float64)
    bearings = mount.yaw + (scan.angle_min + rays * scan.angle_increment)
    is_measured = (scan.range_min <= ranges) & (ranges <= min(scan.range_max, MAX_DISTANCE))
    distances = np.where(is_measured, ranges, 0.0)
    distances[ranges == -math.inf] = scan.range_min
    step = scan.time_increment or scan.scan_time * abs(scan.angle_increment) / FULL_TURN
    times = scan.stamp + rays * step
    return Revolution(_wrap(bearings), distances, times, float(times.max()))


def _check_fields(scan: LaserScan, count: int, source: str, timeout: float) -> None:
    """Raise LidarError for impossible fields of a scan with this number of rays."""
    if count == 0:
        raise LidarError(f"{source}: has no ranges", "check that the scanner turns, and its driver")

    turns = (count - 1) * abs(scan.angle_increment) / FULL_TURN
    duration = (count - 1) * abs(scan.time_increment)
    longest = min(timeout, MAX_TURNS * (scan.scan_time or math.inf))
    numbers = scan._replace(ranges=0.0, range_max=0.0)._asdict()
    infinite = [name for name, value in numbers.items() if not math.isfinite(value)]
    if infinite:
        problem = f"{infinite[0]} = {numbers[infinite[0]]}: must be a finite number"
    elif scan.angle_increment == 0.0:
        problem = "angle_increment = 0: must be the angle from a ray to the next ray"
    elif turns > MAX_TURNS:
        problem = (
            f"angle_increment = {scan.angle_increment:g}: {count} rays of {turns:.0f} turns: "
            "must be rad"
        )
    elif scan.scan_time < 0.0:
        problem = f"scan_time = {scan.scan_time:g}: must not be negative"
    elif duration > longest:
        problem = (
            f"time_increment = {scan.time_increment:g}: {count} rays would take {duration:.3g} s, "
            f"at most {longest:.3g} s are possible (scan_time, lidar.timeout)"
        )
    elif not 0.0 <= scan.range_min < scan.range_max:
        problem = (
            f"range_min = {scan.range_min:g}: must be less than range_max = {scan.range_max:g}, "
            "and not negative"
        )
    else:
        return
    raise LidarError(f"{source}: {problem}", "the scanner's driver publishes bad scans")


def move_revolution(revolution: Revolution, dx: float, dy: float) -> Revolution:
    """Return what a scanner at another place of the robot would have measured.

    Failed measurements keep their direction.

    Args:
        revolution: Bearings from the robot's x axis.
        dx: Where it was measured, forward from the other place [m].
        dy: Likewise, to the left [m].
    """
    if dx == dy == 0.0:
        return revolution
    x = dx + revolution.distances * np.cos(revolution.bearings)
    y = dy + revolution.distances * np.sin(revolution.bearings)
    is_measured = revolution.distances > 0.0
    return revolution._replace(
        bearings=np.where(is_measured, np.arctan2(y, x), revolution.bearings),
        distances=np.where(is_measured, np.hypot(x, y), 0.0),
    )


def make_scan(
    revolution: Revolution,
    range_min: float,
    range_max: float,
    *,
    angle_min: float | None = None,
    rays: int | None = None,
) -> LaserScan:
    """Make a message of a full turn, counter-clockwise, as mapping programs expect.

    Each ray has the range of the measurement that is nearest in direction, or inf if this
    measurement failed or is a step away. Numbers are representable as float32.

    Args:
        revolution: Measurements at any bearings.
        range_min: Smaller distances are -inf [m].
        range_max: Larger distances are inf [m].
        angle_min: Direction of the first ray [rad]. None: where the turn starts or ends.
        rays: Number of rays. None: as dense as the measurements. Programs such as slam_toolbox
            expect constant numbers, so pass those of the first message for the next messages.

    Raises:
        LidarError: The revolution has no measurements.
    """
    bearings, distances, times, _ = revolution
    if not len(bearings):
        raise LidarError("the revolution has no measurements", "check the LiDAR")
    order = np.argsort(times, kind="stable")
    rate = _find_rate(np.unwrap(bearings[order]), times[order])

    # Directions of the rays, and of the measurements in rays.
    if angle_min is None:
        angle_min = float(_wrap(bearings[order[0 if rate >= 0.0 else -1]]))
    rays = rays or _count_rays(bearings)
    angle_min = _as_float32(angle_min)
    increment = _as_float32(FULL_TURN / rays)
    places = np.mod(bearings - angle_min, FULL_TURN) / increment

    # The range of each ray.
    low = _as_float32(range_min)
    high = _as_float32(range_max)
    ranges = np.where(distances > 0.0, distances, math.inf).astype(np.float32)
    ranges[ranges > high] = math.inf
    ranges[ranges < low] = -math.inf
    nearest, gaps = _find_nearest(places, rays)
    ranges = np.where(gaps < 1.0, ranges[nearest], math.inf).astype(np.float32)

    # The time of the first ray: the median, as some measurements may be of another turn.
    step = _as_float32(increment / rate) if rate else 0.0
    places = np.where(places > rays - 0.5, places - rays, places)  # just before the first ray
    stamp = float(np.median(times - places * step))
    return LaserScan(
        angle_min=angle_min,
        angle_increment=increment,
        time_increment=step,
        scan_time=abs(step) * rays,
        range_min=low,
        range_max=high,
        ranges=ranges,
        stamp=stamp,
    )


def _find_rate(bearings: Floats, times: Floats) -> float:
    """Return the rate of a head by its measurements in the order of time [rad/s]; 0 if unknown."""
    ages = times - times.mean()
    spread = float(ages @ ages)
    rate = float(ages @ (bearings - bearings.mean())) / spread if spread > 0.0 else 0.0
    return rate if abs(rate) > MIN_RATE else 0.0


def _count_rays(bearings: Floats) -> int:
    """Return how many rays of a full turn are as dense as measurements."""
    count = len(bearings)
    steps = np.diff(np.sort(np.mod(bearings, FULL_TURN)))
    step = float(np.median(steps)) if count > 1 else 0.0
    return round(FULL_TURN / max(step, FULL_TURN / (MAX_DENSITY * count))) if step else count


def _find_nearest(places: Floats, rays: int) -> tuple[NDArray[np.int64], Floats]:
    """Return the measurement that is nearest to each ray, and how many rays it is away."""
    order = np.argsort(places)
    targets = np.arange(rays)
    above = np.searchsorted(places[order], targets)
    neighbours = order[np.stack([above - 1, above % len(places)])]  # -1: the last, a turn before
    gaps = np.abs(places[neighbours] - targets)
    gaps = np.minimum(gaps, rays - gaps)
    side = np.argmin(gaps, axis=0)
    return neighbours[side, targets], gaps[side, targets]


def _wrap(angles: Floats) -> Floats:
    """Return angles from -pi to less than pi."""
    return np.mod(angles + math.pi, FULL_TURN) - math.pi


def _as_float32(value: float) -> float:
    return float(np.float32(value))
