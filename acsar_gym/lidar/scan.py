"""Scans of a LiDAR that turns while the robot drives: from measurements to rays.

A LiDAR delivers revolutions, whose measurements have a bearing, a distance and a time each.
`fill_scan` moves them by the odometry between their time and now, and sorts them into the rays of
an observation. A device, a simulated LiDAR and a batch share it.
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
"""A ray prefers a measured distance to a failed measurement that is nearer in direction by up to
this angle, because a single failure among many measurements isn't free space [rad]."""
MAX_SLOPE = 3.0
"""Largest change of range per range and radian between two measurements of the same surface. A wall
is then seen at an angle of up to 72 degrees from its normal."""
GAP_STEPS = 2.0
"""A ray takes measurements up to this many steps away, a step being the angle between two
measurements of a robot at rest. Farther away nothing is known."""
NOTHING = 1e9
"""Length of a failed measurement, and distance in rays of a measurement that doesn't exist: larger
than any real number of these."""
TIME, PLACE_X, PLACE_Y, HEADING = range(4)
"""Columns of poses: time [s], place [m] and heading [rad]."""
BELOW, ABOVE = range(2)
"""Sides of a ray, by direction."""


class Revolution(NamedTuple):
    """One turn of a LiDAR's head: n measurements, in any order."""

    bearings: Floats
    """(n,): counter-clockwise from the robot's x axis [rad]."""
    distances: Floats
    """(n,) [m]. 0 for a failed measurement."""
    times: Floats
    """(n,): time of each measurement on the clock of the robot's link [s]."""
    stamp: float
    """End of the revolution on that clock [s]."""


class Scan(NamedTuple):
    """The ranges that a LiDAR would measure from the robot's present pose."""

    ranges: Floats
    """(rays,): range in each direction [m], within min_range to max_range, counter-clockwise from
    -field_of_view / 2 of the robot's x axis. `max_range` if nothing was measured."""
    stamp: float
    """End of the revolution on the link's clock [s]."""


class Rays(NamedTuple):
    """The rays of an observation and the place of the LiDAR, for compiled loops."""

    start: float
    """Angle of the first ray [rad]."""
    step: float
    """Angle between two rays [rad]."""
    nearest: float
    """Shortest range [m]."""
    farthest: float
    """Longest range [m]."""
    mount_x: float
    """Position of the LiDAR in the base frame, forward [m]."""
    mount_y: float
    """Position of the LiDAR in the base frame, to the left [m]."""
    period: float
    """Approximate time between two rows of a trail [s]."""


def ray_spec(config: RobotConfig) -> RaySpec:
    """Return the rays of a robot's LiDAR."""
    lidar = config.lidar
    return RaySpec(lidar.rays, lidar.max_range, lidar.field_of_view)


def make_rays(config: RobotConfig) -> Rays:
    """Return the rays of a robot's LiDAR for `fill_scan`."""
    spec = ray_spec(config)
    return Rays(
        start=float(spec.angles()[0]),
        step=spec.step,
        nearest=config.lidar.min_range,
        farthest=config.lidar.max_range,
        mount_x=config.lidar_x_offset,
        mount_y=config.lidar_y_offset,
        period=config.period,
    )


class Ring(NamedTuple):
    """The last poses of a robot, for compiled loops."""

    rows: Floats
    """(slots, 4): columns TIME, PLACE_X, PLACE_Y and HEADING. The first row follows the last."""
    newest: int
    """Row of the newest pose."""


class Trail:
    """The poses of a robot at the ends of the last ticks, by odometry or in truth.

    Attributes:
        rows: As in `Ring`.
        newest: As in `Ring`. -1 before the first mark.
    """

    def __init__(self, duration: float, period: float) -> None:
        self.rows = np.zeros((count_trail_rows(duration, period), 4))
        self.newest = -1
        self._period = period

    @property
    def ring(self) -> Ring:
        """The poses for compiled loops."""
        return Ring(self.rows, self.newest)

    def mark(self, time: float, pose: tuple[float, float, float]) -> None:
        """Add a row, or change the newest row if no time has passed."""
        is_first = self.newest < 0
        if is_first:
            begin_trail(self.rows, time, pose, dt=self._period)
        # A mark at the same time replaces the row, as after a reset.
        if is_first or time > self.rows[self.newest, TIME]:
            self.newest = (self.newest + 1) % len(self.rows)
        self.rows[self.newest] = time, *pose


def count_trail_rows(duration: float, period: float) -> int:
    """Return the rows of a trail that covers a duration [s], with a row every period [s]."""
    return math.ceil(duration / period) + 2


@loop
def begin_trail(trail: Floats, time: float, pose: tuple[float, float, float], dt: float) -> None:
    """Fill a trail with the pose of a robot that has been at rest. Its next row is 0."""
    slots = len(trail)
    for slot in range(slots):
        trail[slot, TIME] = time - (slots - slot) * dt
        trail[slot, PLACE_X], trail[slot, PLACE_Y], trail[slot, HEADING] = pose


@jit
def look_back(ring: Ring, since: float, until: float, rays: Rays) -> Floats:
    """Compute the poses of a LiDAR during a time, relative to its present pose.

    Returns:
        Poses, the newest first: place of the LiDAR in the robot's present frame, from the
        LiDAR's present place, and heading from the present heading. Rows that `place_at` doesn't
        need for this time have only a time.
    """
    trail, newest = ring
    slots = len(trail)
    poses = np.zeros((slots, 4))
    cos, sin = cos_sin(trail[newest, HEADING])
    row = newest
    is_complete = False
    for back in range(slots):
        poses[back, TIME] = trail[row, TIME]
        previous = row - 1 if row > 0 else slots - 1
        if not is_complete and (back == slots - 1 or trail[previous, TIME] <= until):
            is_complete = trail[row, TIME] < since

            # The robot in its present frame.
            dx = trail[row, PLACE_X] - trail[newest, PLACE_X]
            dy = trail[row, PLACE_Y] - trail[newest, PLACE_Y]
            turned = trail[row, HEADING] - trail[newest, HEADING]
            # Headings may jump by a full turn between two rows.
            turned -= FULL_TURN * np.floor(turned / FULL_TURN + 0.5)

            # The LiDAR on it.
            c, s = cos_sin(turned)
            x = cos * dx + sin * dy + c * rays.mount_x - s * rays.mount_y
            y = cos * dy - sin * dx + s * rays.mount_x + c * rays.mount_y
            poses[back, PLACE_X] = x - rays.mount_x
            poses[back, PLACE_Y] = y - rays.mount_y
            poses[back, HEADING] = turned
        row = previous
    return poses


@jit
def place_at(poses: Floats, time: float, period: float) -> tuple[float, float, float]:
    """Interpolate a LiDAR's relative pose at a time [s]. The nearest end of the trail outside.

    Args:
        poses: Rows of `look_back`.
        time: Time [s].
        period: Approximate time between two rows [s].

    Returns:
        x, y [m] and heading [rad].
    """
    # Rows are about a period apart, so the search starts near the right row.
    last = len(poses) - 2
    back = int(min(max((poses[0, TIME] - time) / period, 0.0), float(last)))
    while back < last and poses[back + 1, TIME] > time:
        back += 1
    while back > 0 and poses[back, TIME] < time:
        back -= 1

    earlier = poses[back + 1, TIME]
    share = min(max((time - earlier) / (poses[back, TIME] - earlier), 0.0), 1.0)
    # Between two rows the robot moves evenly.
    remainder = 1.0 - share
    return (
        share * poses[back, PLACE_X] + remainder * poses[back + 1, PLACE_X],
        share * poses[back, PLACE_Y] + remainder * poses[back + 1, PLACE_Y],
        share * poses[back, HEADING] + remainder * poses[back + 1, HEADING],
    )


@loop
def fill_scan(revolution: Revolution, ring: Ring, rays: Rays, ranges: Floats) -> None:
    """Compute the ranges along a robot's present rays from the measurements of a revolution.

    Args:
        revolution: Measurements.
        ring: Poses by odometry, of which the newest is the present pose.
        rays: Rays of the observation.
        ranges: Receives the range of each ray [m].
    """
    times = revolution.times
    count = len(times)
    work = np.empty((5, count))  # loops over rows that are unpacked in one line aren't vectorized
    xs = work[0]
    ys = work[1]
    turns = work[2]
    places = work[3]
    lengths = work[4]

    # Where the LiDAR was at each measurement, by the odometry between then and now.
    since = until = times[0] if count else 0.0
    for k in range(count):
        since = min(since, times[k])
        until = max(until, times[k])
    poses = look_back(ring, since, until, rays=rays)
    # How far the robot turned to each side widens or narrows the gaps between measurements.
    right_turn = left_turn = 0.0
    for k in range(count):
        xs[k], ys[k], turns[k] = place_at(poses, times[k], rays.period)
        right_turn = min(right_turn, turns[k])
        left_turn = max(left_turn, turns[k])

    move_measurements(revolution, xs, ys, turns=turns, rays=rays, places=places, lengths=lengths)
    reach = GAP_STEPS * FULL_TURN / max(count, 1) + left_turn - right_turn
    sort_into_rays(places, lengths, reach, rays=rays, ranges=ranges)


@subroutine
def move_measurements(
    revolution: Revolution,
    xs: Floats,
    ys: Floats,
    turns: Floats,
    rays: Rays,
    places: Floats,
    lengths: Floats,
) -> None:
    """Compute how measurements look from the present pose. A separate loop, so that it vectorizes.

    Args:
        revolution: n measurements.
        xs: (n,): place of the LiDAR at each measurement, from its present place [m].
        ys: (n,): likewise.
        turns: (n,): its heading, from the present heading [rad].
        rays: Rays of the observation.
        places: (n,): receives directions in rays from the first ray, from -0.5 to less than a full
            turn more.
        lengths: (n,): receives lengths [m], NOTHING for failed measurements.
    """
    # Distances don't depend on each other here, so the compiler can do several at once.
    full_turn = FULL_TURN / rays.step
    for k in range(len(turns)):
        is_measured = revolution.distances[k] > 0.0
        distance = revolution.distances[k] if is_measured else 1.0
        cos, sin = cos_sin(revolution.bearings[k] + turns[k])
        x = distance * cos + (xs[k] if is_measured else 0.0)
        y = distance * sin + (ys[k] if is_measured else 0.0)
        place = (angle_of(x, y) - rays.start) / rays.step
        places[k] = place - full_turn * np.floor((place + 0.5) / full_turn)
        lengths[k] = math.sqrt(x * x + y * y) if is_measured else NOTHING


@subroutine
def sort_into_rays(
    places: Floats, lengths: Floats, reach: float, rays: Rays, ranges: Floats
) -> None:
    """Give each ray the range between the two measurements that are next to it in direction.

    The range is interpolated if both can lie on one surface. Otherwise it is that of the nearer
    measurement.
    """
    count = len(ranges)
    is_full_turn = abs(FULL_TURN / rays.step - count) < 1e-6

    # The measurements next to each ray on both sides, and how many rays they are away.
    sides = np.full((2, count), NOTHING)
    gaps = np.full((2, count), NOTHING)
    for k in range(len(places)):
        low = int(np.floor(places[k]))
        gap = places[k] - low
        for side, place in ((ABOVE, low), (BELOW, low + 1)):
            ray = place % count if is_full_turn else place
            if 0 <= ray < count and gap < gaps[side, ray]:
                sides[side, ray] = lengths[k]
                gaps[side, ray] = gap
            gap = 1.0 - gap
    spread_to_empty(sides[BELOW], gaps[BELOW], 0, step=1, is_full_turn=is_full_turn)
    spread_to_empty(sides[ABOVE], gaps[ABOVE], count - 1, step=-1, is_full_turn=is_full_turn)

    farthest_gap = reach / rays.step
    handicap = MISS_HANDICAP / rays.step
    for ray in range(count):
        first = sides[BELOW, ray]
        second = sides[ABOVE, ray]
        first_gap = gaps[BELOW, ray]
        second_gap = gaps[ABOVE, ray]

        # On one surface?
        rise = MAX_SLOPE * min(first, second) * (first_gap + second_gap) * rays.step
        is_surface = (
            first_gap <= farthest_gap and second_gap <= farthest_gap and abs(first - second) <= rise
        )
        between = (first * second_gap + second * first_gap) / (first_gap + second_gap + 1e-300)

        # The nearer measurement.
        first_gap += handicap if first == NOTHING else 0.0
        second_gap += handicap if second == NOTHING else 0.0
        nearer = first if first_gap <= second_gap else second
        length = nearer if min(first_gap, second_gap) <= farthest_gap + handicap else NOTHING

        length = between if is_surface else length
        ranges[ray] = min(max(length, rays.nearest), rays.farthest)


@jit
def spread_to_empty(sides: Floats, gaps: Floats, first: int, step: int, is_full_turn: bool) -> None:
    """Give rays without a measurement on one side that of the previous ray."""
    count = len(gaps)
    length = gap = NOTHING
    # In a full turn, the last ray is next to the first ray.
    if is_full_turn and gaps[first] >= NOTHING:
        for back in range(1, count):
            ray = count - back if step > 0 else back - 1
            if gaps[ray] < NOTHING:
                length = sides[ray]
                gap = gaps[ray] + back - 1.0
                break

    for number in range(count):
        ray = first + number * step
        gap += 1.0
        if gaps[ray] >= NOTHING:
            sides[ray] = length
            gaps[ray] = gap
        else:
            length = sides[ray]
            gap = gaps[ray]
