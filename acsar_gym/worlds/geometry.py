"""Obstacles around a robot: ranges of rays, collisions of footprints, and distances.

Lengths are in m, angles in rad. Rays and collisions are scalar functions and loops over obstacles,
compiled by numba, which skip obstacles out of reach early. Footprints and rays are in the frame of
the base: x ahead, y to the left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.jit import jit, loop, subroutine
from acsar_gym.trigonometry import angle_of
from acsar_gym.worlds.movers import pad_rows
from acsar_gym.worlds.world import AX, AY, BX, BY, RADIUS, World, X, Y

Floats = NDArray[np.float64]
Point = tuple[float, float]
Line = Floats | tuple[float, float, float, float]
"""A segment from a to b in columns AX to BY, as row of an array or as tuple [m]."""
FULL_TURN = 2.0 * math.pi
RAY_TOLERANCE = 1e-7
"""Tolerance at both ends of the range of rays that can meet an obstacle: more than the error of
`angle_of` [rad]."""


@dataclass(frozen=True, slots=True)
class RaySpec:
    """The rays of a planar LiDAR, counter-clockwise, the first ray at -field_of_view / 2."""

    rays: int
    reach: float = 5.0
    """Longest range, which also scales the observation [m]."""
    field_of_view: float = 2.0 * math.pi
    """Angle that the rays cover [rad]. In a full turn the last ray isn't the first ray again."""

    def angles(self) -> Floats:
        """Return the angle of every ray in the sensor's frame, (rays,) [rad]."""
        angles: Floats = -self.field_of_view / 2.0 + self.step * np.arange(self.rays, dtype=float)
        return angles

    @property
    def step(self) -> float:
        """Angle between two rays [rad]."""
        full = self.field_of_view > 2.0 * math.pi - 1e-6
        return self.field_of_view / max(self.rays if full else self.rays - 1, 1)


FIRST_ANGLE, RAY_STEP, REACH, MOUNT_X, MOUNT_Y, HALF_X, HALF_Y, IS_BOX, SIDE_COUNT = range(9)
"""Columns of `Surroundings.kinds`, a kind of robots: angle of the first ray and between two rays
[rad], the longest range [m], the place of the LiDAR in the base frame [m], half the length and
width of a box around the origin of the base frame that contains the footprint [m], whether the
footprint is that box, and how many sides it has."""
NORMAL_X, NORMAL_Y, OFFSET = range(BY + 1, BY + 4)
"""Columns of `Surroundings.sides` after those of a segment: the unit vector outwards, and the
distance of the side's line from the origin [m]."""


class Surroundings(NamedTuple):
    """Obstacles of many worlds, and rays and footprints of kinds of robots, for compiled loops."""

    circles: Floats
    """(worlds, circles, 3): x, y, radius [m]."""
    segments: Floats
    """(worlds, segments, 4): x1, y1, x2, y2 [m]."""
    directions: Floats
    """(kinds, rays, 2): cosine and sine of each ray's angle. Unused rows are zero."""
    kinds: Floats
    """(kinds, numbers): see `FIRST_ANGLE`. It is a single array, because compiled calls pass every
    array as many numbers."""
    sides: Floats
    """(kinds, sides, numbers): the sides of the footprints, see `NORMAL_X`. Unused rows are
    zero."""


class Fan(NamedTuple):
    """The rays of a robot."""

    directions: Floats
    """(rays, 2): cosine and sine of each ray's angle."""
    start: float
    """Angle of the first ray [rad]."""
    density: float
    """Number of rays in an angle [1/rad]."""
    reach: float
    """Longest range [m]."""


def make_surroundings(
    world: World | None, spec: RaySpec | None, config: RobotConfig
) -> Surroundings:
    """Make the arrays around a robot in a world, or on an open floor. See `surround_kinds`."""
    world = world or World()
    return surround_kinds(world.circles[None].copy(), world.segments[None].copy(), [spec], [config])


def surround_kinds(
    circles: Floats,
    segments: Floats,
    specs: Sequence[RaySpec | None],
    configs: Sequence[RobotConfig],
) -> Surroundings:
    """Make the arrays around robots of several kinds.

    Args:
        circles: (worlds, circles, 3): x, y, radius [m]. Unused rows may be circles of radius zero
            far away.
        segments: (worlds, segments, 4): x1, y1, x2, y2 [m].
        specs: Rays of each kind, or None for a kind without a LiDAR.
        configs: Configuration of each kind.
    """
    directions = []
    kinds = []
    sides = []
    for spec, config in zip(specs, configs, strict=True):
        # Compiled loops take a kind without a LiDAR as a kind with no rays.
        rays = spec or RaySpec(0, reach=1.0)
        angles = rays.angles()
        directions.append(np.column_stack([np.cos(angles), np.sin(angles)]))
        outline = np.array(config.outline)
        sides.append(_list_sides(outline))
        kinds.append(
            [  # in the order of the columns
                -rays.field_of_view / 2.0,
                rays.step,
                rays.reach,
                config.lidar_x_offset,
                config.lidar_y_offset,
                *np.abs(outline).max(axis=0),
                config.footprint is None,
                len(outline),
            ]
        )

    return Surroundings(
        circles,
        segments,
        directions=pad_rows(directions, (0.0, 0.0)),
        kinds=np.array(kinds),
        sides=pad_rows(sides, [0.0] * (OFFSET + 1)),
    )


def _list_sides(outline: Floats) -> Floats:
    """The sides of a convex outline, (sides, 7), see `NORMAL_X`."""
    ends = np.roll(outline, -1, axis=0)
    along = ends - outline

    # Corners are counter-clockwise: a quarter of a turn to the right is outwards.
    normals = along[:, [Y, X]] * (1.0, -1.0) / np.hypot(*along.T)[:, None]
    return np.column_stack([outline, ends, normals, (normals * outline).sum(axis=1)])


# Frames and distances


@jit
def length_of(x: float, y: float) -> float:
    """Length of a vector."""
    return math.sqrt(x * x + y * y)


@jit
def turn_back(dx: float, dy: float, cos: float, sin: float) -> Point:
    """Turn a vector into a frame whose heading has this cosine and sine."""
    return dx * cos + dy * sin, dy * cos - dx * sin


@jit
def line_at(segments: Floats, which: int, n: int) -> Line:
    """A segment of a world as tuple, which takes less time in compiled loops than a row."""
    return (
        segments[which, n, AX],
        segments[which, n, AY],
        segments[which, n, BX],
        segments[which, n, BY],
    )


@jit
def share_along(x: float, y: float, line: Line) -> float:
    """Where a segment is nearest to a point: 0 at a, 1 at b."""
    ex = line[BX] - line[AX]
    ey = line[BY] - line[AY]
    # The tiny number makes a segment without length its own nearest point.
    share = ((x - line[AX]) * ex + (y - line[AY]) * ey) / (ex * ex + ey * ey + 1e-300)
    return min(max(share, 0.0), 1.0)


@jit
def distance_to_segment(x: float, y: float, line: Line) -> float:
    """Distance of a point from a segment [m]."""
    share = share_along(x, y, line)
    # At the end b the place is exact, which a sum of two products isn't.
    if share == 1.0:
        return length_of(x - line[BX], y - line[BY])
    dx, dy = offset_from(x, y, line, share)
    return length_of(dx, dy)


@jit
def offset_from(x: float, y: float, line: Line, share: float) -> Point:
    """Vector to a point from the place at a share of a segment, see `share_along`."""
    dx = x - line[AX] - share * (line[BX] - line[AX])
    return dx, y - line[AY] - share * (line[BY] - line[AY])


@jit
def distance_between(a: Line, b: Line) -> float:
    """Distance of two segments, which are nearest at one of their ends if they don't cross [m]."""
    # They cross if each has its ends on different sides of the other.
    if side_of(a, b[AX], b[AY]) * side_of(a, b[BX], b[BY]) < 0.0 and (
        side_of(b, a[AX], a[AY]) * side_of(b, a[BX], a[BY]) < 0.0
    ):
        return 0.0
    return min(
        distance_to_segment(a[AX], a[AY], b),
        distance_to_segment(a[BX], a[BY], b),
        distance_to_segment(b[AX], b[AY], a),
        distance_to_segment(b[BX], b[BY], a),
    )


@jit
def side_of(line: Line, x: float, y: float) -> float:
    """The side of the line through a and b on which a point is: 1 left, -1 right, 0 on it."""
    ex = line[BX] - line[AX]
    ey = line[BY] - line[AY]
    side: float = np.sign(ex * (y - line[AY]) - ey * (x - line[AX]))
    return side


# Rays


@jit
def widest_angle(width: float, distance: float) -> float:
    """An angle [rad], a little more than asin(width / distance), or half a turn from inside."""
    # A polynomial that is never below the arcsine, and faster.
    share = width / (distance + 1e-300)
    if share >= 1.0:
        return 0.5 * FULL_TURN
    return share + (0.25 * FULL_TURN - 1.0) * share * share * share + RAY_TOLERANCE


@jit
def rays_between(first: float, last: float, rays: int) -> range:
    """The rays whose numbers are in an interval."""
    return range(max(math.ceil(first), 0), min(math.floor(last), rays - 1) + 1)


@jit
def see_circle(
    ranges: Floats, x: float, y: float, radius: float, origins: Floats, margin: float, fan: Fan
) -> None:
    """Shorten the rays that meet a circle in the sensor's frame.

    Rays start at their `origins`, which are within `margin` of the sensor.
    """
    directions = fan.directions

    # Only rays of this arc can meet it, which may lie a turn before or after their numbers.
    half = widest_angle(radius + margin, length_of(x, y)) * fan.density
    middle = (angle_of(x, y) - fan.start) * fan.density
    turn = FULL_TURN * fan.density
    for shift in (-turn, 0.0, turn):
        for k in rays_between(middle + shift - half, middle + shift + half, len(ranges)):
            # The ray's distance from the middle by Pythagoras: along it, and across.
            dx = x - origins[k, X]
            dy = y - origins[k, Y]
            outside = dx * dx + dy * dy - radius * radius
            along = dx * directions[k, X] + dy * directions[k, Y]
            inside = along * along - outside
            if outside <= 0.0:
                ranges[k] = 0.0
            elif inside >= 0.0 and along > 0.0:
                ranges[k] = min(ranges[k], along - math.sqrt(inside))


@jit
def see_segment(ranges: Floats, line: Line, origins: Floats, margin: float, fan: Fan) -> None:
    """Shorten the rays that meet a segment in the sensor's frame, as `see_circle`."""
    distance = distance_to_segment(0.0, 0.0, line)
    if distance > fan.reach + margin:
        return

    ax, ay, bx, by = line
    ex = bx - ax
    ey = by - ay
    directions = fan.directions

    extra = widest_angle(margin, distance) * fan.density

    # The rays between both ends, as the shorter arc, widened by the origins' margin.
    end = (angle_of(ax, ay) - fan.start) * fan.density
    width = angle_of(ax * bx + ay * by, ax * by - ay * bx) * fan.density
    first = min(end, end + width) - extra
    turn = FULL_TURN * fan.density
    last = min(max(end, end + width) + extra, first + turn)
    for shift in (-turn, 0.0, turn):
        for k in rays_between(first + shift, last + shift, len(ranges)):
            # Rays parallel to the segment meet it nowhere, or in a single point.
            across = directions[k, X] * ey - directions[k, Y] * ex
            if abs(across) > 1e-12:
                from_x = ax - origins[k, X]
                from_y = ay - origins[k, Y]
                length = (from_x * ey - from_y * ex) / across
                share = (from_x * directions[k, Y] - from_y * directions[k, X]) / across
                if length >= 0.0 and -1e-9 <= share <= 1.0 + 1e-9:
                    ranges[k] = min(ranges[k], length)


@loop
def cast_lines(  # noqa: PLR0913, PLR0917 - a tuple of the pose would be built for each robot
    x: float,
    y: float,
    cos: float,
    sin: float,
    which: int,
    around: Surroundings,
    origins: Floats,
    ranges: Floats,
    kind: int = 0,
) -> None:
    """Compute the ranges of rays that start at different places.

    Rays that meet nothing within reach have the reach. From inside a circle all ranges are zero.

    Args:
        x: Place of the base [m].
        y: Place of the base [m].
        cos: Cosine of its heading.
        sin: Sine of its heading.
        which: World among `around`.
        around: Obstacles and rays.
        origins: (rays, 2): where each ray starts, from the LiDAR's place at this pose, in the frame
            of the base [m].
        ranges: (rays,): receives the ranges [m].
        kind: Kind of the robot.
    """
    robot = around.kinds[kind]
    fan = Fan(
        around.directions[kind, : len(ranges)],
        start=robot[FIRST_ANGLE],
        density=1.0 / robot[RAY_STEP],
        reach=robot[REACH],
    )

    # From the base to the LiDAR, in which all that follows is measured.
    x += cos * robot[MOUNT_X] - sin * robot[MOUNT_Y]
    y += sin * robot[MOUNT_X] + cos * robot[MOUNT_Y]
    # How far the LiDAR moved during the revolution.
    margin = 0.0
    for k in range(len(ranges)):
        margin = max(margin, origins[k, X] ** 2 + origins[k, Y] ** 2)
    margin = math.sqrt(margin)

    # By index, because a loop over rows makes an array of each row, which takes longer.
    ranges[:] = fan.reach
    circles = around.circles
    for n in range(circles.shape[1]):
        dx = circles[which, n, X] - x
        dy = circles[which, n, Y] - y
        radius = circles[which, n, RADIUS]
        reach = fan.reach + radius + margin
        if dx * dx + dy * dy <= reach * reach:
            ahead, aside = turn_back(dx, dy, cos, sin)
            see_circle(ranges, ahead, aside, radius, origins=origins, margin=margin, fan=fan)
    walls = around.segments
    for n in range(walls.shape[1]):
        ax, ay = turn_back(walls[which, n, AX] - x, walls[which, n, AY] - y, cos, sin)
        bx, by = turn_back(walls[which, n, BX] - x, walls[which, n, BY] - y, cos, sin)
        see_segment(ranges, (ax, ay, bx, by), origins, margin, fan=fan)

    for k in range(len(ranges)):
        ranges[k] = min(max(ranges[k], 0.0), fan.reach)


def measure_ranges(
    place: tuple[float | Floats, float | Floats],
    bearings: Floats,
    world: World | None,
    moved: Floats | None = None,
) -> Floats:
    """Compute ranges at any bearings by NumPy.

    Args:
        place: Place x, y at which all rays start, or (rays,) each [m].
        bearings: (rays,): directions of the rays [rad].
        world: Obstacles, or None for an open floor.
        moved: (rays, movers, 2): where the world's movers were when each ray was measured [m], or
            None for rays that don't meet them.

    Returns:
        (rays,) [m]. Infinity for rays that meet nothing, and NaN if place or direction are unknown.
    """
    world = world or World()
    start = np.stack(np.broadcast_arrays(*place, bearings), axis=1)[:, None, :2]
    ray = np.column_stack([np.cos(bearings), np.sin(bearings)])[:, None]

    # Each ray has its own centres, because movers move during a revolution.
    centres = np.tile(world.circles[:, :RADIUS], (len(bearings), 1, 1))
    radii = world.circles[:, RADIUS]
    if moved is not None:
        centres = np.hstack([centres, moved])
        radii = np.append(radii, [mover.radius for mover in world.movers])
    offset = centres - start
    along = (ray * offset).sum(axis=2)
    inside = along * along - ((offset * offset).sum(axis=2) - radii * radii)
    to_discs = np.where(inside >= 0.0, along - np.sqrt(np.abs(inside)), np.inf)

    origin = world.segments[:, :BX] - start
    side = world.segments[:, BX:] - start - origin
    with np.errstate(divide="ignore", invalid="ignore"):
        across = _cross(ray, side)
        length = _cross(origin, side) / across
        share = _cross(origin, ray) / across
    to_walls = np.where((share >= 0.0) & (share <= 1.0), length, np.inf)

    lengths = np.hstack([to_discs, to_walls])
    ranges: Floats = np.min(np.where(lengths >= 0.0, lengths, np.inf), axis=1, initial=np.inf)

    # Comparisons with NaN are false, so rays from an unknown place would meet nothing.
    is_unknown = np.isnan(np.hstack([start, ray])).any(axis=(1, 2))
    ranges[is_unknown] = np.nan
    return ranges


def _cross(a: Floats, b: Floats) -> Floats:
    """The cross product of vectors (..., 2)."""
    product: Floats = a[..., X] * b[..., Y] - a[..., Y] * b[..., X]
    return product


# Footprints


@loop
def footprint_collides(
    x: float, y: float, cos: float, sin: float, which: int, around: Surroundings, kind: int = 0
) -> bool:
    """Return whether the footprint of a kind's robot at this pose touches an obstacle of a set."""
    outer = outer_radius(around, kind)
    circles = around.circles
    for n in range(circles.shape[1]):  # by index, as in `cast_lines`
        dx = circles[which, n, X] - x
        dy = circles[which, n, Y] - y
        radius = circles[which, n, RADIUS]
        if dx * dx + dy * dy <= (outer + radius) ** 2:
            ahead, aside = turn_back(dx, dy, cos, sin)
            near_x, near_y = nearest_place(ahead, aside, around, kind)
            if (ahead - near_x) ** 2 + (aside - near_y) ** 2 <= radius * radius:
                return True

    walls = around.segments
    for n in range(walls.shape[1]):
        ax = walls[which, n, AX] - x
        bx = walls[which, n, BX] - x
        ay = walls[which, n, AY] - y
        by = walls[which, n, BY] - y
        if min(ax, bx) <= outer and max(ax, bx) >= -outer and min(ay, by) <= outer:
            line = (*turn_back(ax, ay, cos, sin), *turn_back(bx, by, cos, sin))
            if segment_meets_footprint(line, around, kind):
                return True
    return False


@jit
def outer_radius(around: Surroundings, kind: int) -> float:
    """Radius of the disc around a kind's footprint [m]."""
    return length_of(around.kinds[kind, HALF_X], around.kinds[kind, HALF_Y])


@subroutine
def nearest_place(x: float, y: float, around: Surroundings, kind: int) -> Point:
    """The place of a kind's footprint that is nearest to a point of the base frame."""
    robot = around.kinds[kind]
    if robot[IS_BOX] > 0.0:
        near_x = min(max(x, -robot[HALF_X]), robot[HALF_X])
        near_y = min(max(y, -robot[HALF_Y]), robot[HALF_Y])
        return near_x, near_y

    place = (x, y)
    nearest = np.inf
    is_outside = False
    for side in around.sides[kind, : int(robot[SIDE_COUNT])]:
        share = share_along(x, y, side)
        near_x = side[AX] + share * (side[BX] - side[AX])
        near_y = side[AY] + share * (side[BY] - side[AY])
        distance = length_of(x - near_x, y - near_y)
        if distance < nearest:
            nearest = distance
            place = (near_x, near_y)
        if x * side[NORMAL_X] + y * side[NORMAL_Y] > side[OFFSET]:
            is_outside = True
    return place if is_outside else (x, y)


@jit
def footprint_gap(
    x: float, y: float, around: Surroundings, kind: int
) -> tuple[float, float, float]:
    """Distance of a point of the base frame from a kind's footprint, 0 inside, and where [m].

    Returns:
        The distance, and x and y of the place of the footprint that is nearest.
    """
    near_x, near_y = nearest_place(x, y, around, kind)
    return length_of(x - near_x, y - near_y), near_x, near_y


@subroutine
def segment_meets_footprint(line: Line, around: Surroundings, kind: int) -> bool:
    """Whether a segment in the base frame touches a kind's footprint.

    It is clipped by the half planes, as by M. Cyrus and J. Beck, "Generalized two- and
    three-dimensional clipping", Computers & Graphics 3 (1978).
    """
    ax, ay, bx, by = line
    # The part of the segment that is inside of all half planes so far, by its shares.
    enter = 0.0
    leave = 1.0
    for side in around.sides[kind, : int(around.kinds[kind, SIDE_COUNT])]:
        within = side[OFFSET] - (side[NORMAL_X] * ax + side[NORMAL_Y] * ay)
        along = side[NORMAL_X] * (bx - ax) + side[NORMAL_Y] * (by - ay)
        if along > 1e-15:
            leave = min(leave, within / along)
        elif along < -1e-15:
            enter = max(enter, within / along)
        elif within < 0.0:
            return False
    return enter <= leave


# Distances to the obstacles of a world


def point_clearance(points: ArrayLike, world: World) -> Floats:
    """Compute the distances of points (N, 2) to the nearest obstacle, (N,) [m].

    They are negative inside a circle, zero on a segment, infinite without obstacles.
    """
    return segment_clearance(points, points, world)


def segment_clearance(a: ArrayLike, b: ArrayLike, world: World) -> Floats:
    """Compute the distances (N,) of lines from a to b, (N, 2) each, to the nearest obstacle [m].

    They are minus the depth if a line enters a circle, zero if it meets a segment, infinite without
    obstacles. ValueError for arrays of other shapes.
    """
    lines = np.hstack([np.reshape(points, (-1, 2)) for points in (a, b)]).astype(np.float64)
    return _clear_lines(lines, world.circles, world.segments)


@loop
def _clear_lines(lines: Floats, circles: Floats, segments: Floats) -> Floats:
    """Compute the distances of lines to obstacles."""
    clearance = np.full(len(lines), np.inf)
    for n, line in enumerate(lines):
        for circle in circles:
            distance = distance_to_segment(circle[X], circle[Y], line) - circle[RADIUS]
            clearance[n] = min(clearance[n], distance)
        for wall in segments:
            clearance[n] = min(clearance[n], distance_between(line, wall))
    return clearance


@subroutine
def is_free(line: Line, circles: Floats, segments: Floats, radius: float) -> bool:
    """Whether obstacles are at least a distance away from a line."""
    for circle in circles:
        if distance_to_segment(circle[X], circle[Y], line) - circle[RADIUS] < radius:
            return False
    for wall in segments:  # noqa: SIM110 - for numba
        if distance_between(line, wall) < radius:
            return False
    return True
