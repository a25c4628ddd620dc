"""A world: circles and segments around a robot, start and goal. The scene that a link builds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config.physics import Physics
from acsar_gym.errors import WorldError, show_value
from acsar_gym.worlds.movers import Mover, check_movers

Floats = NDArray[np.float64]
Rng = np.random.Generator
Pose = tuple[float, float, float]  # x [m], y [m], theta [rad]
MAX_OBSTACLES = 20_000  # a world with more circles and segments than this is refused
MAX_COORDINATE = 1e4  # coordinates beyond this are refused [m]
X, Y, RADIUS = range(3)
"""Columns of circles [m]."""
AX, AY, BX, BY = range(4)
"""Columns of segments from a to b [m]."""


@dataclass(frozen=True, slots=True)
class Region:
    """A disc in which a start or a goal is drawn, or a point if its radius is zero.

    Raises:
        WorldError: A value isn't a number, is too large, or the radius is negative.
    """

    x: float
    """Centre [m]."""
    y: float
    """Centre [m]."""
    radius: float = 0.0
    """Radius of the disc [m]."""
    theta: float | None = None
    """Heading of a start [rad]. None is any. A goal has none."""

    def __post_init__(self) -> None:
        # Region is made of what users write, so anything may come.
        numbers = (self.x, self.y, self.radius, 0.0 if self.theta is None else self.theta)
        try:
            sound = all(
                isinstance(number, SupportsFloat) and abs(float(number)) <= MAX_COORDINATE
                for number in numbers
            )
        except (TypeError, ValueError, OverflowError):
            sound = False
        if not sound or self.radius < 0.0:
            raise WorldError(
                f"region {show_value(numbers)}: x, y, radius [m] and theta [rad] must be numbers "
                f"of at most {MAX_COORDINATE:g}, the radius not negative"
            )


@dataclass(frozen=True, eq=False)
class World:
    """Obstacles, start and goal in the frame of the world (x, y [m], theta [rad]). Immutable.

    Raises:
        WorldError: A shape is wrong, a number NaN, a radius negative, or there are more than 20,000
            obstacles.

    Example:
        >>> world = World(circles=[[2.0, 0.0, 0.5]], goal=Region(4.0, 0.0))
        >>> world.obstacles, world.bounds
        (1, (0.0, -0.5, 4.0, 0.5))
    """

    circles: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(circles, 3): x, y, radius [m]."""
    segments: Floats = field(default_factory=lambda: np.zeros((0, 4)))
    """(segments, 4): x1, y1, x2, y2 [m]."""
    start: Region = Region(0.0, 0.0, 0.0, 0.0)
    """Where robots start."""
    goal: Region = Region(1.0, 0.0)
    """Where goals are drawn."""
    path: Floats | None = None
    """(points, 2): a path from the start to the goal [m]: the shortest one for the footprint
    that the world was made for, the published one, or the one to follow."""
    name: str = ""
    """For pictures and reports."""
    movers: Sequence[Mover] = ()
    """Movers, see `movers`. Their times are those since the start of an episode."""

    def __post_init__(self) -> None:
        for name, width in (("circles", 3), ("segments", 4), ("path", 2)):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _validate_rows(name, getattr(self, name), width))
        if (self.circles[:, RADIUS] < 0.0).any():
            raise WorldError("circles: a radius must not be negative")
        if self.obstacles > MAX_OBSTACLES:
            raise WorldError(
                f"{self.obstacles:,} obstacles are too many, at most {MAX_OBSTACLES:,}"
            )
        object.__setattr__(self, "movers", tuple(self.movers))
        check_movers(self.movers)

    @property
    def obstacles(self) -> int:
        """Number of circles and segments."""
        return len(self.circles) + len(self.segments)

    @cached_property
    def length(self) -> float:
        """Length of `path` [m], or NaN without a path."""
        if self.path is None:
            return math.nan
        return float(np.hypot(*np.diff(self.path, axis=0).T).sum())

    @cached_property
    def bounds(self) -> tuple[float, float, float, float]:
        """Least x and y, largest x and y of everything, the ways of movers included [m].

        People who react may leave their motions, and so these bounds.
        """
        # Boxes are pairs of corners, which `_bound` takes as points.
        boxes = np.array([self.standing_bounds, *(mover.bounds for mover in self.movers)])
        return _bound(boxes.reshape(-1, 2))

    @cached_property
    def standing_bounds(self) -> tuple[float, float, float, float]:
        """Least x and y, largest x and y of obstacles, start, goal and path [m]."""
        ends = [[end.x, end.y, end.radius] for end in (self.start, self.goal)]
        discs = np.concatenate([self.circles, ends])
        centres = discs[:, [X, Y]]
        radii = discs[:, [RADIUS]]
        path = np.zeros((0, 2)) if self.path is None else self.path
        points = [centres - radii, centres + radii, self.segments.reshape(-1, 2), path]
        return _bound(np.concatenate(points))


def _bound(points: Floats) -> tuple[float, float, float, float]:
    """Least x and y, largest x and y of points (n, 2)."""
    min_x, min_y = points.min(axis=0).tolist()
    max_x, max_y = points.max(axis=0).tolist()
    return min_x, min_y, max_x, max_y


def _validate_rows(name: str, rows: Floats | Sequence[Any], width: int) -> Floats:
    """A read-only copy of (n, width) finite numbers. Raises WorldError for anything else."""
    try:
        array = np.full(1, np.nan) if np.iscomplexobj(rows) else np.array(rows, np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.full(1, np.nan)

    # An empty list has no width of its own.
    if array.size == 0:
        array = np.zeros((0, width))
    if array.ndim != 2 or array.shape[1] != width:
        raise WorldError(f"{name}: must be rows of {width} numbers, have shape {array.shape}")

    if len(array) > MAX_OBSTACLES:
        raise WorldError(f"{name}: {len(array):,} are too many, at most {MAX_OBSTACLES:,}")
    if not (np.abs(array) <= MAX_COORDINATE).all():
        raise WorldError(f"{name}: must be finite numbers of at most {MAX_COORDINATE:g} m")
    array.setflags(write=False)
    return array


def make_box(x: float, y: float, length: float, width: float, theta: float = 0.0) -> Floats:
    """Sides of a box around (x, y), (4, 4), rotated by theta [rad]. Lengths in m."""
    cos = math.cos(theta)
    sin = math.sin(theta)
    half = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (length / 2.0, width / 2.0)
    corners = half @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
    return np.column_stack([corners, np.roll(corners, -1, axis=0)])


def make_rectangle(left: float, low: float, right: float, high: float) -> Floats:
    """Sides of a rectangle along the axes, (4, 4) [m]."""
    return make_box((left + right) / 2.0, (low + high) / 2.0, right - left, high - low)


def make_wall(start: tuple[float, float], end: tuple[float, float], doors: Floats) -> Floats:
    """Make a straight wall with gaps, (segments, 4) [m].

    Args:
        start: First end of the wall [m].
        end: Second end of the wall [m].
        doors: (gaps, 2): where each gap starts and ends, as distances from `start` [m], sorted.
    """
    length = math.dist(start, end)

    # The wall is what remains between the ends of doors: pairs of numbers along it.
    edges = np.clip(np.concatenate([[0.0], np.ravel(doors), [length]]), 0.0, length)
    pieces = edges.reshape(-1, 2)
    pieces = pieces[pieces[:, 1] > pieces[:, 0]]
    # Back from distances along the wall to places.
    along = (np.array(end) - start) / length
    ends: Floats = (np.array(start) + pieces.reshape(-1, 1) * along).reshape(-1, 4)
    return ends


@dataclass(frozen=True, slots=True)
class Scene:
    """A robot at rest at `start`, a world around it, and a goal, which only pictures show.

    Everything is in the frame of the world, as is a simulator's ground truth. The origin of the
    odometry frame is `start`.
    """

    start: Pose = (0.0, 0.0, 0.0)
    """x [m], y [m], theta [rad]."""
    goal: tuple[float, float] | None = None
    """x, y [m], or None without a goal."""
    world: World | None = None
    """Obstacles, or None on an open floor."""
    physics: Physics | None = None
    """The simulated robot's physics in this episode, or None for the configured physics."""
    key: float = 0.0
    """The episode's draw, 0 to 1, on which its movers' phases and people's traits depend."""


def to_world(start: Pose, pose: Pose) -> Pose:
    """Transform a pose from the odometry frame whose origin is `start` into the world's frame."""
    x, y = point_in_world(start, pose[:2])
    return x, y, math.remainder(start[2] + pose[2], math.tau)


def to_odometry(start: Pose, pose: Pose) -> Pose:
    """Transform a pose from the world's frame into the odometry frame whose origin is `start`."""
    x, y, theta = start
    dx = pose[0] - x
    dy = pose[1] - y
    cos = math.cos(theta)
    sin = math.sin(theta)
    return cos * dx + sin * dy, cos * dy - sin * dx, math.remainder(pose[2] - theta, math.tau)


def point_in_world(start: Pose, point: tuple[float, float]) -> tuple[float, float]:
    """Transform a point [m] from the odometry frame whose origin is `start` to the world's."""
    x, y, theta = start
    cos = math.cos(theta)
    sin = math.sin(theta)
    return x + cos * point[0] - sin * point[1], y + sin * point[0] + cos * point[1]
