"""Obstacles around a robot, and the ranges of rays to them; `collisions` has contacts.

Scalar functions and loops over obstacles, compiled where numba is installed. They work in the frame
of the robot or the sensor: x ahead, y to the left, lengths in m, angles in rad. Obstacles out of
reach are skipped early, and only rays that can meet an obstacle are computed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig, footprint
from acsar_gym.errors import ConfigError
from acsar_gym.jit import jit, loop
from acsar_gym.worlds.world import World

Floats = NDArray[np.float64]
TURN = 2.0 * math.pi
EDGE = 1e-9
"""Tolerance at both ends of the range of rays that can meet an obstacle [rad]."""


@dataclass(frozen=True)
class Obstacles:
    """Circles (x, y, radius) and segments (x1, y1, x2, y2) in the frame of the world [m].

    Either one set for all robots, of shapes (C, 3) and (S, 4), or one for each robot, of shapes
    (robots, C, 3) and (robots, S, 4). Unused rows may be circles of radius zero far away.
    """

    circles: Floats | Sequence[Any] = ()
    segments: Floats | Sequence[Any] = ()

    def arrays(self, robots: int) -> tuple[Floats, Floats]:
        """Circles (W, C, 3) and segments (W, S, 4), W being 1 or `robots`.

        ConfigError for other shapes.
        """
        circles = _stacked("circles", self.circles, 3, robots)
        segments = _stacked("segments", self.segments, 4, robots)
        if (circles[:, :, 2] < 0.0).any():
            raise ConfigError("obstacles: the radius of a circle must not be negative")
        sets = max(len(circles), len(segments))
        return _repeated(circles, sets), _repeated(segments, sets)


@dataclass(frozen=True, slots=True)
class RaySpec:
    """The rays of a planar LiDAR, counter-clockwise, the first one at -field_of_view / 2."""

    rays: int
    reach: float = 5.0
    """Longest range, which also scales the observation [m]."""
    field_of_view: float = 2.0 * math.pi
    """Angle that the rays cover [rad]; in a full turn the last ray isn't the first one again."""

    def __post_init__(self) -> None:
        if not (1 <= self.rays <= 10_000 and 0.0 < self.reach < math.inf):
            raise ConfigError(f"{self}: must have 1 to 10,000 rays and a positive reach [m]")
        if not 0.0 < self.field_of_view <= 2.0 * math.pi + 1e-9:
            raise ConfigError(f"{self}: field_of_view must be within (0, 2 pi] rad")

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
    """Obstacles, rays and footprint as compiled loops need them."""

    circles: Floats
    """(sets, circles, 3): x, y, radius [m]."""
    segments: Floats
    """(sets, segments, 4): x1, y1, x2, y2 [m]."""
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
    half_length: float
    """Half the length of a box around the origin of the base frame that contains the footprint
    [m]."""
    half_width: float
    """Half the width of that box [m]."""
    sides: Floats
    """(sides, 4): x1, y1, x2, y2 of a polygonal footprint; none where the footprint is the box
    [m]."""


def surroundings(
    obstacles: Obstacles, spec: RaySpec | None, robots: int, config: RobotConfig
) -> Surroundings:
    """Make the arrays around a batch of robots.

    `spec` are the rays of the LiDAR, None without one. Raises ConfigError for obstacles of a wrong
    shape, or that aren't finite numbers.
    """
    circles, segments = obstacles.arrays(robots)
    angles = spec.angles() if spec else np.zeros(0)
    return Surroundings(
        circles,
        segments,
        np.stack([np.cos(angles), np.sin(angles)], axis=1),
        float(angles[0]) if spec else 0.0,
        spec.step if spec else 1.0,
        spec.reach if spec else 1.0,
        config.lidar_x_offset,
        config.lidar_y_offset,
        max(abs(x) for x, _ in config.outline),
        max(abs(y) for _, y in config.outline),
        _sides(config),
    )


def _sides(config: RobotConfig) -> Floats:
    """(sides, 4): the sides of a polygonal footprint; none where the footprint is a box."""
    if config.footprint is None:
        return np.zeros((0, 4))
    return np.array([(*a, *b) for a, b in footprint.sides(config.footprint)])


def _repeated(array: Floats, sets: int) -> Floats:
    """Repeat one set of obstacles for all sets."""
    return np.ascontiguousarray(np.broadcast_to(array, (sets, *array.shape[1:])))


def _stacked(name: str, rows: Floats | Sequence[Any], width: int, robots: int) -> Floats:
    """Check rows and convert them to (sets, rows, width)."""
    try:
        array = np.array(rows, np.float64)
    except (TypeError, ValueError):
        array = np.full(1, np.nan)
    if array.size == 0:
        return np.zeros((1, 0, width))
    array = array[None] if array.ndim == 2 else array
    if array.ndim != 3 or array.shape[2] != width or array.shape[0] not in (1, robots):
        raise ConfigError(
            f"obstacles: {name} must be of shape (n, {width}) or ({robots}, n, {width})"
        )
    if not np.isfinite(array).all():
        raise ConfigError(f"obstacles: {name} must be finite numbers")
    return np.ascontiguousarray(array)


@jit
def shorten_by_circle(
    ranges: Floats, x: float, y: float, radius: float, low: int, high: int, directions: Floats
) -> None:
    """Shorten the rays low to high that meet the circle at (x, y) in the sensor's frame."""
    square = x * x + y * y - radius * radius
    for k in range(low, high + 1):
        along = x * directions[k, 0] + y * directions[k, 1]
        inside = along * along - square
        if inside >= 0.0 and along > 0.0:
            ranges[k] = min(ranges[k], along - math.sqrt(inside))


@jit
def shorten_by_segment(
    ranges: Floats,
    ax: float,
    ay: float,
    bx: float,
    by: float,
    low: int,
    high: int,
    directions: Floats,
) -> None:
    """Shorten the rays low to high that meet the segment from a to b in the sensor's frame."""
    ex, ey = bx - ax, by - ay
    cross = ax * ey - ay * ex
    for k in range(low, high + 1):
        across = directions[k, 0] * ey - directions[k, 1] * ex
        if abs(across) > 1e-12:
            distance = cross / across
            if distance >= 0.0:
                ranges[k] = min(ranges[k], distance)


@jit
def see_circle(
    ranges: Floats, x: float, y: float, radius: float, square: float, around: Surroundings
) -> None:
    """Shorten the rays that meet a circle at (x, y) in the sensor's frame, `square` [m^2] away."""
    middle, half = math.atan2(y, x), math.asin(radius / math.sqrt(square)) + EDGE
    last = len(ranges) - 1
    for shift in (-TURN, 0.0, TURN):
        low = max(math.ceil((middle - half + shift - around.start) / around.step), 0)
        high = min(math.floor((middle + half + shift - around.start) / around.step), last)
        shorten_by_circle(ranges, x, y, radius, low, high, around.directions)


@jit
def see_segment(
    ranges: Floats, ax: float, ay: float, bx: float, by: float, around: Surroundings
) -> None:
    """Shorten the rays that meet a segment from a to b in the sensor's frame."""
    one, width = math.atan2(ay, ax), math.atan2(ax * by - ay * bx, ax * bx + ay * by)
    first, last = min(one, one + width) - EDGE, len(ranges) - 1
    for shift in (-TURN, 0.0, TURN):
        low = max(math.ceil((first + shift - around.start) / around.step), 0)
        top = first + abs(width) + 2.0 * EDGE
        high = min(math.floor((top + shift - around.start) / around.step), last)
        shorten_by_segment(ranges, ax, ay, bx, by, low, high, around.directions)


@loop
def cast(
    x: float,
    y: float,
    cos: float,
    sin: float,
    which: int,
    around: Surroundings,
    ranges: Floats,
) -> None:
    """Compute the ranges of all rays (rays,) [m] from a base at this pose; writes `ranges`.

    `which` is the index of the set of obstacles. Rays that meet nothing within reach have the
    reach. From inside a circle all ranges are zero.
    """
    x += cos * around.mount_x - sin * around.mount_y
    y += sin * around.mount_x + cos * around.mount_y
    circles, segments = around.circles, around.segments
    ranges[:] = around.reach
    for n in range(circles.shape[1]):
        dx, dy, radius = circles[which, n, 0] - x, circles[which, n, 1] - y, circles[which, n, 2]
        square, far = dx * dx + dy * dy, around.reach + radius
        if square > far * far:
            continue
        if square <= radius * radius:
            ranges[:] = 0.0
            return
        see_circle(ranges, dx * cos + dy * sin, dy * cos - dx * sin, radius, square, around)
    for n in range(segments.shape[1]):
        px, py = segments[which, n, 0] - x, segments[which, n, 1] - y
        qx, qy = segments[which, n, 2] - x, segments[which, n, 3] - y
        ax, ay = px * cos + py * sin, py * cos - px * sin
        bx, by = qx * cos + qy * sin, qy * cos - qx * sin
        see_segment(ranges, ax, ay, bx, by, around)
    for k in range(len(ranges)):
        ranges[k] = min(max(ranges[k], 0.0), around.reach)


def look(place: tuple[float, float], bearings: Floats, world: World | None) -> Floats:
    """Compute ranges at any bearings, in plain NumPy; `cast` is faster for evenly spaced rays.

    Args:
        place: x, y in the frame of the world [m].
        bearings: (rays,) in the frame of the world [rad].
        world: with the obstacles, or None.

    Returns:
        (rays,) [m]; inf where there is no obstacle.
    """
    ranges: Floats = np.full(len(bearings), np.inf)
    if world is None:
        return ranges
    cos, sin = np.cos(bearings)[:, None], np.sin(bearings)[:, None]
    x, y, radius = (world.circles - (*place, 0.0)).T
    along = cos * x + sin * y
    inside = along * along - (x * x + y * y - radius * radius)
    near = np.where(inside >= 0.0, along - np.sqrt(np.abs(inside)), np.inf)
    ax, ay, bx, by = (world.segments - (*place, *place)).T
    ex, ey = bx - ax, by - ay
    with np.errstate(divide="ignore", invalid="ignore"):
        across = cos * ey - sin * ex
        far, share = (ax * ey - ay * ex) / across, (ax * sin - ay * cos) / across
        far = np.where((share >= 0.0) & (share <= 1.0), far, np.inf)
    hits = np.concatenate([near, far], axis=1)
    ranges[:] = np.min(np.where(hits >= 0.0, hits, np.inf), axis=1, initial=np.inf)
    return ranges
