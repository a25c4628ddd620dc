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
from acsar_gym.worlds.world import AX, AY, BX, BY, RADIUS, World, X, Y

Floats = NDArray[np.float64]
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
    """Angle that the rays cover [rad]; in a full turn the last ray isn't the first ray again."""

    def angles(self) -> Floats:
        """Return the angle of every ray in the sensor's frame, (rays,) [rad]."""
        angles: Floats = -self.field_of_view / 2.0 + self.step * np.arange(self.rays, dtype=float)
        return angles

    @property
    def step(self) -> float:
        """Angle between two rays [rad]."""
        full = self.field_of_view > 2.0 * math.pi - 1e-6
        return self.field_of_view / max(self.rays if full else self.rays - 1, 1)


class KindRow(NamedTuple):
    """The columns of `Surroundings.kinds`: a kind of robots, but for its rays and sides."""

    first_angle: float
    """Angle of the first ray [rad]."""
    ray_step: float
    """Angle between two rays [rad]."""
    reach: float
    """Longest range [m]."""
    mount_x: float
    """Position of the LiDAR in the base frame, ahead [m]."""
    mount_y: float
    """Position of the LiDAR in the base frame, to the left [m]."""
    half_x: float
    """Half the length of a box around the origin of the base frame that contains the footprint
    [m]."""
    half_y: float
    """Half the width of that box [m]."""
    is_box: float
    """Whether the footprint is the box."""
    side_count: float
    """How many sides the footprint has."""


class SideRow(NamedTuple):
    """The columns of `Surroundings.sides`: a side from a to b, and the half plane within it."""

    ax: float
    ay: float
    bx: float
    by: float
    normal_x: float
    """Unit vector outwards."""
    normal_y: float
    """Unit vector outwards."""
    offset: float
    """Distance of the side's line from the origin [m]."""


FIRST_ANGLE, RAY_STEP, REACH, MOUNT_X, MOUNT_Y, HALF_X, HALF_Y, IS_BOX, SIDE_COUNT = range(
    len(KindRow._fields)
)
NORMAL_X, NORMAL_Y, OFFSET = range(BY + 1, len(SideRow._fields))


class Surroundings(NamedTuple):
    """Obstacles of many worlds, and rays and footprints of kinds of robots, for compiled loops."""

    circles: Floats
    """(worlds, circles, 3): x, y, radius [m]."""
    segments: Floats
    """(worlds, segments, 4): x1, y1, x2, y2 [m]."""
    directions: Floats
    """(kinds, rays, 2): cosine and sine of each ray's angle; unused rows are zero."""
    kinds: Floats
    """(kinds, numbers): see `KindRow`. It is a single array, because compiled calls pass every
    array as many numbers."""
    sides: Floats
    """(kinds, sides, numbers): the sides of the footprints, see `SideRow`; unused rows are zero."""


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


class Circle(NamedTuple):
    """A circle [m]."""

    x: float
    y: float
    radius: float


class Segment(NamedTuple):
    """A straight line from a to b [m]."""

    ax: float
    ay: float
    bx: float
    by: float


def make_surroundings(
    world: World | None, spec: RaySpec | None, config: RobotConfig
) -> Surroundings:
    """Make the arrays around a robot in a world, or on an open floor; see `surround_kinds`."""
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
        specs: Rays of each kind; None for a kind without a LiDAR.
        configs: Configuration of each kind.
    """
    directions = []
    kinds = []
    sides = []
    for spec, config in zip(specs, configs, strict=True):
        angles = spec.angles() if spec else np.zeros(0)
        outline = np.array(config.outline)
        half_x, half_y = np.abs(outline).max(axis=0).tolist()
        kind = KindRow(
            first_angle=float(angles[0]) if spec else 0.0,
            ray_step=spec.step if spec else 1.0,
            reach=spec.reach if spec else 1.0,
            mount_x=config.lidar_x_offset,
            mount_y=config.lidar_y_offset,
            half_x=half_x,
            half_y=half_y,
            is_box=config.footprint is None,
            side_count=len(outline),
        )
        directions.append(np.column_stack([np.cos(angles), np.sin(angles)]))
        kinds.append(kind)
        sides.append(_list_sides(outline))

    return Surroundings(
        circles,
        segments,
        directions=pad_rows(directions, (0.0, 0.0)),
        kinds=np.array(kinds, np.float64),
        sides=pad_rows(sides, (0.0,) * len(SideRow._fields)),
    )


def _list_sides(outline: Floats) -> Floats:
    """The sides of a convex outline, (sides, numbers), see `SideRow`."""
    ends = np.roll(outline, -1, axis=0)
    along = ends - outline
    normals = along[:, [Y, X]] * (1.0, -1.0) / np.hypot(*along.T)[:, None]
    offsets = (normals * outline).sum(axis=1)
    return np.column_stack([outline, ends, normals, offsets])


def pad_rows(rows: Sequence[Floats], unused: tuple[float, ...]) -> Floats:
    """Stack arrays of different lengths to (arrays, longest, numbers), padded with `unused`."""
    longest = max((len(array) for array in rows), default=0)
    padded = np.tile(np.array(unused), (max(len(rows), 1), longest, 1))
    for number, array in enumerate(rows):
        padded[number, : len(array)] = array
    return padded


# Frames and distances


@jit
def circle_at(circles: Floats, n: int) -> Circle:
    """Read a row of (circles, 3)."""
    return Circle(circles[n, X], circles[n, Y], circles[n, RADIUS])


@jit
def segment_at(segments: Floats, n: int) -> Segment:
    """Read a row of (segments, 4)."""
    return Segment(segments[n, AX], segments[n, AY], segments[n, BX], segments[n, BY])


@jit
def turn_back(dx: float, dy: float, cos: float, sin: float) -> tuple[float, float]:
    """Turn a vector into a frame whose heading has this cosine and sine."""
    return dx * cos + dy * sin, dy * cos - dx * sin


@jit
def share_along(x: float, y: float, segment: Segment) -> float:
    """Where a segment is nearest to a point: 0 at a, 1 at b."""
    ex = segment.bx - segment.ax
    ey = segment.by - segment.ay
    share = ((x - segment.ax) * ex + (y - segment.ay) * ey) / (ex * ex + ey * ey + 1e-300)
    return min(max(share, 0.0), 1.0)


@jit
def distance_to_segment(x: float, y: float, segment: Segment) -> float:
    """Distance of a point from a segment [m]."""
    share = share_along(x, y, segment)
    if share < 1.0:
        dx = x - segment.ax - share * (segment.bx - segment.ax)
        dy = y - segment.ay - share * (segment.by - segment.ay)
    else:
        dx = x - segment.bx
        dy = y - segment.by
    return math.sqrt(dx * dx + dy * dy)


@jit
def side_of(segment: Segment, x: float, y: float) -> float:
    """The side of the line through a and b on which a point is: 1 left, -1 right, 0 on it."""
    ex = segment.bx - segment.ax
    ey = segment.by - segment.ay
    product = ex * (y - segment.ay) - ey * (x - segment.ax)
    return 1.0 if product > 0.0 else -1.0 if product < 0.0 else 0.0


@jit
def do_cross(first: Segment, second: Segment) -> bool:
    """Whether each of two segments has its ends on different sides of the other."""
    of_second = side_of(first, second.ax, second.ay) * side_of(first, second.bx, second.by)
    of_first = side_of(second, first.ax, first.ay) * side_of(second, first.bx, first.by)
    return of_second < 0.0 and of_first < 0.0


# Rays


@jit
def widest_angle(width: float, distance: float) -> float:
    """An angle [rad] that is a little more than asin(width / distance); half a turn from inside."""
    share = width / (distance + 1e-300)
    if share >= 1.0:
        return 0.5 * FULL_TURN
    return share + (0.25 * FULL_TURN - 1.0) * share * share * share + RAY_TOLERANCE


@jit
def rays_between(first: float, last: float, rays: int) -> range:
    """The rays whose numbers are in an interval."""
    return range(max(math.ceil(first), 0), min(math.floor(last), rays - 1) + 1)


@jit
def see_circle(ranges: Floats, circle: Circle, origins: Floats, margin: float, fan: Fan) -> None:
    """Shorten the rays that meet a circle in the sensor's frame.

    Rays start at their `origins`, which are within `margin` of the sensor.
    """
    x = circle.x
    y = circle.y
    radius = circle.radius
    directions = fan.directions

    # Only rays of this arc can meet it, which may lie a turn before or after their numbers.
    half = widest_angle(radius + margin, math.sqrt(x * x + y * y)) * fan.density
    middle = (angle_of(x, y) - fan.start) * fan.density
    turn = FULL_TURN * fan.density
    for shift in (-turn, 0.0, turn):
        for k in rays_between(middle + shift - half, middle + shift + half, len(ranges)):
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
def see_segment(ranges: Floats, line: Segment, origins: Floats, margin: float, fan: Fan) -> None:
    """Shorten the rays that meet a segment in the sensor's frame, as `see_circle`."""
    distance = distance_to_segment(0.0, 0.0, line)
    if distance > fan.reach + margin:
        return

    ax = line.ax
    ay = line.ay
    ex = line.bx - ax
    ey = line.by - ay
    directions = fan.directions

    extra = widest_angle(margin, distance) * fan.density
    end = (angle_of(ax, ay) - fan.start) * fan.density
    width = angle_of(ax * line.bx + ay * line.by, ax * line.by - ay * line.bx) * fan.density
    first = min(end, end + width) - extra
    turn = FULL_TURN * fan.density
    last = min(max(end, end + width) + extra, first + turn)
    for shift in (-turn, 0.0, turn):
        for k in rays_between(first + shift, last + shift, len(ranges)):
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
    kinds = around.kinds
    fan = Fan(
        around.directions[kind, : len(ranges)],
        start=kinds[kind, FIRST_ANGLE],
        density=1.0 / kinds[kind, RAY_STEP],
        reach=kinds[kind, REACH],
    )
    x += cos * kinds[kind, MOUNT_X] - sin * kinds[kind, MOUNT_Y]
    y += sin * kinds[kind, MOUNT_X] + cos * kinds[kind, MOUNT_Y]
    margin = 0.0
    for k in range(len(ranges)):
        margin = max(margin, origins[k, X] ** 2 + origins[k, Y] ** 2)
    margin = math.sqrt(margin)

    ranges[:] = fan.reach
    circles = around.circles[which]
    for n in range(len(circles)):
        circle = circle_at(circles, n)
        dx = circle.x - x
        dy = circle.y - y
        reach = fan.reach + circle.radius + margin
        if dx * dx + dy * dy <= reach * reach:
            ahead, aside = turn_back(dx, dy, cos, sin)
            see_circle(ranges, Circle(ahead, aside, circle.radius), origins, margin, fan=fan)
    segments = around.segments[which]
    for n in range(len(segments)):
        line = segment_at(segments, n)
        ax, ay = turn_back(line.ax - x, line.ay - y, cos, sin)
        bx, by = turn_back(line.bx - x, line.by - y, cos, sin)
        see_segment(ranges, Segment(ax, ay, bx, by), origins, margin, fan=fan)

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
        place: x and y at which all rays start, or (rays,) each [m].
        bearings: (rays,): directions of the rays [rad].
        world: Obstacles; None for an open floor.
        moved: (rays, movers, 2): where the world's movers were when each ray was measured [m]; None
            for rays that don't meet them.

    Returns:
        (rays,) [m]; infinity for rays that meet nothing.
    """
    if world is None:
        return np.full(len(bearings), np.inf)
    cos = np.cos(bearings)[:, None]
    sin = np.sin(bearings)[:, None]
    from_x, from_y = (np.reshape(values, (-1, 1)) for values in place)

    discs = [(world.circles[:, X], world.circles[:, Y], world.circles[:, RADIUS])]
    if moved is not None:
        radii = np.array([mover.radius for mover in world.movers])
        discs.append((moved[:, :, X], moved[:, :, Y], radii))
    hits = []
    for x, y, radius in discs:
        dx = x - from_x
        dy = y - from_y
        along = cos * dx + sin * dy
        inside = along * along - (dx * dx + dy * dy - radius * radius)
        hits.append(np.where(inside >= 0.0, along - np.sqrt(np.abs(inside)), np.inf))

    ax = world.segments[:, AX] - from_x
    ay = world.segments[:, AY] - from_y
    ex = world.segments[:, BX] - from_x - ax
    ey = world.segments[:, BY] - from_y - ay
    with np.errstate(divide="ignore", invalid="ignore"):
        across = cos * ey - sin * ex
        length = (ax * ey - ay * ex) / across
        share = (ax * sin - ay * cos) / across
    hits.append(np.where((share >= 0.0) & (share <= 1.0), length, np.inf))

    lengths = np.concatenate(hits, axis=1)
    ranges: Floats = np.min(np.where(lengths >= 0.0, lengths, np.inf), axis=1, initial=np.inf)
    return ranges


# Footprints


@loop
def footprint_collides(
    x: float, y: float, cos: float, sin: float, which: int, around: Surroundings, kind: int = 0
) -> bool:
    """Return whether the footprint of a kind's robot at this pose touches an obstacle of a set."""
    outer = outer_radius(around, kind)
    circles = around.circles[which]
    for n in range(len(circles)):
        circle = circle_at(circles, n)
        dx = circle.x - x
        dy = circle.y - y
        reach = outer + circle.radius
        if dx * dx + dy * dy <= reach * reach:
            ahead, aside = turn_back(dx, dy, cos, sin)
            near_x, near_y = nearest_place(ahead, aside, around, kind)
            dx = ahead - near_x
            dy = aside - near_y
            if dx * dx + dy * dy <= circle.radius * circle.radius:
                return True

    segments = around.segments[which]
    for n in range(len(segments)):
        line = segment_at(segments, n)
        ax = line.ax - x
        ay = line.ay - y
        bx = line.bx - x
        by = line.by - y
        if min(ax, bx) <= outer and max(ax, bx) >= -outer and min(ay, by) <= outer:
            from_x, from_y = turn_back(ax, ay, cos, sin)
            to_x, to_y = turn_back(bx, by, cos, sin)
            if segment_meets_footprint(Segment(from_x, from_y, to_x, to_y), around, kind):
                return True
    return False


@jit
def outer_radius(around: Surroundings, kind: int) -> float:
    """Radius of the disc around a kind's footprint [m]."""
    half_x = around.kinds[kind, HALF_X]
    half_y = around.kinds[kind, HALF_Y]
    return math.sqrt(half_x * half_x + half_y * half_y)


@subroutine
def nearest_place(x: float, y: float, around: Surroundings, kind: int) -> tuple[float, float]:
    """The place of a kind's footprint that is nearest to a point of the base frame."""
    kinds = around.kinds
    if kinds[kind, IS_BOX] > 0.0:
        near_x = min(max(x, -kinds[kind, HALF_X]), kinds[kind, HALF_X])
        near_y = min(max(y, -kinds[kind, HALF_Y]), kinds[kind, HALF_Y])
        return near_x, near_y

    sides = around.sides[kind]
    place = (x, y)
    nearest = np.inf
    is_outside = False
    for n in range(int(kinds[kind, SIDE_COUNT])):
        side = segment_at(sides, n)
        share = share_along(x, y, side)
        near_x = side.ax + share * (side.bx - side.ax)
        near_y = side.ay + share * (side.by - side.ay)
        distance = math.sqrt((x - near_x) ** 2 + (y - near_y) ** 2)
        if distance < nearest:
            nearest = distance
            place = (near_x, near_y)
        if x * sides[n, NORMAL_X] + y * sides[n, NORMAL_Y] > sides[n, OFFSET]:
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
    return math.sqrt((x - near_x) ** 2 + (y - near_y) ** 2), near_x, near_y


@subroutine
def segment_meets_footprint(line: Segment, around: Surroundings, kind: int) -> bool:
    """Whether a segment in the base frame touches a kind's footprint.

    It is clipped by the half planes, as by M. Cyrus and J. Beck, "Generalized two- and
    three-dimensional clipping", Computers & Graphics 3 (1978).
    """
    sides = around.sides[kind]
    enter = 0.0
    leave = 1.0
    for n in range(int(around.kinds[kind, SIDE_COUNT])):
        normal_x = sides[n, NORMAL_X]
        normal_y = sides[n, NORMAL_Y]
        within = sides[n, OFFSET] - (normal_x * line.ax + normal_y * line.ay)
        along = normal_x * (line.bx - line.ax) + normal_y * (line.by - line.ay)

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
    obstacles.
    """
    starts = _validate_points(a)
    ends = _validate_points(b)
    if len(starts) != len(ends):
        raise ValueError(f"{len(starts)} starts and {len(ends)} ends of pieces")
    clearance = np.full(len(starts), np.inf)
    _clear_lines(np.hstack([starts, ends]), world.circles, world.segments, clearance)
    return clearance


def _validate_points(points: ArrayLike) -> Floats:
    """A copy of points (N, 2); ValueError for another shape."""
    array = np.array(points, np.float64, order="C")
    if array.size == 0:
        return np.zeros((0, 2))
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"points must be of shape (N, 2), not {array.shape}")
    return array


@loop
def _clear_lines(lines: Floats, circles: Floats, segments: Floats, clearance: Floats) -> None:
    """Lower `clearance` to the distances of lines to obstacles."""
    for n in range(len(lines)):
        line = segment_at(lines, n)
        for k in range(len(circles)):
            circle = circle_at(circles, k)
            distance = distance_to_segment(circle.x, circle.y, line) - circle.radius
            clearance[n] = min(clearance[n], distance)

        for k in range(len(segments)):
            wall = segment_at(segments, k)
            if do_cross(line, wall):
                clearance[n] = min(clearance[n], 0.0)
                continue
            # Two segments that don't cross are nearest at one of their four ends.
            clearance[n] = min(
                clearance[n],
                distance_to_segment(line.ax, line.ay, wall),
                distance_to_segment(line.bx, line.by, wall),
                distance_to_segment(wall.ax, wall.ay, line),
                distance_to_segment(wall.bx, wall.by, line),
            )
