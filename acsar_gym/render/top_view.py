"""Top views: the robot in its world, with paths and scan. Needs Pillow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.config.footprint import border_distance
from acsar_gym.errors import ConfigError
from acsar_gym.render.canvas import (
    LABEL_COLOUR,
    Bounds,
    Canvas,
    Colour,
    Floats,
    Up,
    View,
    check_picture_size,
    encode_png,
    round_length,
)
from acsar_gym.worlds import Mover, Pose, Region, World

RgbImage = NDArray[np.uint8]
"""Shape (height, width, 3), RGB."""
Point = tuple[float, float]
"""Position (x, y) [m]."""

FLOOR_COLOUR: Colour = (251, 251, 249)
GRID_COLOUR: Colour = (231, 233, 236)
UNSEEN_COLOURS, SEEN_COLOURS = (FLOOR_COLOUR, GRID_COLOUR), ((249, 238, 237), (232, 220, 223))
"""Colours of floor and grid outside and inside the area that the LiDAR sees."""
OBSTACLE_COLOUR: Colour = (58, 64, 77)
PLAN_COLOUR: Colour = (120, 128, 142)
GOAL_COLOUR: Colour = (38, 173, 97)
START_COLOUR: Colour = (30, 110, 220)
ODOM_COLOUR: Colour = (30, 110, 220)
TRUTH_COLOUR: Colour = (245, 137, 32)
RAY_COLOUR: Colour = (216, 60, 80)
HIT_COLOUR: Colour = (214, 20, 30)
CHASSIS_COLOUR: Colour = (41, 89, 148)
DECK_COLOUR: Colour = (217, 224, 233)
TYRE_COLOUR: Colour = (30, 31, 34)
MOVER_COLOUR: Colour = (142, 68, 173)
WORLD_MARGIN = 0.35
"""Width of the floor shown around a world [m]."""
OPEN_MARGIN = 1.0
"""Width of the floor shown around start and goal if there is no world [m]."""
PICTURE_INSET = 10.0
"""Smallest distance of world and robot from the edges of the picture [pixels]."""
SMALL_ROBOT = 10.0
"""Robots shorter than this get a ring, to be visible [pixels]."""
VELOCITY_TIME = 0.6
"""The line of a mover's velocity ends where it will be in this time [s]."""
WAY_POINTS = 9
"""Points of each piece of a mover's way."""
MAX_PATH_POINTS = 1000
"""Paths with more points are thinned out."""


@dataclass(frozen=True, eq=False, slots=True)
class TopViewFrame:
    """Content of one picture, in the frame of the world, or else in the odometry frame."""

    world: World | None = None
    odom: Pose = (0.0, 0.0, 0.0)
    """Pose by odometry."""
    truth: Pose | None = None
    """True pose; None on hardware."""
    goal: Point | None = None
    goal_radius: float = 0.15
    """Radius of the goal [m]."""
    odom_path: Sequence[Point] = ()
    true_path: Sequence[Point] = ()
    rays: tuple[Floats, Floats] | None = None
    """Scan of the LiDAR: evenly increasing angles in the base frame (N,) [rad], ranges (N,) [m]."""
    reach: float = math.inf
    """Range of a ray that hits nothing [m]."""
    movers: Floats | None = None
    """What moves: x, y [m], their rates [m/s], and radius [m] of each, (movers, 5)."""
    caption: str = ""
    hit: Point | None = None
    """Where the robot collided."""


class TopView:
    """Draws top views of one robot; the view is kept as long as world and goal are.

    It is fitted to world and goal; without a world it is a square around origin and goal. It grows
    when the robot leaves it.
    """

    def __init__(
        self, config: RobotConfig, size: tuple[int, int] = (480, 480), up: Up | None = None
    ) -> None:
        check_picture_size("size", size)
        self.layers = 0
        """How often the static part was drawn."""
        self._config = config
        self._up = up
        self._parts = robot_parts(config)
        self._footprint = self._parts[0][0]
        self._goal: Point | None = None
        self._bounds = episode_bounds(None, None)
        self._draw_layers(None, View.fitted(self._bounds, size, up or "x", PICTURE_INSET))

    @property
    def view(self) -> View:
        """View of the newest picture."""
        return self._dark.view

    def draw(self, frame: TopViewFrame) -> RgbImage:
        """Draw a picture, shape (height, width, 3)."""
        self._fit_view(frame)
        canvas = Canvas(self.view, self._dark.layer)
        pose = frame.truth or frame.odom
        if frame.rays is not None:
            self._draw_scan(canvas, pose, *frame.rays, frame.reach)
        if frame.movers is not None:
            draw_movers(canvas, frame.movers)
        if frame.goal is not None:
            draw_goal(canvas, frame.goal, frame.goal_radius)
        canvas.line(thin_path(frame.true_path), TRUTH_COLOUR, 3.5)
        canvas.line(thin_path(frame.odom_path), ODOM_COLOUR, 1.5)
        self._draw_ring(canvas, pose, CHASSIS_COLOUR)
        for corners, colour in self._parts:
            canvas.shape(place_points(corners, pose), colour)
        if frame.truth is not None:
            self._draw_odometry(canvas, frame.truth, frame.odom)
        if frame.hit is not None:
            canvas.disc(frame.hit, 0.0, (*HIT_COLOUR, 90), HIT_COLOUR, width=2.5, least=9.0)
            canvas.disc(frame.hit, 0.0, HIT_COLOUR, least=2.5)
        if frame.caption:
            canvas.text((12.0, 20.0), frame.caption, box=LABEL_COLOUR)
        return canvas.picture()

    def _fit_view(self, frame: TopViewFrame) -> None:
        """Fit the view to a new world or goal, and extend it when the robot leaves it.

        In a world it still fits while the goal is visible.
        """
        view, bounds, goal = self.view, self._bounds, frame.goal
        goal_fits = goal == self._goal or (
            frame.world is not None and (goal is None or view.shows(*goal, PICTURE_INSET))
        )
        if frame.world is not self._world or not goal_fits:
            bounds = episode_bounds(frame.world, goal)
            up = self._up or ("x" if frame.world is None else "y")
            view = View.fitted(bounds, view.size, up, PICTURE_INSET)
        for x, y, _ in (frame.odom, frame.truth or frame.odom):
            if math.isfinite(x + y) and not view.shows(x, y, PICTURE_INSET):
                room = 0.25 * max(bounds[2] - bounds[0], bounds[3] - bounds[1])  # to grow further
                bounds = _join_bounds(bounds, widen_bounds((x, y, x, y), room))
                view = View.fitted(bounds, view.size, view.up, PICTURE_INSET)
        self._goal, self._bounds = goal, bounds
        if frame.world is not self._world or view != self.view:
            self._draw_layers(frame.world, view)

    def _draw_layers(self, world: World | None, view: View) -> None:
        """Draw the static part twice: outside and inside the area that the LiDAR sees."""
        self.layers += 1
        self._world = world
        self._dark, self._lit = (
            draw_world(world, view, *floor) for floor in (UNSEEN_COLOURS, SEEN_COLOURS)
        )
        for canvas in (self._dark, self._lit):
            canvas.scale_bar(view.size[1] - PICTURE_INSET, 0.25, PICTURE_INSET)

    def _draw_scan(
        self, canvas: Canvas, pose: Pose, angles: Floats, ranges: Floats, reach: float
    ) -> None:
        """Draw the area that the LiDAR sees, with a dot at every hit."""
        offset = np.array([[self._config.lidar_x_offset, self._config.lidar_y_offset]])
        sensor = place_points(offset, pose)
        ends = sensor + _polar_points(angles + pose[2], np.minimum(ranges, reach))
        turn = float(angles[-1] - angles[0]) if len(angles) > 2 else 0.0
        around = turn > 0.0 and math.tau - turn < 1.5 * turn / (len(angles) - 1)
        canvas.reveal(self._lit.layer, ends if around else np.concatenate([sensor, ends]))
        canvas.rays(sensor, ends, (*RAY_COLOUR, 60))
        canvas.dots(ends[ranges < reach - 1e-9], 1.75, RAY_COLOUR)

    def _draw_odometry(self, canvas: Canvas, truth: Pose, odom: Pose) -> None:
        """Draw the robot's outline at its odometry pose, if that differs by a pixel or more."""
        corners = place_points(self._footprint, odom)
        apart = np.hypot(*(corners - place_points(self._footprint, truth)).T).max()
        if apart * canvas.view.scale >= 1.0:
            self._draw_ring(canvas, odom, ODOM_COLOUR)
            canvas.shape(corners, (*ODOM_COLOUR, 30), ODOM_COLOUR, 1.5)
            nose = np.array([[0.0, 0.0], [max(self._footprint[:, 0]), 0.0]])
            canvas.line(place_points(nose, odom), ODOM_COLOUR, 1.5)

    def _draw_ring(self, canvas: Canvas, pose: Pose, colour: Colour) -> None:
        """Draw a ring around a robot that is too small to be seen."""
        if canvas.view.scale * self._config.body.length < SMALL_ROBOT:
            canvas.disc(pose[:2], 0.0, (*colour, 40), colour, width=1.5, least=SMALL_ROBOT)


def draw_world(world: World | None, view: View, floor: Colour, grid: Colour) -> Canvas:
    """Draw the floor with its grid, and the world's path and obstacles."""
    canvas = Canvas(view, floor)
    left, low, right, high = view.bounds
    step = max(1.0, round_length(30.0 / view.scale))
    for x in np.arange(math.ceil(left / step), math.floor(right / step) + 1) * step:
        canvas.line(np.array([[x, low], [x, high]]), grid, 1.0)
    for y in np.arange(math.ceil(low / step), math.floor(high / step) + 1) * step:
        canvas.line(np.array([[left, y], [right, y]]), grid, 1.0)
    if world is None:
        return canvas
    if world.path is not None:
        canvas.dashes(world.path, PLAN_COLOUR, 1.0, 5.0)
    for x, y, radius in world.circles.tolist():
        canvas.disc((x, y), radius, OBSTACLE_COLOUR, least=1.0)
    for ends in world.segments.reshape(-1, 2, 2):
        canvas.line(ends, OBSTACLE_COLOUR, 2.5)
        canvas.dots(ends, 1.25, OBSTACLE_COLOUR)
    return canvas


def draw_movers(canvas: Canvas, movers: Floats) -> None:
    """Draw movers (movers, 5) as discs, with a line to where each will be in VELOCITY_TIME."""
    for x, y, vx, vy, radius in movers.tolist():
        canvas.disc((x, y), radius, (*MOVER_COLOUR, 120), MOVER_COLOUR, width=1.5, least=2.0)
        ahead = x + VELOCITY_TIME * vx, y + VELOCITY_TIME * vy
        canvas.line(np.array([(x, y), ahead]), MOVER_COLOUR, 2.0)


def draw_motions(canvas: Canvas, world: World) -> None:
    """Draw a world's movers where an episode begins, and thin lines where they go."""
    for mover in world.movers:
        canvas.line(trace_way(mover), (*MOVER_COLOUR, 130), 1.0)
    begins = [(*mover.position(0.0), *mover.velocity(0.0), mover.radius) for mover in world.movers]
    draw_movers(canvas, np.array(begins).reshape(-1, 5))


def trace_way(mover: Mover) -> Floats:
    """Return points (N, 2) of where a motion leads [m]."""
    pieces = mover.pieces
    lengths = np.diff(np.append(pieces[:, 0], mover.duration))
    times = (lengths[:, None] * np.linspace(0.0, 1.0, WAY_POINTS))[:, :, None] ** np.arange(4)
    axes = [(times @ pieces[:, first : first + 4, None])[:, :, 0] for first in (1, 5)]
    return np.stack(axes, axis=2).reshape(-1, 2)


def draw_goal(canvas: Canvas, place: Point, radius: float) -> None:
    """Draw a goal of `radius` [m], large enough to be visible."""
    canvas.disc(place, radius, (*GOAL_COLOUR, 70), GOAL_COLOUR, width=1.5, least=4.0)
    canvas.disc(place, 0.0, GOAL_COLOUR, least=2.5)


def draw_start(canvas: Canvas, start: Region) -> None:
    """Draw a start: a disc, and an arrow if its heading is known."""
    place = (start.x, start.y)
    if start.radius > 0.0:
        canvas.disc(place, start.radius, (*START_COLOUR, 50), START_COLOUR)
    canvas.disc(place, 0.0, START_COLOUR, least=3.5)
    if start.theta is not None:
        ahead = np.array([math.cos(start.theta), math.sin(start.theta)]) / canvas.view.scale
        left = np.array([-ahead[1], ahead[0]])
        tip = place + np.array([18.0 * ahead, 11.0 * ahead + 4.5 * left, 11.0 * ahead - 4.5 * left])
        canvas.line(np.array([place, place + 13.0 * ahead]), START_COLOUR, 2.0)
        canvas.shape(tip, START_COLOUR)


def episode_bounds(world: World | None, goal: Point | None) -> Bounds:
    """Return the area to show in an episode [m].

    It contains world and goal, or, without a world, origin and goal.
    """
    if world is not None:
        bounds = _join_bounds(world.bounds, (*goal, *goal)) if goal else world.bounds
        return widen_bounds(bounds, WORLD_MARGIN)
    points = np.array([(0.0, 0.0), goal or (0.0, 0.0)])
    (left, low), (right, high) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    longest = max(right - left, high - low)
    x, y, side = (left + right) / 2.0, (low + high) / 2.0, max(OPEN_MARGIN, 0.25 * longest)
    return widen_bounds((x, y, x, y), longest / 2.0 + side)


def widen_bounds(bounds: Bounds, margin: float) -> Bounds:
    """Return bounds with a margin added on every side [m]."""
    left, low, right, high = bounds
    return left - margin, low - margin, right + margin, high + margin


def _join_bounds(one: Bounds, other: Bounds) -> Bounds:
    """Return the smallest bounds that contain both."""
    left, low, right, high = one
    return min(left, other[0]), min(low, other[1]), max(right, other[2]), max(high, other[3])


def robot_parts(config: RobotConfig) -> list[tuple[Floats, Colour]]:
    """Return the corners (N, 2) in the base frame [m] and the colours of the robot's parts.

    They are in drawing order: footprint, wheels, chassis, heading and LiDAR.
    """
    body, a, b = config.body, config.wheelbase / 2.0, config.wheel_separation / 2.0
    tyre = max(0.02, body.width - config.wheel_separation)
    inner = max(0.02, config.wheel_separation - tyre - 0.02)
    wheels = [
        (_rectangle(x, y, 2.0 * config.wheel_radius, tyre), TYRE_COLOUR)
        for x, y in ((a, -b), (a, b), (-a, b), (-a, -b))
    ]
    turn = np.linspace(0.0, math.tau, 16, endpoint=False)
    sensor = np.array([[config.lidar_x_offset, config.lidar_y_offset]])
    if config.footprint is None:
        outline = _rectangle(0.0, 0.0, body.length, body.width)
        chassis = _rectangle(0.0, 0.0, body.length, inner)
        nose = np.array([[0.46, 0.0], [0.12, 0.36], [0.12, -0.36]]) * (body.length, inner)
    else:
        outline = np.array(config.footprint)
        chassis, room = 0.75 * outline, border_distance(config.footprint, 0.0, 0.0)
        nose = np.array([[0.6, 0.0], [0.0, 0.4], [0.0, -0.4]]) * room
    return [
        (outline, DECK_COLOUR),
        *wheels,
        (chassis, CHASSIS_COLOUR),
        (nose, FLOOR_COLOUR),
        (sensor + _polar_points(turn, np.full(16, 0.035)), TYRE_COLOUR),
    ]


def _rectangle(x: float, y: float, length: float, width: float) -> Floats:
    """Return the corners of a rectangle around (x, y) [m]."""
    corners = np.array([[0.5, 0.5], [0.5, -0.5], [-0.5, -0.5], [-0.5, 0.5]])
    rectangle: Floats = corners * (length, width) + (x, y)
    return rectangle


def _polar_points(angles: Floats, ranges: Floats) -> Floats:
    """Convert angles (N,) [rad] and distances (N,) [m] to points (N, 2) [m]."""
    return np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])


def place_points(points: Floats, pose: Pose) -> Floats:
    """Transform points (N, 2) from the frame of a pose to the frame that the pose is in [m]."""
    x, y, theta = pose
    cos, sin = math.cos(theta), math.sin(theta)
    placed: Floats = points @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
    return placed


def thin_path(path: Sequence[Point]) -> Floats:
    """Thin out a path to about a thousand points (N, 2), keeping the last one."""
    step = 1
    while len(path) > MAX_PATH_POINTS * step:
        step *= 2  # doubling keeps most of the points of the picture before
    points = np.array(path[::step], np.float64).reshape(-1, 2)
    return points if step == 1 else np.concatenate([points, np.array(path[-1:])])


def save_picture(image: RgbImage, path: str | Path) -> None:
    """Write a picture as PNG; ConfigError for another suffix, or if it can't be written."""
    path = Path(path)
    check_picture_name(path)
    reading.write_atomically(path, encode_png(image, reading.describe_origin()))


def check_picture_name(path: Path) -> None:
    """Raise ConfigError unless this is the name of a PNG file."""
    if path.suffix.lower() != ".png":
        raise ConfigError(f"{path}: pictures are PNG files; use a name that ends in .png")
