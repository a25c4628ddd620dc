"""Scans of a LiDAR that turns while the robot drives: what was measured, and how it becomes rays.

A LiDAR hands over revolutions: measurements with a bearing, a distance and a time each.
`fill_scan` moves them by what the odometry says that the robot drove between their time and now,
and sorts them into the rays of an observation. It is the same for a device, for a simulated LiDAR
and in a batch.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.jit import jit, loop
from acsar_gym.physics.trigonometry import cos_sin
from acsar_gym.worlds.geometry import RaySpec

Floats = NDArray[np.float64]
FULL_TURN = 2.0 * math.pi
MISS_HANDICAP = math.radians(0.75)
"""A ray prefers a measured distance to a miss that is nearer in direction by up to this angle: one
failed measurement among many isn't free space [rad]."""
GAP_STEPS = 2.0
"""A ray takes what is measured within so many steps between two measurements of a robot at rest;
further away nothing is known."""


class Revolution(NamedTuple):
    """One turn of a LiDAR's head: n measurements, in any order."""

    bearings: Floats
    """(n,): counter-clockwise from the LiDAR's zero, which points along the robot's x axis [rad]."""
    distances: Floats
    """(n,) [m]; 0 where nothing was measured."""
    times: Floats
    """(n,): when each was taken, on the clock of the robot's link [s]."""
    stamp: float
    """When the revolution ended, on that clock [s]."""


class Scan(NamedTuple):
    """What a LiDAR's rays measure from where the robot is now."""

    ranges: Floats
    """(rays,): range in each direction [m], within min_range to max_range, counter-clockwise from
    -field_of_view / 2 of the robot's x axis; max_range where nothing was measured."""
    stamp: float
    """When the revolution ended, on the link's clock [s]."""


class Rays(NamedTuple):
    """The rays of an observation, and where the LiDAR sits, as compiled loops need them."""

    start: float
    """Angle of the first ray [rad]."""
    step: float
    """Angle between two rays [rad]."""
    nearest: float
    """Least range [m]."""
    farthest: float
    """Longest range [m]."""
    mount_x: float
    """Position of the LiDAR in the base frame, ahead [m]."""
    mount_y: float
    """Position of the LiDAR in the base frame, to the left [m]."""
    period: float
    """Time between two poses of a trail, roughly [s]."""


def ray_spec(config: RobotConfig) -> RaySpec:
    """The rays of a robot's LiDAR."""
    lidar = config.lidar
    return RaySpec(lidar.rays, lidar.max_range, lidar.field_of_view)


def make_rays(config: RobotConfig) -> Rays:
    """The rays of a robot's LiDAR, for `fill_scan`."""
    spec, lidar = ray_spec(config), config.lidar
    mount = config.lidar_x_offset, config.lidar_y_offset
    start = float(spec.angles()[0])
    return Rays(start, spec.step, lidar.min_range, lidar.max_range, *mount, config.period)


class Trail:
    """Where a robot was at the ends of the last ticks, by odometry or in truth.

    Attributes: `rows`, a ring of time [s], x [m], y [m] and theta [rad], (slots, 4); `newest`, the
    place of the newest row.

    Args:
        duration: how far it reaches back [s].
        period: between two rows, roughly [s].
    """

    def __init__(self, duration: float, period: float) -> None:
        self.rows = np.zeros((count_slots(duration, period), 4))
        self._period = period
        self.clear()

    def clear(self) -> None:
        """Forget everything: until its first mark the robot has been at rest."""
        self.newest = -1

    def mark(self, time: float, pose: tuple[float, float, float]) -> None:
        """Add a row, or change the newest one where no time has passed."""
        if self.newest < 0:
            begin_trail(self.rows, time, pose, self._period)
        if self.newest < 0 or time > self.rows[self.newest, 0]:
            self.newest = (self.newest + 1) % len(self.rows)
        self.rows[self.newest] = time, *pose


def count_slots(duration: float, period: float) -> int:
    """Rows of a trail that reaches back for a duration [s], with a row every period [s]."""
    return math.ceil(duration / period) + 2


@loop
def begin_trail(trail: Floats, time: float, pose: tuple[float, float, float], dt: float) -> None:
    """Fill a trail with the pose of a robot that has been at rest; its next row is 0.

    Args:
        trail: (slots, 4), as `Trail.rows`; written.
        time: of the first mark, which comes next [s].
        pose: x [m], y [m], theta [rad].
        dt: between two marks [s].
    """
    slots = len(trail)
    for slot in range(slots):
        trail[slot, 0] = time - (slots - slot) * dt
        trail[slot, 1], trail[slot, 2], trail[slot, 3] = pose


@loop
def pose_at(trail: Floats, newest: int, time: float, period: float) -> tuple[float, float, float]:
    """Pose at a time [s]: x [m], y [m] and theta [rad], interpolated; the nearest end outside.

    Args:
        trail: of the robot.
        newest: place of its newest row.
        time: on the trail's clock [s].
        period: between two rows, roughly [s].
    """
    slots = len(trail)
    back = int(min(max((trail[newest, 0] - time) / period, 0.0), slots - 2.0))
    while back < slots - 2 and trail[(newest - back - 1) % slots, 0] > time:
        back += 1
    while back > 0 and trail[(newest - back) % slots, 0] < time:
        back -= 1
    after, before = trail[(newest - back) % slots], trail[(newest - back - 1) % slots]
    share = min(max((time - before[0]) / (after[0] - before[0]), 0.0), 1.0)
    turned = after[3] - before[3]
    turned -= FULL_TURN * np.floor(turned / FULL_TURN + 0.5)
    return (
        before[1] + share * (after[1] - before[1]),
        before[2] + share * (after[2] - before[2]),
        before[3] + share * turned,
    )


@loop
def fill_scan(
    bearings: Floats,
    distances: Floats,
    times: Floats,
    trail: Floats,
    newest: int,
    rays: Rays,
    ranges: Floats,
) -> None:
    """Compute what the rays of a robot would measure now from the measurements of a revolution.

    Each is moved by the odometry between its time and now, then each ray takes the one that is
    next to it.

    Args:
        bearings: of a Revolution.
        distances: of the same.
        times: of the same.
        trail: of the odometry; its newest row is now.
        newest: place of that row.
        rays: of the LiDAR.
        ranges: (rays,) [m]; written, within nearest to farthest.
    """
    count, last = len(bearings), len(ranges)
    seen, far, off = np.empty(count), np.empty(count), np.empty(last)
    x, y, theta = trail[newest, 1], trail[newest, 2], trail[newest, 3]
    cos, sin = cos_sin(theta)
    least = most = 0.0
    for k in range(count):
        then_x, then_y, then_theta = pose_at(trail, newest, times[k], rays.period)
        turned = then_theta - theta
        turned -= FULL_TURN * np.floor(turned / FULL_TURN + 0.5)
        least, most = min(least, turned), max(most, turned)
        seen[k], far[k] = bearings[k] + turned, distances[k]
        if distances[k] > 0.0 and (then_x != x or then_y != y or turned != 0.0):
            dx, dy = then_x - x, then_y - y
            turned_cos, turned_sin = cos_sin(turned)
            beam_cos, beam_sin = cos_sin(seen[k])
            ahead = cos * dx + sin * dy - rays.mount_x + distances[k] * beam_cos
            ahead += turned_cos * rays.mount_x - turned_sin * rays.mount_y
            left = cos * dy - sin * dx - rays.mount_y + distances[k] * beam_sin
            left += turned_sin * rays.mount_x + turned_cos * rays.mount_y
            seen[k], far[k] = math.atan2(left, ahead), math.sqrt(ahead * ahead + left * left)
    reach = GAP_STEPS * FULL_TURN / max(count, 1) + most - least
    around = FULL_TURN / rays.step
    whole = abs(around - last) < 1e-6  # the rays go all the way round
    ranges[:], off[:] = rays.farthest, np.inf
    for k in range(count):
        place = (seen[k] - rays.start) / rays.step
        place -= around * np.floor((place + 0.5 * (around - last + 1.0)) / around)
        handicap = 0.0 if distances[k] > 0.0 else MISS_HANDICAP
        found = far[k] if distances[k] > 0.0 else rays.farthest
        low = int(np.ceil(place - reach / rays.step))
        high = int(np.floor(place + reach / rays.step))
        for number in range(low, min(high, low + last - 1) + 1):
            ray = number % last if whole else number
            apart = abs(place - number) * rays.step + handicap
            if 0 <= ray < last and apart < off[ray]:
                off[ray], ranges[ray] = apart, found
    for ray in range(last):
        ranges[ray] = min(max(ranges[ray], rays.nearest), rays.farthest)


@jit
def newest_revolution(now: float, first: float, rate: float, phase: float) -> tuple[float, float]:
    """Number and end [s] of the newest complete revolution of a LiDAR that has always turned.

    Args:
        now: [s].
        first: when the episode began [s].
        rate: revolutions per second [Hz].
        phase: of a revolution at which the episode began, 0 to 1: number 0 ends so much later.
    """
    number: float = np.floor((now - first) * rate - phase)
    return number, first + (number + phase) / rate
