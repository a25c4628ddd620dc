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
from acsar_gym.jit import jit, loop, subroutine
from acsar_gym.trigonometry import angle_of, cos_sin
from acsar_gym.worlds.geometry import RaySpec

Floats = NDArray[np.float64]
FULL_TURN = 2.0 * math.pi
MAX_STAMP = 4e9  # largest time on a link's clock, either sign [s]: 126 years
MAX_DISTANCE = 1e6  # largest distance of a measurement [m]
MISS_HANDICAP = math.radians(0.75)
"""A ray prefers a measured distance to a miss that is nearer in direction by up to this angle: one
failed measurement among many isn't free space [rad]."""
MAX_SLOPE = 3.0
"""Two measurements may lie on one surface where the range changes by no more than this, in parts of
the range, for each radian: a wall is then seen at an angle of up to 72 degrees from its normal."""
GAP_STEPS = 2.0
"""A ray takes what is measured within so many steps between two measurements of a robot at rest;
further away nothing is known."""


NOTHING = 1e9  # length of a miss, and how many rays away a measurement is that isn't there


class Revolution(NamedTuple):
    """One turn of a LiDAR's head: n measurements, in any order."""

    bearings: Floats
    """(n,): counter-clockwise from the LiDAR's zero, which is the robot's x axis [rad]."""
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
    """

    def __init__(self, duration: float, period: float) -> None:
        self.rows = np.zeros((count_trail_rows(duration, period), 4))
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


def count_trail_rows(duration: float, period: float) -> int:
    """Rows of a trail that reaches back for a duration [s], with a row every period [s]."""
    return math.ceil(duration / period) + 2


@loop
def begin_trail(trail: Floats, time: float, pose: tuple[float, float, float], dt: float) -> None:
    """Fill a trail with the pose of a robot that has been at rest; its next row is 0."""
    slots = len(trail)
    for slot in range(slots):
        trail[slot, 0] = time - (slots - slot) * dt
        trail[slot, 1], trail[slot, 2], trail[slot, 3] = pose


@jit
def look_back(trail: Floats, newest: int, since: float, until: float, rays: Rays) -> Floats:
    """Where a LiDAR was during a time, as seen from where it is now.

    Returns:
        (slots, 4), the newest first: time [s], x and y of the LiDAR's place from its present one in
        the robot's present frame [m], and the heading from the present one [rad]. Rows that
        `place_at` doesn't need for that time have no more than a time.
    """
    slots = len(trail)
    seen = np.zeros((slots, 4))
    cos, sin = cos_sin(trail[newest, 3])
    row, over = newest, False
    for back in range(slots):
        seen[back, 0] = trail[row, 0]
        before = row - 1 if row > 0 else slots - 1
        if not over and (back == slots - 1 or trail[before, 0] <= until):
            over = trail[row, 0] < since
            dx, dy = trail[row, 1] - trail[newest, 1], trail[row, 2] - trail[newest, 2]
            turned = trail[row, 3] - trail[newest, 3]
            turned -= FULL_TURN * np.floor(turned / FULL_TURN + 0.5)
            c, s = cos_sin(turned)
            seen[back, 1] = cos * dx + sin * dy + c * rays.mount_x - s * rays.mount_y - rays.mount_x
            seen[back, 2] = cos * dy - sin * dx + s * rays.mount_x + c * rays.mount_y - rays.mount_y
            seen[back, 3] = turned
        row = before
    return seen


@jit
def place_at(seen: Floats, time: float, period: float) -> tuple[float, float, float]:
    """A LiDAR's place and heading at a time [s], interpolated; the nearest end outside.

    Returns:
        x, y [m] and heading [rad], from those now.
    """
    last = len(seen) - 2
    back = int(min(max((seen[0, 0] - time) / period, 0.0), float(last)))
    while back < last and seen[back + 1, 0] > time:
        back += 1
    while back > 0 and seen[back, 0] < time:
        back -= 1
    before = seen[back + 1, 0]
    share = min(max((time - before) / (seen[back, 0] - before), 0.0), 1.0)
    rest = 1.0 - share
    return (
        share * seen[back, 1] + rest * seen[back + 1, 1],
        share * seen[back, 2] + rest * seen[back + 1, 2],
        share * seen[back, 3] + rest * seen[back + 1, 3],
    )


@subroutine
def move_measurements(
    bearings: Floats,
    distances: Floats,
    xs: Floats,
    ys: Floats,
    turns: Floats,
    rays: Rays,
    places: Floats,
    lengths: Floats,
) -> None:
    """Compute how measurements look from elsewhere; a loop of its own, which can be vectorized.

    `xs`, `ys` and `turns`, (n,), tell where the LiDAR was, from its present place and heading.
    Written are `places`, directions in rays from the first one, -0.5 to less than a full turn
    beyond, and `lengths` [m], NOTHING where nothing was measured.
    """
    around = FULL_TURN / rays.step
    for k in range(len(bearings)):
        measured = distances[k] > 0.0
        distance = distances[k] if measured else 1.0
        cos, sin = cos_sin(bearings[k] + turns[k])
        x = distance * cos + (xs[k] if measured else 0.0)
        y = distance * sin + (ys[k] if measured else 0.0)
        place = (angle_of(x, y) - rays.start) / rays.step
        places[k] = place - around * np.floor((place + 0.5) / around)
        lengths[k] = math.sqrt(x * x + y * y) if measured else NOTHING


@subroutine
def sort_into_rays(
    places: Floats, lengths: Floats, reach: float, rays: Rays, ranges: Floats
) -> None:
    """Give each ray the range between the two measurements that are next to it in direction.

    It is interpolated where both may lie on one surface, and the nearer one's otherwise.
    """
    last = len(ranges)
    whole = abs(FULL_TURN / rays.step - last) < 1e-6  # the rays go all the way round
    # For each ray the lengths of the measurements below and above it, and how far off they are.
    sides, offs = np.full((2, last), NOTHING), np.full((2, last), NOTHING)
    for k in range(len(places)):
        low = int(np.floor(places[k]))
        high, off = low + 1, places[k] - low
        if whole:
            low, high = (last - 1 if low < 0 else low), (0 if high >= last else high)
        if 0 <= low < last and off < offs[1, low]:
            sides[1, low], offs[1, low] = lengths[k], off
        if 0 <= high < last and 1.0 - off < offs[0, high]:
            sides[0, high], offs[0, high] = lengths[k], 1.0 - off
    spread_to_empty(sides[0], offs[0], 0, 1, whole)
    spread_to_empty(sides[1], offs[1], last - 1, -1, whole)
    most, miss = reach / rays.step, MISS_HANDICAP / rays.step
    for ray in range(last):
        first, second, near, far = sides[0, ray], sides[1, ray], offs[0, ray], offs[1, ray]
        steep = MAX_SLOPE * min(first, second) * (near + far) * rays.step
        together = near <= most and far <= most and abs(first - second) <= steep
        between = (first * far + second * near) / (near + far + 1e-300)
        near += miss if first == NOTHING else 0.0
        far += miss if second == NOTHING else 0.0
        nearer = first if near <= far else second
        length = nearer if min(near, far) <= most + miss else NOTHING
        length = between if together else length
        ranges[ray] = min(max(length, rays.nearest), rays.farthest)


@jit
def spread_to_empty(sides: Floats, offs: Floats, first: int, step: int, whole: bool) -> None:
    """Give rays that have no measurement on one side that of the ray before them."""
    last = len(offs)
    length, off = NOTHING, NOTHING
    if whole and offs[first] >= NOTHING:
        for back in range(1, last):
            other = last - back if step > 0 else back - 1
            if offs[other] < NOTHING:
                length, off = sides[other], offs[other] + back - 1.0
                break
    for number in range(last):
        ray = first + number * step
        off += 1.0
        if offs[ray] >= NOTHING:
            sides[ray], offs[ray] = length, off
        else:
            length, off = sides[ray], offs[ray]


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

    Each is moved by the odometry between its time and now, then each ray takes what is next to it.
    """
    count = len(bearings)
    work = np.empty((5, count))  # indexed: loops over unpacked rows aren't vectorized
    xs, ys, turns, places, lengths = work[0], work[1], work[2], work[3], work[4]
    since = until = times[0] if count else 0.0
    for k in range(count):
        since, until = min(since, times[k]), max(until, times[k])
    seen = look_back(trail, newest, since, until, rays)
    least = most = 0.0
    for k in range(count):
        xs[k], ys[k], turns[k] = place_at(seen, times[k], rays.period)
        least, most = min(least, turns[k]), max(most, turns[k])
    move_measurements(bearings, distances, xs, ys, turns, rays, places, lengths)
    reach = GAP_STEPS * FULL_TURN / max(count, 1) + most - least
    sort_into_rays(places, lengths, reach, rays, ranges)


@jit
def newest_revolution(now: float, first: float, rate: float, phase: float) -> tuple[float, float]:
    """Number and end [s] of the newest complete revolution of a LiDAR that has always turned."""
    number: float = np.floor((now - first) * rate - phase)
    return number, first + (number + phase) / rate
