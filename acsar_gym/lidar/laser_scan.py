"""From sensor_msgs/LaserScan to revolutions and back, without ROS.

A message has rays at equal steps in the scanner's own frame, and its stamp is the time of the first
ray. Ranges follow REP 117: inf if nothing is near enough to be seen, -inf if something is too near,
NaN for a failure.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from acsar_gym.errors import LidarError, show_value
from acsar_gym.lidar.scan import FULL_TURN, MAX_DISTANCE, Floats, Revolution

MAX_TURNS = 2.0  # a scan covers at most this number of turns: degrees cover more
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
    """From a ray to the next ray [rad]. Negative for a scanner that turns clockwise."""
    time_increment: float
    """From a ray to the next ray [s]. Negative if the head turns against the order of rays."""
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
    """Pose of a scanner on a robot."""

    x: float = 0.0
    """Forward from the base frame, or from where the robot's file has the LiDAR [m]."""
    y: float = 0.0
    """Likewise, to the left [m]."""
    yaw: float = 0.0
    """Direction of the scanner's x axis, counter-clockwise from the robot's [rad]."""


def read_mount(transform: Any, source: str) -> Mount:
    """Read the pose of a scanner from the transform of its frame in the base frame.

    Args:
        transform: A geometry_msgs/Transform.
        source: Name of the scanner in messages.

    Raises:
        LidarError: The transform isn't finite, or the scanner isn't horizontal and upright.
    """
    place = transform.translation
    turn = transform.rotation
    length = math.hypot(turn.x, turn.y, turn.z, turn.w)
    if not (math.isfinite(place.x + place.y) and 1e-6 < length < math.inf):
        raise LidarError(
            f"{source}: its transform is {show_value(transform)}",
            "must be finite numbers and a quaternion of length 1: see which node publishes it",
        )

    x, y, z, w = (number / length for number in (turn.x, turn.y, turn.z, turn.w))
    tilt = 2.0 * math.asin(min(math.hypot(x, y), 1.0))  # of the z axis
    if tilt > MAX_TILT:
        raise LidarError(
            f"{source}: its frame is tilted by {math.degrees(tilt):.1f} degrees",
            "a LiDAR must be mounted horizontally and upright, and its joint in the URDF must say "
            "so; most drivers can flip the scans of a LiDAR that hangs upside down",
        )
    yaw = math.atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))  # of the x axis
    return Mount(float(place.x), float(place.y), yaw)


def read_scan(scan: LaserScan, mount: Mount, source: str, timeout: float) -> Revolution:
    """Read a revolution from a message.

    If `time_increment` is 0, a full turn takes `scan_time`. If that is also 0, as in scans of
    simulators, all rays have the time of the stamp.

    Args:
        scan: Message.
        mount: Pose of the scanner, from where the robot's file has it.
        source: Name of the scanner in messages, such as its topic.
        timeout: Longest time that the rays of a scan may take [s].

    Returns:
        Measurements as from where the robot's file has the scanner. Distances are 0 for failed
        measurements, and range_min for things that are too near.

    Raises:
        LidarError: The message has no rays, or a field with an impossible value.
    """
    ranges = np.asarray(scan.ranges, np.float64)
    _check_fields(scan, len(ranges), source, timeout=timeout)

    # Rays in the robot's directions, as seen from the scanner.
    rays = np.arange(len(ranges), dtype=np.float64)
    bearings = mount.yaw + (scan.angle_min + rays * scan.angle_increment)
    is_measured = (scan.range_min <= ranges) & (ranges <= min(scan.range_max, MAX_DISTANCE))
    distances = np.where(is_measured, ranges, 0.0)
    distances[ranges == -math.inf] = scan.range_min
    if mount.x or mount.y:  # failed measurements keep their direction
        points = complex(mount.x, mount.y) + distances * np.exp(1j * bearings)
        bearings = np.where(distances > 0.0, np.angle(points), bearings)
        distances = np.where(distances > 0.0, np.abs(points), 0.0)

    # Drivers that leave out the times of rays still give that of the turn.
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
    measurement failed or is a step away.

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
    if not len(revolution.times):
        raise LidarError("the revolution has no measurements", "check the LiDAR")
    order = np.argsort(revolution.times, kind="stable")
    bearings = np.unwrap(revolution.bearings[order])
    times = revolution.times[order]
    duration = times[-1] - times[0]
    rate = (bearings[-1] - bearings[0]) / duration if duration > 0.0 else 0.0
    if angle_min is None:
        angle_min = float(_wrap(bearings[0 if rate >= 0.0 else -1]))
    rays = rays or _count_rays(bearings)
    increment = FULL_TURN / rays

    # Each measurement is a candidate for the rays on both sides. The nearest is written last.
    places = np.mod(bearings - angle_min, FULL_TURN) / increment
    low = np.floor(places).astype(np.int64)
    gaps = np.concatenate([places - low, low + 1 - places])
    by_gap = np.argsort(-gaps, kind="stable")
    distances = revolution.distances[order]
    distances[(distances == 0.0) | (distances > range_max)] = math.inf
    distances[distances < range_min] = -math.inf
    ranges = np.full(rays, math.inf, np.float32)
    ranges[np.concatenate([low, low + 1])[by_gap] % rays] = np.tile(distances, 2)[by_gap]

    # The time of the first ray: the median, as some measurements may be of another turn.
    step = increment / rate if abs(rate) > MIN_RATE else 0.0
    places = np.where(places > rays - 0.5, places - rays, places)  # just before the first ray
    return LaserScan(
        angle_min=angle_min,
        angle_increment=increment,
        time_increment=step,
        scan_time=abs(step) * rays,
        range_min=float(np.float32(range_min)),
        range_max=float(np.float32(range_max)),
        ranges=ranges,
        stamp=float(np.median(times - places * step)),
    )


def _count_rays(bearings: Floats) -> int:
    """Return how many rays of a full turn are as dense as measurements."""
    count = len(bearings)
    # The typical step, since a part of the turn may be missing.
    steps = np.diff(np.sort(np.mod(bearings, FULL_TURN)))
    step = float(np.median(steps)) if count > 1 else 0.0
    return round(FULL_TURN / max(step, FULL_TURN / (MAX_DENSITY * count))) if step else count


def _wrap(angles: Floats) -> Floats:
    """Return angles from -pi to less than pi."""
    return np.mod(angles + math.pi, FULL_TURN) - math.pi
