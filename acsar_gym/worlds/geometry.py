"""Obstacles around a robot: ranges of rays, collisions of footprints, and distances.

Lengths in m, angles in rad. Rays and collisions are scalar functions and loops over obstacles,
compiled where numba is installed; obstacles out of reach are skipped early. Footprints and rays are
in the frame of the base: x ahead, y to the left. Distances are computed by NumPy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acsar_gym.config import RobotConfig, footprint
from acsar_gym.errors import ConfigError
from acsar_gym.jit import jit, loop, subroutine
from acsar_gym.trigonometry import angle_of
from acsar_gym.worlds.world import World

Floats = NDArray[np.float64]
FULL_TURN = 2.0 * math.pi
RAY_TOLERANCE = 1e-7
"""Tolerance at both ends of the range of rays that can meet an obstacle: more than `angle_of` may
be wrong by [rad]."""
CLEARANCE_CHUNK = 2**14  # distances that are computed at a time, so that memory stays at a few MB


@dataclass(frozen=True)
class Obstacles:
    """Circles (x, y, radius) and segments (x1, y1, x2, y2) in the frame of the world [m].

    Either one set for all robots, of shapes (C, 3) and (S, 4), or one for each robot, of shapes
    (robots, C, 3) and (robots, S, 4). Unused rows may be circles of radius zero far away.
    """

    circles: Floats | Sequence[Any] = ()
    """Finite, with radii of 0 or more."""
    segments: Floats | Sequence[Any] = ()

    def arrays(self, robots: int) -> tuple[Floats, Floats]:
        """Circles (W, C, 3) and segments (W, S, 4), W being 1 or `robots`; or ConfigError."""
        stacks = []
        for rows, width in ((self.circles, 3), (self.segments, 4)):
            array = np.array(rows, np.float64)
            array = array.reshape(1, 0, width) if array.size == 0 else array
            array = array[None] if array.ndim == 2 else array
            if array.shape[2:] != (width,) or len(array) not in (1, robots):
                raise ConfigError(
                    f"obstacles: must be of shape (n, {width}) or ({robots}, n, {width})"
                )
            stacks.append(array)
        sets = max(map(len, stacks))
        circles, segments = (np.broadcast_to(a, (sets, *a.shape[1:])) for a in stacks)
        return np.ascontiguousarray(circles), np.ascontiguousarray(segments)


@dataclass(frozen=True, slots=True)
class RaySpec:
    """The rays of a planar LiDAR, counter-clockwise, the first one at -field_of_view / 2."""

    rays: int
    reach: float = 5.0
    """Longest range, which also scales the observation [m]."""
    field_of_view: float = 2.0 * math.pi
    """Angle that the rays cover [rad]; in a full turn the last ray isn't the first one again."""

    def angles(self) -> Floats:
        """Angle of every ray in the sensor's frame, (rays,) [rad]."""
        angles: Floats = -self.field_of_view / 2.0 + self.step * np.arange(self.rays, dtype=float)
        return angles

    @property
    def step(self) -> float:
        """Angle between two rays [rad]."""
        full = self.field_of_view > 2.0 * math.pi - 1e-6
        return self.field_of_view / max(self.rays if full else self.rays - 1, 1)


class Surroundings(NamedTuple):
    """Obstacles of many worlds, rays and footprints of one or more kinds of robots, for loops."""

    circles: Floats
    """(sets, circles, 3): x, y, radius [m]."""
    segments: Floats
    """(sets, segments, 4): x1, y1, x2, y2 [m]."""
    directions: Floats
    """(kinds, rays, 2): cosine and sine of each ray's angle; unused rows are zero."""
    kinds: Floats
    """(kinds, 8): the other fields of `Fan`; half the length and half the width of a box around the
    origin of the base frame that contains the footprint [m]; and how many sides the footprint has,
    0 where it is the box. One array, because calls pass every array as many numbers."""
    sides: Floats
    """(kinds, sides, 4): x1, y1, x2, y2 of polygonal footprints [m]; unused rows are zero."""


class Fan(NamedTuple):
    """The rays of one robot."""

    directions: Floats
    """(rays, 2): cosine and sine of each ray's angle."""
    start: float
    """Angle of the first ray [rad]."""
    step: float
    """Angle between two rays [rad]."""
    reach: float
    """Longest range [m]."""
    mount_x: float
    """Position of the LiDAR in the base frame, ahead [m]."""
    mount_y: float
    """Position of the LiDAR in the base frame, to the left [m]."""


def make_surroundings(
    obstacles: Obstacles, spec: RaySpec | None, robots: int, config: RobotConfig
) -> Surroundings:
    """Make the arrays around robots of one kind; see `surround_kinds`."""
    return surround_kinds(obstacles, [spec], robots, [config])


def surround_kinds(
    obstacles: Obstacles,
    specs: Sequence[RaySpec | None],
    robots: int,
    configs: Sequence[RobotConfig],
) -> Surroundings:
    """Make the arrays around robots of several kinds; ConfigError as `Obstacles.arrays`."""
    circles, segments = obstacles.arrays(robots)
    angles = [spec.angles() if spec else np.zeros(0) for spec in specs]
    outlines = [config.footprint for config in configs]
    sides = [list(footprint.outline_sides(outline)) if outline else [] for outline in outlines]
    return Surroundings(
        circles,
        segments,
        pad_rows([np.stack([np.cos(each), np.sin(each)], axis=1) for each in angles], (0.0, 0.0)),
        np.array(
            [
                (
                    float(each[0]) if spec else 0.0,
                    spec.step if spec else 1.0,
                    spec.reach if spec else 1.0,
                    config.lidar_x_offset,
                    config.lidar_y_offset,
                    max(abs(x) for x, _ in config.outline),
                    max(abs(y) for _, y in config.outline),
                    float(len(around)),
                )
                for spec, each, around, config in zip(specs, angles, sides, configs, strict=True)
            ]
        ),
        pad_rows([np.reshape(each, (-1, 4)) for each in sides], (0.0, 0.0, 0.0, 0.0)),
    )


def pad_rows(rows: Sequence[Floats], unused: tuple[float, ...]) -> Floats:
    """Stack arrays of different lengths to (arrays, longest, numbers), padded with `unused`."""
    longest = max((len(array) for array in rows), default=0)
    padded = np.tile(np.array(unused), (max(len(rows), 1), longest, 1))
    for number, array in enumerate(rows):
        padded[number, : len(array)] = array
    return padded


@jit
def fan_of(around: Surroundings, kind: int, rays: int) -> Fan:
    """The rays of a kind of robots, which has so many of them."""
    kinds = around.kinds
    return Fan(
        around.directions[kind, :rays],
        kinds[kind, 0],
        kinds[kind, 1],
        kinds[kind, 2],
        kinds[kind, 3],
        kinds[kind, 4],
    )


@jit
def widest_angle(width: float, distance: float) -> float:
    """An angle [rad] that is a little more than asin(width / distance); half a turn from inside."""
    share = width / (distance + 1e-300)
    if share >= 1.0:
        return 0.5 * FULL_TURN
    return share + (0.25 * FULL_TURN - 1.0) * share * share * share + RAY_TOLERANCE


@jit
def see_circle(
    ranges: Floats,
    x: float,
    y: float,
    radius: float,
    origins: Floats,
    margin: float,
    fan: Fan,
) -> None:
    """Shorten the rays that meet a circle; they begin within `margin` of the sensor."""
    last, directions, density = len(ranges) - 1, fan.directions, 1.0 / fan.step
    half = widest_angle(radius + margin, math.sqrt(x * x + y * y)) * density
    middle = (angle_of(x, y) - fan.start) * density
    for shift in (-FULL_TURN * density, 0.0, FULL_TURN * density):
        if middle + shift + half < 0.0 or middle + shift - half > last:
            continue
        low = max(math.ceil(middle + shift - half), 0)
        high = min(math.floor(middle + shift + half), last)
        for k in range(low, high + 1):
            dx, dy = x - origins[k, 0], y - origins[k, 1]
            apart = dx * dx + dy * dy - radius * radius
            along = dx * directions[k, 0] + dy * directions[k, 1]
            inside = along * along - apart
            if apart <= 0.0:
                ranges[k] = 0.0
            elif inside >= 0.0 and along > 0.0:
                ranges[k] = min(ranges[k], along - math.sqrt(inside))


@jit
def see_segment(
    ranges: Floats,
    ax: float,
    ay: float,
    bx: float,
    by: float,
    origins: Floats,
    margin: float,
    fan: Fan,
) -> None:
    """Shorten the rays that meet a segment from a to b in the sensor's frame, as `see_circle`."""
    ex, ey = bx - ax, by - ay
    share = -(ax * ex + ay * ey) / (ex * ex + ey * ey + 1e-300)
    share = min(max(share, 0.0), 1.0)
    near_x, near_y = ax + share * ex, ay + share * ey
    distance = math.sqrt(near_x * near_x + near_y * near_y)
    if distance > fan.reach + margin:
        return
    last, directions, density = len(ranges) - 1, fan.directions, 1.0 / fan.step
    extra = widest_angle(margin, distance) * density
    end = (angle_of(ax, ay) - fan.start) * density
    width = angle_of(ax * bx + ay * by, ax * by - ay * bx) * density
    first, top = min(end, end + width) - extra, max(end, end + width) + extra
    top = min(top, first + FULL_TURN * density)
    for shift in (-FULL_TURN * density, 0.0, FULL_TURN * density):
        if top + shift < 0.0 or first + shift > last:
            continue
        low = max(math.ceil(first + shift), 0)
        high = min(math.floor(top + shift), last)
        for k in range(low, high + 1):
            across = directions[k, 0] * ey - directions[k, 1] * ex
            if abs(across) > 1e-12:
                from_x, from_y = ax - origins[k, 0], ay - origins[k, 1]
                length = (from_x * ey - from_y * ex) / across
                share = (from_x * directions[k, 1] - from_y * directions[k, 0]) / across
                if length >= 0.0 and -1e-9 <= share <= 1.0 + 1e-9:
                    ranges[k] = min(ranges[k], length)


@loop
def cast_lines(  # noqa: PLR0913, PLR0917 - as `cast_rays`
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
    """Compute the ranges of rays that begin at places of their own; otherwise as `cast_rays`.

    `origins` (rays, 2) are where each ray begins, from the LiDAR's place at this pose, in the frame
    of the base [m].
    """
    fan = fan_of(around, kind, len(ranges))
    x += cos * fan.mount_x - sin * fan.mount_y
    y += sin * fan.mount_x + cos * fan.mount_y
    circles, segments, margin = around.circles, around.segments, 0.0
    ranges[:] = fan.reach
    for k in range(len(ranges)):
        margin = max(margin, origins[k, 0] ** 2 + origins[k, 1] ** 2)
    margin = math.sqrt(margin)
    for n in range(circles.shape[1]):
        dx, dy, radius = circles[which, n, 0] - x, circles[which, n, 1] - y, circles[which, n, 2]
        far = fan.reach + radius + margin
        if dx * dx + dy * dy <= far * far:
            ahead, left = dx * cos + dy * sin, dy * cos - dx * sin
            see_circle(ranges, ahead, left, radius, origins, margin, fan)
    for n in range(segments.shape[1]):
        px, py = segments[which, n, 0] - x, segments[which, n, 1] - y
        qx, qy = segments[which, n, 2] - x, segments[which, n, 3] - y
        ax, ay = px * cos + py * sin, py * cos - px * sin
        bx, by = qx * cos + qy * sin, qy * cos - qx * sin
        see_segment(ranges, ax, ay, bx, by, origins, margin, fan)
    for k in range(len(ranges)):
        ranges[k] = min(max(ranges[k], 0.0), fan.reach)


@loop
def cast_rays(
    x: float,
    y: float,
    cos: float,
    sin: float,
    which: int,
    around: Surroundings,
    ranges: Floats,
) -> None:
    """Compute the ranges of all rays (rays,) [m] from a base at this pose; writes `ranges`.

    Rays that meet nothing within reach have the reach. From inside a circle all ranges are zero.
    """
    cast_lines(x, y, cos, sin, which, around, np.zeros((len(ranges), 2)), ranges)


def measure_ranges(
    place: tuple[float | Floats, float | Floats],
    bearings: Floats,
    world: World | None,
    moved: Floats | None = None,
) -> Floats:
    """Compute ranges (rays,) [m] at any bearings [rad] by NumPy; inf where nothing is met.

    `place` is x, y of all rays, or (rays,) each; `moved` is where the world's movers were when each
    ray was measured, (rays, movers, 2) [m], None for rays that don't meet them.
    """
    if world is None:
        return np.full(len(bearings), np.inf)
    cos, sin = np.cos(bearings)[:, None], np.sin(bearings)[:, None]
    from_x, from_y = (np.reshape(values, (-1, 1)) for values in place)
    circle_x, circle_y, radius = world.circles.T
    if moved is not None:
        circle_x, circle_y = (
            np.concatenate([np.broadcast_to(of, (len(bearings), len(of))), movers], axis=1)
            for of, movers in zip((circle_x, circle_y), np.moveaxis(moved, -1, 0), strict=True)
        )
        radius = np.concatenate([radius, [mover.radius for mover in world.movers]])
    x, y = circle_x - from_x, circle_y - from_y
    along = cos * x + sin * y
    inside = along * along - (x * x + y * y - radius * radius)
    near = np.where(inside >= 0.0, along - np.sqrt(np.abs(inside)), np.inf)
    ax, ay, bx, by = world.segments.T
    ax, ay, bx, by = ax - from_x, ay - from_y, bx - from_x, by - from_y
    ex, ey = bx - ax, by - ay
    with np.errstate(divide="ignore", invalid="ignore"):
        across = cos * ey - sin * ex
        far, share = (ax * ey - ay * ex) / across, (ax * sin - ay * cos) / across
        far = np.where((share >= 0.0) & (share <= 1.0), far, np.inf)
    hits = np.concatenate([near, far], axis=1)
    ranges: Floats = np.min(np.where(hits >= 0.0, hits, np.inf), axis=1, initial=np.inf)
    return ranges


@loop
def footprint_collides(
    x: float, y: float, cos: float, sin: float, which: int, around: Surroundings, kind: int = 0
) -> bool:
    """Whether the footprint of a kind's robot at this pose touches an obstacle of a set."""
    kinds = around.kinds
    half_x, half_y, is_box = kinds[kind, 5], kinds[kind, 6], kinds[kind, 7] == 0.0
    outer = math.sqrt(half_x * half_x + half_y * half_y)
    circles, segments = around.circles, around.segments
    for n in range(circles.shape[1]):
        dx, dy, radius = circles[which, n, 0] - x, circles[which, n, 1] - y, circles[which, n, 2]
        near = outer + radius
        if dx * dx + dy * dy <= near * near:
            ahead, left = dx * cos + dy * sin, dy * cos - dx * sin
            if circle_meets_box(ahead, left, radius, half_x, half_y) and (
                is_box or circle_meets_outline(ahead, left, radius, around, kind)
            ):
                return True
    for n in range(segments.shape[1]):
        ax, ay = segments[which, n, 0] - x, segments[which, n, 1] - y
        bx, by = segments[which, n, 2] - x, segments[which, n, 3] - y
        if min(ax, bx) <= outer and max(ax, bx) >= -outer and min(ay, by) <= outer:
            a_x, a_y = ax * cos + ay * sin, ay * cos - ax * sin
            b_x, b_y = bx * cos + by * sin, by * cos - bx * sin
            if segment_meets_box(a_x, a_y, b_x, b_y, half_x, half_y) and (
                is_box or segment_meets_outline(a_x, a_y, b_x, b_y, around, kind)
            ):
                return True
    return False


@subroutine
def footprint_gap(
    x: float, y: float, around: Surroundings, kind: int
) -> tuple[float, float, float]:
    """Distance of a point of the base frame from a kind's footprint, 0 inside, and where [m].

    Returns:
        The distance, and x and y of the place of the footprint that is nearest.
    """
    kinds = around.kinds
    if kinds[kind, 7] == 0.0:
        near_x = min(max(x, -kinds[kind, 5]), kinds[kind, 5])
        near_y = min(max(y, -kinds[kind, 6]), kinds[kind, 6])
        return math.sqrt((x - near_x) ** 2 + (y - near_y) ** 2), near_x, near_y
    sides = around.sides[kind, : int(kinds[kind, 7])]
    if is_inside(x, y, sides):
        return 0.0, x, y
    least, at_x, at_y = np.inf, x, y
    for n in range(len(sides)):
        ax, ay = sides[n, 0], sides[n, 1]
        ex, ey = sides[n, 2] - ax, sides[n, 3] - ay
        share = ((x - ax) * ex + (y - ay) * ey) / (ex * ex + ey * ey)
        share = min(max(share, 0.0), 1.0)
        near_x, near_y = ax + share * ex, ay + share * ey
        apart = math.sqrt((x - near_x) ** 2 + (y - near_y) ** 2)
        if apart < least:
            least, at_x, at_y = apart, near_x, near_y
    return least, at_x, at_y


@jit
def circle_meets_box(x: float, y: float, radius: float, half_x: float, half_y: float) -> bool:
    """Whether a circle at (x, y) overlaps the box of these half sizes around the origin."""
    dx = x - min(max(x, -half_x), half_x)
    dy = y - min(max(y, -half_y), half_y)
    return dx * dx + dy * dy <= radius * radius


@jit
def segment_meets_box(
    ax: float, ay: float, bx: float, by: float, half_x: float, half_y: float
) -> bool:
    """Whether a segment touches the box of these half sizes, by Liang and Barsky (1984)."""
    near, far = 0.0, 1.0
    for start, along, half in ((ax, bx - ax, half_x), (ay, by - ay, half_y)):
        if abs(along) < 1e-15:
            if abs(start) > half:
                return False
        else:
            enter, leave = (-half - start) / along, (half - start) / along
            near, far = max(near, min(enter, leave)), min(far, max(enter, leave))
    return near <= far


@subroutine
def circle_meets_outline(
    x: float, y: float, radius: float, around: Surroundings, kind: int
) -> bool:
    """Whether a circle at (x, y) overlaps the polygon that is a kind's footprint."""
    return circle_meets_polygon(x, y, radius, around.sides[kind, : int(around.kinds[kind, 7])])


@subroutine
def segment_meets_outline(
    ax: float, ay: float, bx: float, by: float, around: Surroundings, kind: int
) -> bool:
    """Whether a segment touches the polygon that is a kind's footprint."""
    return segment_meets_polygon(ax, ay, bx, by, around.sides[kind, : int(around.kinds[kind, 7])])


@loop
def is_inside(x: float, y: float, polygon: Floats) -> bool:
    """Whether a point lies within a polygon, (sides, 4)."""
    inside = False
    for n in range(len(polygon)):
        ax, ay, bx, by = polygon[n, 0], polygon[n, 1], polygon[n, 2], polygon[n, 3]
        if (ay > y) != (by > y) and x < ax + (bx - ax) * (y - ay) / (by - ay):
            inside = not inside
    return inside


@loop
def circle_meets_polygon(x: float, y: float, radius: float, polygon: Floats) -> bool:
    """Whether a circle at (x, y) overlaps a polygon, (sides, 4)."""
    for n in range(len(polygon)):
        ax, ay = polygon[n, 0], polygon[n, 1]
        ex, ey = polygon[n, 2] - ax, polygon[n, 3] - ay
        share = ((x - ax) * ex + (y - ay) * ey) / (ex * ex + ey * ey)
        share = min(max(share, 0.0), 1.0)
        dx, dy = x - ax - share * ex, y - ay - share * ey
        if dx * dx + dy * dy <= radius * radius:
            return True
    return is_inside(x, y, polygon)


@loop
def segment_meets_polygon(ax: float, ay: float, bx: float, by: float, polygon: Floats) -> bool:
    """Whether a segment from a to b touches a polygon, (sides, 4), or lies within it."""
    for n in range(len(polygon)):
        cx, cy, dx, dy = polygon[n, 0], polygon[n, 1], polygon[n, 2], polygon[n, 3]
        if max(ax, bx) < min(cx, dx) or max(cx, dx) < min(ax, bx):
            continue
        if max(ay, by) < min(cy, dy) or max(cy, dy) < min(ay, by):
            continue
        ex, ey, fx, fy = bx - ax, by - ay, dx - cx, dy - cy
        c_side, d_side = ex * (cy - ay) - ey * (cx - ax), ex * (dy - ay) - ey * (dx - ax)
        a_side, b_side = fx * (ay - cy) - fy * (ax - cx), fx * (by - cy) - fy * (bx - cx)
        if c_side * d_side <= 0.0 and a_side * b_side <= 0.0:
            return True
    return is_inside(ax, ay, polygon)


def point_clearance(points: ArrayLike, world: World) -> Floats:
    """Distances of points (N, 2) to the nearest obstacle (N,) [m].

    Negative inside a circle, zero on a segment, inf without obstacles.
    """
    places = _validate_points(points)
    centres, radii = world.circles.T[:2, None], world.circles[:, 2]
    starts, ends = world.segments.T[:2, None], world.segments.T[2:, None]

    def measure(rows: slice) -> tuple[Floats, Floats]:
        p = places[rows].T[..., None]
        return _lengths(p - centres) - radii, _distances_to_lines(p, starts, ends)

    return _least_distances(measure, len(places), world)


def segment_clearance(a: ArrayLike, b: ArrayLike, world: World) -> Floats:
    """Least distances (N,) of lines from a to b, (N, 2) each, to any obstacle [m].

    Minus the depth where a line enters a circle, zero where it meets a segment, inf without
    obstacles.
    """
    starts, ends = _validate_points(a), _validate_points(b)
    if len(starts) != len(ends):
        raise ValueError(f"{len(starts)} starts and {len(ends)} ends of pieces")
    least = np.full(len(starts), np.inf)
    _clear_segments(starts, ends, world.circles, world.segments, least)
    return least


@loop
def _clear_segments(
    starts: Floats, ends: Floats, circles: Floats, segments: Floats, least: Floats
) -> None:
    """Lower `least` to the distances of lines to obstacles."""
    for n in range(len(starts)):
        ax, ay, bx, by = starts[n, 0], starts[n, 1], ends[n, 0], ends[n, 1]
        for k in range(len(circles)):
            x, y, radius = circles[k]
            least[n] = min(least[n], distance_to_line(x, y, ax, ay, bx, by) - radius)
        for k in range(len(segments)):
            cx, cy, dx, dy = segments[k]
            a_side, b_side = (
                side_of_line(cx, cy, dx, dy, ax, ay),
                side_of_line(cx, cy, dx, dy, bx, by),
            )
            c_side, d_side = (
                side_of_line(ax, ay, bx, by, cx, cy),
                side_of_line(ax, ay, bx, by, dx, dy),
            )
            if a_side * b_side < 0.0 and c_side * d_side < 0.0:
                least[n] = min(least[n], 0.0)
                continue
            # Two segments that don't cross are nearest at one of their four ends.
            of_ends = min(
                distance_to_line(ax, ay, cx, cy, dx, dy), distance_to_line(bx, by, cx, cy, dx, dy)
            )
            of_theirs = min(
                distance_to_line(cx, cy, ax, ay, bx, by), distance_to_line(dx, dy, ax, ay, bx, by)
            )
            least[n] = min(least[n], of_ends, of_theirs)


@jit
def distance_to_line(x: float, y: float, ax: float, ay: float, bx: float, by: float) -> float:
    """Distance of the point (x, y) to the straight line from a to b [m]."""
    ex, ey, ox, oy = bx - ax, by - ay, x - ax, y - ay
    square = ex * ex + ey * ey
    share = min(max((ox * ex + oy * ey) / (square if square > 0.0 else 1.0), 0.0), 1.0)
    if share < 1.0:
        ox, oy = ox - share * ex, oy - share * ey
    else:
        ox, oy = x - bx, y - by
    return math.sqrt(ox * ox + oy * oy)


@jit
def side_of_line(ax: float, ay: float, bx: float, by: float, x: float, y: float) -> float:
    """Side of the line from a to b on which a point is: 1 left, -1 right, 0 on it."""
    product = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
    return 1.0 if product > 0.0 else -1.0 if product < 0.0 else 0.0


def _validate_points(points: ArrayLike) -> Floats:
    array = np.asarray(points, np.float64)
    if array.size == 0:
        return np.zeros((0, 2))
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"points must be of shape (N, 2), not {array.shape}")
    return array


def _least_distances(
    measure: Callable[[slice], tuple[Floats, Floats]], count: int, world: World
) -> Floats:
    """The least distance of each of so many rows to circles and segments, measured in chunks."""
    rows = max(1, CLEARANCE_CHUNK // max(1, world.obstacles))
    least = np.full(count, np.inf)
    for first in range(0, count if world.obstacles else 0, rows):
        chunk = slice(first, first + rows)
        least[chunk] = np.concatenate(measure(chunk), axis=1).min(axis=1)
    return least


# In the functions below the first axis of a vector is x and y: NumPy is twice as fast that way.


def _distances_to_lines(points: Floats, starts: Floats, ends: Floats) -> Floats:
    """Distance of points (2, ...) to the lines from `starts` to `ends` (2, ...)."""
    along, offset = ends - starts, points - starts
    square = _dot(along, along)
    share = np.clip(_dot(offset, along) / np.where(square > 0.0, square, 1.0), 0.0, 1.0)
    return np.where(share < 1.0, _lengths(offset - share * along), _lengths(points - ends))


def _dot(first: Floats, second: Floats) -> Floats:
    product: Floats = first[0] * second[0] + first[1] * second[1]
    return product


def _lengths(vectors: Floats) -> Floats:
    lengths: Floats = np.sqrt(_dot(vectors, vectors))
    return lengths
