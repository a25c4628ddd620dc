"""From sensor_msgs/LaserScan to revolutions and back; pure, needs no ROS.

A message has rays at equal steps, as seen from the scanner's own frame, and its stamp is the time
of the first ray. Ranges are as REP 117 says: inf where nothing is near enough to be seen, -inf
where something is too near, NaN for a failure.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acsar_gym.errors import LidarError, show_value
from acsar_gym.lidar.scan import FULL_TURN, MAX_DISTANCE, Floats, Revolution

MOST_TURNS = 2.0
"""A scan goes round at most as often; angles in degrees are more."""
MAX_TILT = math.radians(5.0)
"""A scanner may lean from the horizontal by up to this angle [rad]."""
SLOWEST = 0.1
"""Heads turn faster; measurements that don't are taken to be of one moment [rad/s]."""
FINEST = 4
"""`make_scan` makes at most so many times as many rays as there are measurements."""


class LaserScan(NamedTuple):
    """Fields of a sensor_msgs/LaserScan."""

    angle_min: float
    """Direction of the first ray, counter-clockwise about the scanner's z axis [rad]."""
    angle_increment: float
    """From a ray to the next one [rad]; negative for one that turns clockwise."""
    time_increment: float
    """From a ray to the next one [s]; negative where the head turns against the rays' order."""
    scan_time: float
    """From a scan to the next one [s]."""
    range_min: float
    """Smaller ranges mean nothing [m]."""
    range_max: float
    """Larger ranges mean nothing [m]."""
    ranges: ArrayLike
    """(n,) [m]."""
    stamp: float
    """Time of the first ray, on the clock of the robot's link [s]."""

    @property
    def angle_max(self) -> float:
        """Direction of the last ray [rad]."""
        return self.angle_min + (np.size(self.ranges) - 1) * self.angle_increment


Translation = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class Transform(NamedTuple):
    """Where a frame is, as geometry_msgs/TransformStamped says."""

    parent: str
    """The frame in which it is."""
    translation: Translation
    """x, y, z [m]."""
    rotation: Quaternion
    """x, y, z, w."""


class Mount(NamedTuple):
    """How a scanner sits on a robot."""

    x: float = 0.0
    """Ahead of the base frame's origin [m]."""
    y: float = 0.0
    """To the left of it [m]."""
    yaw: float = 0.0
    """Direction of the scanner's x axis, counter-clockwise from the base's [rad]."""
    is_inverted: bool = False
    """Whether it hangs upside down, so that its directions are mirrored."""


def find_mount(
    translation: Sequence[float], rotation: Sequence[float], source: str = "scan"
) -> Mount:
    """Find how a scanner sits from the transform of its frame in the base frame.

    Args:
        translation: x, y, z [m].
        rotation: quaternion x, y, z, w.
        source: what messages call the scanner.

    Raises:
        LidarError: a number isn't finite, the quaternion is zero, or the scanner isn't horizontal,
            upright or upside down, within 5 degrees.
    """
    length = math.hypot(*rotation)
    if not (math.isfinite(math.fsum(translation)) and 1e-6 < length < math.inf):
        raise LidarError(
            f"{source}: its transform is {show_value([*translation])}, {show_value([*rotation])}",
            "must be finite numbers and a quaternion of length 1; see who publishes /tf_static",
        )
    x, y, z, w = (number / length for number in rotation)
    up = 1.0 - 2.0 * (x * x + y * y)  # z of the scanner's z axis
    tilt = math.acos(min(abs(up), 1.0))
    if tilt > MAX_TILT:
        raise LidarError(
            f"{source}: its frame is tilted by {math.degrees(tilt):.1f} degrees",
            "must be horizontal, upright or upside down: correct its joint in the URDF",
        )
    yaw = math.atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))  # of its x axis
    return Mount(float(translation[0]), float(translation[1]), yaw, up < 0.0)


def find_transform(
    transforms: Mapping[str, Transform], frame: str, base: str, source: str = "scan"
) -> tuple[Translation, Quaternion]:
    """Find where a frame is in another one, over those between them.

    Args:
        transforms: of /tf_static, by the names of their frames.
        frame: the scanner's, as the header of its messages says.
        base: the robot's.
        source: what messages call the scanner.

    Returns:
        Translation [m] and quaternion, for `find_mount`.

    Raises:
        LidarError: no transforms connect the two.
    """
    chains = [[*_find_parents(transforms, name)] for name in (frame, base)]
    names = [{name.lstrip("/"): place for place, (name, _, _) in enumerate(c)} for c in chains]
    common = next((name for name in names[0] if name in names[1]), None)
    if common is None:
        raise LidarError(
            f"{source}: nothing on /tf_static says where its frame {show_value(frame)} is in "
            f"{show_value(base)}",
            "publish it, such as by robot_state_publisher, or set base_frame of the robot's file",
        )
    (_, at, turn), (_, from_base, base_turn) = (
        chain[places[common]] for chain, places in zip(chains, names, strict=True)
    )
    back = (-base_turn[0], -base_turn[1], -base_turn[2], base_turn[3])
    apart = (at[0] - from_base[0], at[1] - from_base[1], at[2] - from_base[2])
    return _rotate(back, apart), _multiply(back, turn)


def _find_parents(
    transforms: Mapping[str, Transform], name: str
) -> Iterator[tuple[str, Translation, Quaternion]]:
    """Yield a frame, then its parents, each with where the first one is in it."""
    by_name = {child.lstrip("/"): transform for child, transform in transforms.items()}
    at, turn = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    for _ in range(len(by_name) + 1):  # those of a circle end, too
        yield name, at, turn
        transform = by_name.get(name.lstrip("/"))
        if transform is None:
            return
        x, y, z = _rotate(transform.rotation, at)
        dx, dy, dz = transform.translation
        at, turn = (x + dx, y + dy, z + dz), _multiply(transform.rotation, turn)
        name = transform.parent


def _multiply(first: Quaternion, second: Quaternion) -> Quaternion:
    """The rotation by `second`, then by `first`."""
    a, b, c, d = first
    x, y, z, w = second
    return (
        d * x + a * w + b * z - c * y,
        d * y - a * z + b * w + c * x,
        d * z + a * y - b * x + c * w,
        d * w - a * x - b * y - c * z,
    )


def _rotate(rotation: Quaternion, place: Translation) -> Translation:
    x, y, z, w = rotation
    turned = _multiply(_multiply(rotation, (*place, 0.0)), (-x, -y, -z, w))
    return turned[0], turned[1], turned[2]


def read_scan(scan: LaserScan, mount: Mount | None = None, source: str = "scan") -> Revolution:
    """Read a revolution from a message.

    Where `time_increment` is 0, a turn takes `scan_time`; where that is 0, too, all rays are of the
    stamp, as those of simulators are.

    Args:
        scan: the message.
        mount: how the scanner sits; None: as the base frame.
        source: what messages call it, such as its topic.

    Returns:
        Bearings in the directions of the base frame, within half a turn; 0 where nothing was
        measured, and range_min where something is too near.

    Raises:
        LidarError: it has no rays, or a field that can't be.
    """
    ranges = np.asarray(scan.ranges, np.float64)
    _check_fields(scan, len(ranges), source)
    step = scan.time_increment or scan.scan_time * abs(scan.angle_increment) / FULL_TURN
    rays = np.arange(len(ranges), dtype=np.float64)
    mount = mount or Mount()
    bearings = scan.angle_min + rays * scan.angle_increment
    bearings = mount.yaw + (-bearings if mount.is_inverted else bearings)
    measured = (scan.range_min <= ranges) & (ranges <= min(scan.range_max, MAX_DISTANCE))
    distances = np.where(ranges == -math.inf, scan.range_min, np.where(measured, ranges, 0.0))
    times = scan.stamp + rays * step
    return Revolution(_wrap(bearings), distances, times, float(times.max()))


def move_revolution(revolution: Revolution, dx: float, dy: float) -> Revolution:
    """Tell what a scanner at another place of the robot would have measured.

    What wasn't measured stays in its direction.

    Args:
        revolution: with bearings in the directions of the base frame.
        dx: where it was measured, ahead of the other place [m].
        dy: likewise, to the left of it [m].
    """
    if dx == dy == 0.0:
        return revolution
    bearings, distances, times, stamp = revolution
    x, y = dx + distances * np.cos(bearings), dy + distances * np.sin(bearings)
    measured = distances > 0.0
    return Revolution(
        np.where(measured, np.arctan2(y, x), bearings),
        np.where(measured, np.hypot(x, y), 0.0),
        times,
        stamp,
    )


def _check_fields(scan: LaserScan, rays: int, source: str) -> None:
    """Raise LidarError for fields that no scan has."""
    if rays == 0:
        raise LidarError(f"{source}: has no ranges", "see that the scanner turns, and its driver")
    increment = scan.angle_increment
    problem = next(
        (
            f"{name} = {getattr(scan, name)}: must be a finite number"
            for name in LaserScan._fields
            if name not in ("ranges", "range_max") and not math.isfinite(getattr(scan, name))
        ),
        "",
    )
    if not problem and increment == 0.0:
        problem = "angle_increment = 0: must be the angle from a ray to the next one"
    if not problem and (rays - 1) * abs(increment) > MOST_TURNS * FULL_TURN:
        turns = (rays - 1) * abs(increment) / FULL_TURN
        problem = f"angle_increment = {increment:g}: {rays} rays of {turns:.0f} turns: must be rad"
    if not problem and scan.scan_time < 0.0:
        problem = f"scan_time = {scan.scan_time:g}: must not be negative"
    if not problem and not 0.0 <= scan.range_min < scan.range_max:
        problem = (
            f"range_min = {scan.range_min:g}: must be less than range_max = {scan.range_max:g}, "
            "and not negative"
        )
    if problem:
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

    Each ray has the range of the measurement that is next to it in direction and nearer than a
    step; inf where there is none, or it failed. Numbers are those that float32 has.

    Args:
        revolution: with measurements at any bearings.
        range_min: smaller distances are -inf [m].
        range_max: larger distances are inf [m].
        angle_min: direction of the first ray [rad]. None: where the turn begins or ends.
        rays: how many; None: as dense as the measurements. Programs such as slam_toolbox want both
            to stay as they are, so give those of the first message to the following ones.

    Raises:
        LidarError: the revolution has no measurements.
    """
    bearings, distances, times, _ = revolution
    if not len(bearings):
        raise LidarError("the revolution has no measurements", "look after the LiDAR")
    order = np.argsort(times, kind="stable")
    rate = _find_rate(np.unwrap(bearings[order]), times[order])
    if angle_min is None:
        angle_min = float(_wrap(bearings[order[0 if rate >= 0.0 else -1]]))
    rays = rays or _count_rays(bearings)
    angle_min, increment = _as_float32(angle_min), _as_float32(FULL_TURN / rays)
    places = np.mod(bearings - angle_min, FULL_TURN) / increment  # in rays
    nearest, offs = _find_nearest(places, rays)
    ranges = np.where(distances > 0.0, distances, math.inf).astype(np.float32)
    low, high = _as_float32(range_min), _as_float32(range_max)
    ranges = np.where(ranges > high, math.inf, np.where(ranges < low, -math.inf, ranges))[nearest]
    step = _as_float32(increment / rate) if rate else 0.0
    whole = np.where(places > rays - 0.5, places - rays, places)  # a bit before the first ray
    return LaserScan(
        angle_min,
        increment,
        step,
        abs(step) * rays,
        low,
        high,
        np.where(offs < 1.0, ranges, math.inf).astype(np.float32),
        float(np.median(times - whole * step)),  # some may be of the turn before or behind
    )


def _find_rate(bearings: Floats, times: Floats) -> float:
    """How fast a head turns by its measurements in the order of time [rad/s]; 0 if at once."""
    ages = times - times.mean()
    spread = float(ages @ ages)
    rate = float(ages @ (bearings - bearings.mean())) / spread if spread > 0.0 else 0.0
    return rate if abs(rate) > SLOWEST else 0.0


def _count_rays(bearings: Floats) -> int:
    """How many rays of a full turn are as dense as measurements."""
    count = len(bearings)
    steps = np.diff(np.sort(np.mod(bearings, FULL_TURN)))
    step = float(np.median(steps)) if count > 1 else 0.0
    return round(FULL_TURN / max(step, FULL_TURN / (FINEST * count))) if step else count


def _find_nearest(places: Floats, rays: int) -> tuple[NDArray[np.int64], Floats]:
    """The measurement that is next to each ray, and how many rays it is away."""
    order = np.argsort(places)
    ordered, targets = places[order], np.arange(rays)
    above = np.searchsorted(ordered, targets)
    around = np.stack([above - 1, above % len(places)])  # -1 is the last one, one turn before
    offs = np.abs(ordered[around] - targets)
    offs = np.minimum(offs, rays - offs)
    side = np.argmin(offs, axis=0)
    return order[around[side, targets]], offs[side, targets]


def _wrap(angles: Floats) -> Floats:
    """Angles from -pi to less than pi."""
    return np.mod(angles + math.pi, FULL_TURN) - math.pi


def _as_float32(value: float) -> float:
    return float(np.float32(value))
