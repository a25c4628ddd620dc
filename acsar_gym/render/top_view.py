"""Top views: the robot in its world, and contact sheets of worlds. Needs Pillow."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, shown
from acsar_gym.reading import bounded
from acsar_gym.render import backdrop as scenery
from acsar_gym.render.backdrop import FLOOR, GRID, INK, INSET, LABEL, SEEN, TEXT, UNSEEN, Point
from acsar_gym.render.canvas import (
    Canvas,
    Colour,
    Floats,
    Up,
    View,
    check_size,
    encode,
    shortened,
)
from acsar_gym.render.vehicle import CHASSIS, footprint, parts, polar
from acsar_gym.worlds import Pose, World

Image = NDArray[np.uint8]
"""Shape (height, width, 3), RGB."""

ODOM: Colour = (30, 110, 220)
TRUTH: Colour = (245, 137, 32)
RAY: Colour = (216, 60, 80)
HIT: Colour = (214, 20, 30)
SMALL = 10.0
"""Robots shorter than this get a ring, to be visible [pixels]."""
MOST_POINTS = 1000
"""Paths with more points are thinned out."""
MOST_PIXELS = 36_000_000
"""Largest size of a sheet [pixels]."""
TITLE = 24
"""Height of a tile's title [pixels]."""


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
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
    caption: str = ""
    hit: Point | None = None
    """Where the robot collided."""


class TopView:
    """Draws top views of one robot; the view is kept as long as world and goal are.

    It is fitted to world and goal; without a world it is a square around origin and goal. It grows
    when the robot leaves it.

    Args:
        config: configuration of the robot.
        size: width and height of the pictures [pixels].
        up: axis that points up; None for y in a world, as on a map, and x without one.

    Raises:
        ConfigError: width or height isn't 64 to 4096 pixels.
        MissingExtraError: Pillow isn't installed.
    """

    def __init__(
        self, config: RobotConfig, size: tuple[int, int] = (480, 480), up: Up | None = None
    ) -> None:
        check_size("size", size)
        self.layers = 0
        """How often the static part was drawn."""
        self._config = config
        self._up = up
        self._parts = parts(config)
        self._footprint = footprint(config)
        self._goal: Point | None = None
        self._bounds = scenery.episode_bounds(None, None)
        self._draw_still(None, View.fitted(self._bounds, size, up or "x", INSET))

    @property
    def view(self) -> View:
        """View of the newest picture."""
        return self._dark.view

    def draw(self, frame: Frame) -> Image:
        """Draw a picture, shape (height, width, 3)."""
        self._look_at(frame)
        canvas = Canvas(self.view, self._dark.layer)
        pose = frame.truth or frame.odom
        if frame.rays is not None:
            self._scan(canvas, pose, *frame.rays, frame.reach)
        if frame.goal is not None:
            scenery.goal_disc(canvas, frame.goal, frame.goal_radius)
        canvas.line(_thinned(frame.true_path), TRUTH, 3.5)
        canvas.line(_thinned(frame.odom_path), ODOM, 1.5)
        self._robot(canvas, pose)
        if frame.truth is not None:
            self._ghost(canvas, frame.truth, frame.odom)
        if frame.hit is not None:
            canvas.disc(frame.hit, 0.0, (*HIT, 90), HIT, width=2.5, least=9.0)
            canvas.disc(frame.hit, 0.0, HIT, least=2.5)
        if frame.caption:
            canvas.text((12.0, 20.0), frame.caption, TEXT, INK, box=LABEL)
        return canvas.picture()

    def _look_at(self, frame: Frame) -> None:
        """Fit the view to a new world or goal, and extend it when the robot leaves it."""
        view, bounds = self.view, self._bounds
        if frame.world is not self._world or not self._same_goal(frame):
            bounds = scenery.episode_bounds(frame.world, frame.goal)
            up = self._up or ("x" if frame.world is None else "y")
            view = View.fitted(bounds, view.size, up, INSET)
        for x, y, _ in (frame.odom, frame.truth or frame.odom):
            if math.isfinite(x + y) and not view.shows(x, y, INSET):
                bounds = scenery.grown(bounds, x, y)
                view = View.fitted(bounds, view.size, view.up, INSET)
        self._goal, self._bounds = frame.goal, bounds
        if frame.world is not self._world or view != self.view:
            self._draw_still(frame.world, view)

    def _same_goal(self, frame: Frame) -> bool:
        """Return whether the view still fits; in a world it does while the goal is visible."""
        if frame.goal == self._goal:
            return True
        seen = frame.goal is None or self.view.shows(*frame.goal, INSET)
        return frame.world is not None and seen

    def _draw_still(self, world: World | None, view: View) -> None:
        """Draw the static part twice: outside and inside the area that the LiDAR sees."""
        self.layers += 1
        self._world = world
        self._dark, self._lit = (scenery.still(world, view, *floor) for floor in (UNSEEN, SEEN))
        for canvas in (self._dark, self._lit):
            scenery.scale_bar(canvas, view.size[1] - INSET, 0.25)

    def _scan(
        self, canvas: Canvas, pose: Pose, angles: Floats, ranges: Floats, reach: float
    ) -> None:
        """Draw the area that the LiDAR sees, with a dot at every hit."""
        config = self._config
        sensor = _placed(np.array([[config.lidar_x_offset, config.lidar_y_offset]]), pose)
        ends = sensor + polar(angles + pose[2], np.minimum(ranges, reach))
        around = _all_around(angles)
        canvas.reveal(self._lit.layer, ends if around else np.concatenate([sensor, ends]))
        canvas.rays(sensor, ends, (*RAY, 60))
        canvas.dots(ends[ranges < reach - 1e-9], 1.75, RAY)

    def _robot(self, canvas: Canvas, pose: Pose) -> None:
        """Draw the robot."""
        self._ring(canvas, pose, CHASSIS)
        for corners, colour in self._parts:
            canvas.shape(_placed(corners, pose), colour)

    def _ghost(self, canvas: Canvas, truth: Pose, odom: Pose) -> None:
        """Draw the robot's outline at its odometry pose, if that differs by a pixel or more."""
        corners = _placed(self._footprint, odom)
        apart = np.hypot(*(corners - _placed(self._footprint, truth)).T).max()
        if apart * canvas.view.scale >= 1.0:
            self._ring(canvas, odom, ODOM)
            canvas.shape(corners, (*ODOM, 30), ODOM, 1.5)
            nose = np.array([[0.0, 0.0], [max(self._footprint[:, 0]), 0.0]])
            canvas.line(_placed(nose, odom), ODOM, 1.5)

    def _ring(self, canvas: Canvas, pose: Pose, colour: Colour) -> None:
        """Draw a ring around a robot that is too small to be seen."""
        if canvas.view.scale * self._config.body.length < SMALL:
            canvas.disc(pose[:2], 0.0, (*colour, 40), colour, width=1.5, least=SMALL)


def most_tiles(columns: int, size: int) -> int:
    """Return how many worlds fit on a sheet of 36 megapixels, which is 100 MB.

    Raises:
        ConfigError: `size` isn't 64 to 4096 pixels, or there is no column.
    """
    check_size("size", (size, size))
    if columns < 1:
        raise ConfigError(f"columns = {shown(columns)}: must be at least 1")
    return MOST_PIXELS // size**2


def sheet(
    worlds: Sequence[World],
    columns: int,
    size: int,
    watch: Callable[[Sequence[World]], Iterable[World]] = iter,
) -> Image:
    """Draw worlds side by side as maps, x right and y up, with their names as titles.

    Args:
        worlds: the worlds, in rows from the left.
        columns: tiles in a row.
        size: width and height of a tile [pixels].
        watch: wraps the worlds as they are drawn, for a progress bar.

    Raises:
        ConfigError: there is no world or column, or `size` or the sheet is too large or small.
    """
    most = most_tiles(columns, size)
    if not worlds:
        raise ConfigError("there are no worlds to draw")
    columns = min(columns, len(worlds))
    rows = -(-len(worlds) // columns)
    if rows * columns > most:
        raise ConfigError(
            f"{len(worlds):,} worlds of {size} pixels are too many for a sheet in {columns} "
            f"columns: at most {most:,}"
        )
    image = np.full((rows * size, columns * size, 3), FLOOR, np.uint8)
    for index, world in enumerate(watch(worlds)):
        top, left = size * (index // columns), size * (index % columns)
        image[top : top + size, left : left + size] = _tile(world, size)
    return image


def _tile(world: World, size: int) -> Image:
    """Draw one world with its title."""
    bounds = scenery.wider(world.bounds, scenery.MARGIN / 2.0)
    view = View.fitted(bounds, (size, size - TITLE), "y", INSET / 2.0)
    below = (view.centre[0], view.centre[1] + TITLE / 2.0 / view.scale)
    canvas = scenery.still(world, replace(view, centre=below, size=(size, size)), *UNSEEN)
    scenery.start_arrow(canvas, world.start)
    scenery.goal_disc(canvas, (world.goal.x, world.goal.y), world.goal.radius)
    canvas.band(TITLE, LABEL[:3], GRID)
    bar = scenery.scale_bar(canvas, TITLE - 6.0, 0.2, right=True)
    name = shortened(world.name, TEXT, size - bar - 3.0 * INSET)
    canvas.text((INSET, TITLE / 2.0), name, TEXT, INK, anchor="lm")
    return canvas.picture()


def save(image: Image, path: str | Path) -> None:
    """Write a picture as PNG; ConfigError for another suffix, or if it can't be written."""
    path = Path(path)
    check_name(path)
    bounded.write_atomically(path, encode(image))


def check_name(path: Path) -> None:
    """Raise ConfigError unless this is the name of a PNG file."""
    if path.suffix.lower() != ".png":
        raise ConfigError(f"{path}: pictures are PNG files; use a name that ends in .png")


def _thinned(path: Sequence[Point]) -> Floats:
    """Thin out a path to about a thousand points (N, 2), keeping the last one."""
    step = 1
    while len(path) > MOST_POINTS * step:
        step *= 2  # doubling keeps most of the points of the picture before
    points = np.array(path[::step], np.float64).reshape(-1, 2)
    return points if step == 1 else np.concatenate([points, np.array(path[-1:])])


def _all_around(angles: Floats) -> bool:
    """Return whether evenly spaced angles cover the full circle."""
    if len(angles) < 3:
        return False
    turn = float(angles[-1] - angles[0])
    return math.tau - turn < 1.5 * turn / (len(angles) - 1)


def _placed(points: Floats, pose: Pose) -> Floats:
    """Transform points (N, 2) from the frame of a pose to the frame that the pose is in."""
    x, y, theta = pose
    cos, sin = math.cos(theta), math.sin(theta)
    placed: Floats = points @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
    return placed
