"""Top views: the robot in its world, with paths and scan. Needs Pillow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.config.footprint import border_distance, make_rectangle
from acsar_gym.errors import ConfigError
from acsar_gym.physics.body import wheel_hubs
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
from acsar_gym.worlds import Pose, World

RgbImage = NDArray[np.uint8]
"""Shape (height, width, 3), RGB."""
Point = tuple[float, float]
"""Position (x, y) [m]."""

FLOOR_COLOUR = (251, 251, 249)
GRID_COLOUR = (231, 233, 236)
UNSEEN_COLOURS = (FLOOR_COLOUR, GRID_COLOUR)
"""Colours of floor and grid outside the area that the LiDAR sees."""
SEEN_COLOURS = ((249, 238, 237), (232, 220, 223))
"""Colours of floor and grid inside the area that the LiDAR sees."""
OBSTACLE_COLOUR = (58, 64, 77)
PLAN_COLOUR = (120, 128, 142)
GOAL_COLOUR = (38, 173, 97)
ODOM_COLOUR = (30, 110, 220)
TRUTH_COLOUR = (245, 137, 32)
RAY_COLOUR = (216, 60, 80)
CHASSIS_COLOUR = (41, 89, 148)
DECK_COLOUR = (217, 224, 233)
TYRE_COLOUR = (30, 31, 34)
MOVER_COLOUR = (142, 68, 173)

TOP_SIZE = (480, 480)
"""Usual width and height of a top view [pixels]."""
WORLD_MARGIN = 0.35
"""Width of the floor shown around a world [m]."""
OPEN_MARGIN = 1.0
"""Width of the floor shown around start and goal if there is no world [m]."""
PICTURE_INSET = 10.0
"""Smallest distance of world and robot from the edges of the picture [pixels]."""
SMALL_ROBOT = 10.0
"""Robots shorter than this get a ring, to be visible [pixels]."""
MAX_PATH_POINTS = 1000
"""Longer paths are thinned out: otherwise pictures of a long drive would take longer and longer."""
VELOCITY_TIME = 0.6
"""The line of a mover's velocity ends where it will be in this time [s]."""


@dataclass(frozen=True, eq=False, slots=True)
class TopViewFrame:
    """Content of a picture, in the frame of the world, or in the odometry frame without a world."""

    world: World | None = None
    odom: Pose = (0.0, 0.0, 0.0)
    """Pose by odometry."""
    truth: Pose | None = None
    """True pose, or None on hardware."""
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
    """x, y [m], velocities in x and y [m/s], and radius [m] of each mover, (movers, 5)."""
    caption: str = ""


class TopView:
    """Draws top views of a robot. The view stays the same while world and goal do.

    It is fitted to world and goal. Without a world it is a square around origin and goal. It grows
    when the robot leaves it.

    Args:
        config: Robot configuration.
        size: Width and height of the pictures [pixels].
    """

    def __init__(self, config: RobotConfig, size: tuple[int, int] = TOP_SIZE) -> None:
        check_picture_size("size", size)
        self._config = config
        self._parts = robot_parts(config)
        self._footprint = self._parts[0][0]
        self._goal: Point | None = None
        self._bounds = episode_bounds(None, None)
        self._draw_layers(None, View.fitted(self._bounds, size, "x", PICTURE_INSET))

    @property
    def view(self) -> View:
        """View of the newest picture."""
        return self._dark.view

    def draw(self, frame: TopViewFrame) -> RgbImage:
        """Draw a picture, shape (height, width, 3)."""
        self._fit_view(frame)
        canvas = Canvas(self.view, self._dark.layer)
        pose = frame.truth or frame.odom
        # What the robot stands on, then the robot.
        if frame.rays is not None:
            self._draw_scan(canvas, pose, *frame.rays, frame.reach)
        if frame.movers is not None:
            draw_movers(canvas, frame.movers)
        if frame.goal is not None:
            draw_goal(canvas, frame.goal, frame.goal_radius)

        # The true path is the wider line, so that both can be seen while odometry is right.
        canvas.line(thin_path(frame.true_path), TRUTH_COLOUR, 3.5)
        canvas.line(thin_path(frame.odom_path), ODOM_COLOUR, 1.5)

        self._draw_ring(canvas, pose, CHASSIS_COLOUR)
        for corners, colour in self._parts:
            canvas.shape(place_points(corners, pose), colour)
        if frame.truth is not None:
            self._draw_odometry(canvas, frame.truth, frame.odom)
        if frame.caption:
            canvas.text((12.0, 20.0), frame.caption, box=LABEL_COLOUR)
        return canvas.picture()

    def _fit_view(self, frame: TopViewFrame) -> None:
        """Fit the view to a new world or goal, and extend it when the robot leaves it.

        In a world it still fits while the goal is visible.
        """
        view = self.view
        bounds = self._bounds
        has_new_world = frame.world is not self._world
        goal_fits = frame.goal == self._goal or (
            frame.world is not None
            and (frame.goal is None or view.shows(*frame.goal, PICTURE_INSET))
        )
        if has_new_world or not goal_fits:
            bounds = episode_bounds(frame.world, frame.goal)
            # Worlds are shown as maps, y up. On an open floor the robot starts facing up.
            up: Up = "x" if frame.world is None else "y"
            view = View.fitted(bounds, view.size, up, PICTURE_INSET)
        # A robot that leaves the picture makes it larger.
        for x, y, _ in (frame.odom, frame.truth or frame.odom):
            if math.isfinite(x + y) and not view.shows(x, y, PICTURE_INSET):
                room = 0.25 * np.ptp(bounds, axis=0).max()  # to grow further
                bounds = span([*bounds, np.subtract((x, y), room), np.add((x, y), room)])
                view = View.fitted(bounds, view.size, view.up, PICTURE_INSET)

        self._goal = frame.goal
        self._bounds = bounds

        # Floor, grid and obstacles stay the same for many pictures, which share these layers.
        if has_new_world or view != self.view:
            self._draw_layers(frame.world, view)

    def _draw_layers(self, world: World | None, view: View) -> None:
        """Draw the static part twice: outside and inside the area that the LiDAR sees."""
        self._world = world
        # A translucent overlay would tint obstacles as well: here only floor and grid differ.
        self._dark = draw_world(world, view, *UNSEEN_COLOURS)
        self._lit = draw_world(world, view, *SEEN_COLOURS)
        for canvas in (self._dark, self._lit):
            canvas.scale_bar(view.size[1] - PICTURE_INSET, 0.25, PICTURE_INSET)

    def _draw_scan(
        self, canvas: Canvas, pose: Pose, angles: Floats, ranges: Floats, reach: float
    ) -> None:
        """Draw the area that the LiDAR sees, with a dot at every hit."""
        offset = np.array([[self._config.lidar_x_offset, self._config.lidar_y_offset]])
        # A scan is as from the robot's present pose.
        sensor = place_points(offset, pose)
        ends = sensor + polar_points(angles + pose[2], np.minimum(ranges, reach))
        # Rays of a part of a turn enclose an area with the sensor.
        turn = float(angles[-1] - angles[0]) if len(angles) > 2 else 0.0
        is_full_turn = turn > 0.0 and math.tau - turn < 1.5 * turn / (len(angles) - 1)
        canvas.reveal(self._lit.layer, ends if is_full_turn else np.concatenate([sensor, ends]))
        canvas.rays(sensor, ends, (*RAY_COLOUR, 60))
        # A ray at full range has hit nothing, and gets no dot.
        canvas.discs(ends[ranges < reach - 1e-9], 0.0, RAY_COLOUR, least=1.75)

    def _draw_odometry(self, canvas: Canvas, truth: Pose, odom: Pose) -> None:
        """Draw the robot's outline at its odometry pose, if that differs by a pixel or more."""
        corners = place_points(self._footprint, odom)
        distance = np.hypot(*(corners - place_points(self._footprint, truth)).T).max()
        if distance * canvas.view.scale >= 1.0:
            self._draw_ring(canvas, odom, ODOM_COLOUR)
            canvas.shape(corners, (*ODOM_COLOUR, 30), ODOM_COLOUR, 1.5)
            nose = np.array([[0.0, 0.0], [self._footprint[:, 0].max(), 0.0]])
            canvas.line(place_points(nose, odom), ODOM_COLOUR, 1.5)

    def _draw_ring(self, canvas: Canvas, pose: Pose, colour: Colour) -> None:
        """Draw a ring around a robot that is too small to be seen."""
        if canvas.view.scale * self._config.body.length < SMALL_ROBOT:
            canvas.discs(pose[:2], 0.0, (*colour, 40), colour, width=1.5, least=SMALL_ROBOT)


def draw_world(world: World | None, view: View, floor: Colour, grid: Colour) -> Canvas:
    """Draw the floor with its grid, and the world's path and obstacles."""
    canvas = Canvas(view, floor)
    # Lines of the grid are at least 30 pixels apart.
    step = max(1.0, round_length(30.0 / view.scale))
    for axis in (0, 1):
        low, high = view.bounds[:, axis]
        for number in range(math.ceil(low / step), math.floor(high / step) + 1):
            ends = view.bounds
            ends[:, axis] = number * step
            canvas.line(ends, grid, 1.0)
    if world is None:
        return canvas

    if world.path is not None:
        canvas.line(world.path, PLAN_COLOUR, 1.0)
    for x, y, radius in world.circles.tolist():
        # In a large world a thin post would be smaller than a pixel.
        canvas.discs((x, y), radius, OBSTACLE_COLOUR, least=1.0)
    for ends in world.segments.reshape(-1, 2, 2):
        canvas.line(ends, OBSTACLE_COLOUR, 2.5)
        # Pillow's wide lines end bluntly: discs close the gaps at corners of walls.
        canvas.discs(ends, 0.0, OBSTACLE_COLOUR, least=1.25)
    return canvas


def draw_movers(canvas: Canvas, movers: Floats) -> None:
    """Draw movers (movers, 5) as discs, with a line to where each will be in VELOCITY_TIME."""
    for x, y, vx, vy, radius in movers.tolist():
        canvas.discs((x, y), radius, (*MOVER_COLOUR, 120), MOVER_COLOUR, width=1.5, least=2.0)
        ahead = (x + VELOCITY_TIME * vx, y + VELOCITY_TIME * vy)
        canvas.line(np.array([(x, y), ahead]), MOVER_COLOUR, 2.0)


def draw_goal(canvas: Canvas, place: Point, radius: float) -> None:
    """Draw a goal of `radius` [m], large enough to be visible."""
    canvas.discs(place, radius, (*GOAL_COLOUR, 70), GOAL_COLOUR, width=1.5, least=4.0)
    canvas.discs(place, 0.0, GOAL_COLOUR, least=2.5)


def episode_bounds(world: World | None, goal: Point | None) -> Bounds:
    """Return the area to show in an episode [m].

    It contains world and goal, or, without a world, origin and goal.
    """
    # Without a world the robot starts at the origin, which has to be visible.
    corners = np.reshape(world.bounds if world else (0.0,) * 4, (2, 2))
    bounds = span([*corners, goal] if goal else corners)
    if world is not None:
        return widen_bounds(bounds, WORLD_MARGIN)
    # Without a world, a square leaves room for detours.
    longest = np.ptp(bounds, axis=0).max()
    margin = longest / 2.0 + max(OPEN_MARGIN, 0.25 * longest)
    return widen_bounds([bounds.mean(axis=0)] * 2, margin)


def span(points: ArrayLike) -> Bounds:
    """Return the smallest bounds that contain points (N, 2) [m]."""
    return np.array([np.min(points, axis=0), np.max(points, axis=0)])


def widen_bounds(bounds: ArrayLike, margin: float) -> Bounds:
    """Return bounds with a margin added on every side [m]."""
    low, high = np.reshape(bounds, (2, 2))
    return np.array([low - margin, high + margin])


def robot_parts(config: RobotConfig) -> list[tuple[Floats, Colour]]:
    """Return the corners (N, 2) in the base frame [m] and the colours of the robot's parts.

    They are in drawing order: footprint, wheels, chassis, heading and LiDAR.
    """
    # Chassis and heading are parts of the outline, so that any footprint has them.
    outline = np.array(config.outline)
    nose = np.array([[0.6, 0.0], [0.1, 0.4], [0.1, -0.4]])
    nose *= border_distance(config.outline, 0.0, 0.0)
    tyre = max(0.02, config.body.width - config.wheel_separation)
    wheel = np.array(make_rectangle(2.0 * config.wheel_radius, tyre))

    hubs = wheel_hubs(config.wheelbase / 2.0, config.wheel_separation / 2.0)
    turn = np.linspace(0.0, math.tau, 16, endpoint=False)
    sensor = np.array([[config.lidar_x_offset, config.lidar_y_offset]])
    return [
        (outline, DECK_COLOUR),
        *((wheel + hub, TYRE_COLOUR) for hub in hubs),
        (0.75 * outline, CHASSIS_COLOUR),
        (nose, FLOOR_COLOUR),
        (sensor + polar_points(turn, np.full(16, 0.035)), TYRE_COLOUR),
    ]


def polar_points(angles: Floats, ranges: Floats) -> Floats:
    """Convert angles (N,) [rad] and distances (N,) [m] to points (N, 2) [m]."""
    return np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])


def thin_path(path: Sequence[Point]) -> Floats:
    """Return at most about MAX_PATH_POINTS points of a path with its last point, (N, 2) [m]."""
    # A step that doubles keeps most points of the last picture, so that the line doesn't flicker.
    step = 1
    while len(path) > MAX_PATH_POINTS * step:
        step *= 2
    points = np.array(path[::step], np.float64).reshape(-1, 2)
    return points if step == 1 else np.concatenate([points, path[-1:]])


def place_points(points: Floats, pose: Pose) -> Floats:
    """Transform points (N, 2) from the frame of a pose to the frame that the pose is in [m]."""
    x, y, theta = pose
    cos = math.cos(theta)
    sin = math.sin(theta)
    # Points are rows, so the rotation matrix is transposed and on their right.
    placed: Floats = points @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
    return placed


def save_picture(image: RgbImage, path: str | Path) -> None:
    """Write a picture as PNG. Raises ConfigError for another suffix, or if it can't be written."""
    path = Path(path)
    check_picture_name(path)
    reading.write_atomically(path, encode_png(image, reading.describe_origin()))


def check_picture_name(path: Path) -> None:
    """Raise ConfigError unless this is the name of a PNG file."""
    if path.suffix.lower() != ".png":
        raise ConfigError(f"{path}: pictures are PNG files; use a name that ends in .png")
