"""Pictures from above: the robot in its world, and contact sheets of worlds. Needs Pillow."""

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
"""height x width x 3, RGB."""

ODOM: Colour = (30, 110, 220)
TRUTH: Colour = (245, 137, 32)
RAY: Colour = (216, 60, 80)
SMALL = 10.0
"""Shorter robots are ringed, or nobody would find them [pixels]."""
MOST_POINTS = 1000
"""Longer paths are thinned out."""
MOST_PIXELS = 36_000_000
"""Of a sheet."""
TITLE = 24
"""Height of a tile's title [pixels]."""


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
    """What one picture shows, in the frame of the world, or without one in the odometry frame."""

    world: World | None = None
    odom: Pose = (0.0, 0.0, 0.0)
    """Where the robot takes itself to be."""
    truth: Pose | None = None
    """Where it is, which only a simulation knows."""
    goal: Point | None = None
    goal_radius: float = 0.15
    """[m]"""
    odom_path: Sequence[Point] = ()
    true_path: Sequence[Point] = ()
    rays: tuple[Floats, Floats] | None = None
    """The LiDAR's scan: angles to the robot's x axis (N,) [rad], evenly rising, and ranges (N,)
    [m]."""
    reach: float = math.inf
    """Range of a ray that met nothing [m]."""
    caption: str = ""


class TopView:
    """Draws frames of one robot from above, on a view that stays as long as world and goal do.

    The view is fitted to the world and the goal; without a world it is a square around the origin
    and the goal. It grows where the robot leaves it. `up` is the axis that points up; None: y in a
    world, as on a map, and x without one, so that a robot drives off upwards.

    Raises ConfigError for a `size` (width, height) that isn't 64 to 4096 pixels, MissingExtraError
    without Pillow.
    """

    def __init__(
        self, config: RobotConfig, size: tuple[int, int] = (480, 480), up: Up | None = None
    ) -> None:
        check_size("size", size)
        self.layers = 0
        """How often what stands still was drawn."""
        self._config = config
        self._up = up
        self._parts = parts(config)
        self._footprint = footprint(config)
        self._goal: Point | None = None
        self._bounds = scenery.episode_bounds(None, None)
        self._draw_still(None, View.fitted(self._bounds, size, up or "x", INSET))

    @property
    def view(self) -> View:
        """How metres become pixels in the newest picture."""
        return self._dark.view

    def draw(self, frame: Frame) -> Image:
        """One picture: height x width x 3."""
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
        if frame.caption:
            canvas.text((12.0, 20.0), frame.caption, TEXT, INK, box=LABEL)
        return canvas.picture()

    def _look_at(self, frame: Frame) -> None:
        """Fit the view to a new world or goal, and let it grow after the robot."""
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
        """Whether the goal needs no other view: in a world it may move, as long as it is seen."""
        if frame.goal == self._goal:
            return True
        seen = frame.goal is None or self.view.shows(*frame.goal, INSET)
        return frame.world is not None and seen

    def _draw_still(self, world: World | None, view: View) -> None:
        """Draw what stands still twice: as it is, and lit by the LiDAR."""
        self.layers += 1
        self._world = world
        self._dark, self._lit = (scenery.still(world, view, *floor) for floor in (UNSEEN, SEEN))
        for canvas in (self._dark, self._lit):
            scenery.scale_bar(canvas, view.size[1] - INSET, 0.25)

    def _scan(
        self, canvas: Canvas, pose: Pose, angles: Floats, ranges: Floats, reach: float
    ) -> None:
        """What the LiDAR sees as a fan, with a dot at every hit."""
        config = self._config
        sensor = _placed(np.array([[config.lidar_x_offset, config.lidar_y_offset]]), pose)
        ends = sensor + polar(angles + pose[2], np.minimum(ranges, reach))
        around = _all_around(angles)
        canvas.reveal(self._lit.layer, ends if around else np.concatenate([sensor, ends]))
        canvas.rays(sensor, ends, (*RAY, 60))
        canvas.dots(ends[ranges < reach - 1e-9], 1.75, RAY)

    def _robot(self, canvas: Canvas, pose: Pose) -> None:
        self._ring(canvas, pose, CHASSIS)
        for corners, colour in self._parts:
            canvas.shape(_placed(corners, pose), colour)

    def _ghost(self, canvas: Canvas, truth: Pose, odom: Pose) -> None:
        """The robot's outline where odometry has it, if that is a pixel or more away."""
        corners = _placed(self._footprint, odom)
        apart = np.hypot(*(corners - _placed(self._footprint, truth)).T).max()
        if apart * canvas.view.scale >= 1.0:
            self._ring(canvas, odom, ODOM)
            canvas.shape(corners, (*ODOM, 30), ODOM, 1.5)
            nose = np.array([[0.0, 0.0], [max(self._footprint[:, 0]), 0.0]])
            canvas.line(_placed(nose, odom), ODOM, 1.5)

    def _ring(self, canvas: Canvas, pose: Pose, colour: Colour) -> None:
        """A ring around a robot that would be hard to find."""
        if canvas.view.scale * self._config.body.length < SMALL:
            canvas.disc(pose[:2], 0.0, (*colour, 40), colour, width=1.5, least=SMALL)


def most_tiles(columns: int, size: int) -> int:
    """How many worlds fit on a sheet of 36 megapixels, which is 100 MB.

    Raises ConfigError where `size` isn't 64 to 4096 pixels, or there is no column.
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
    """Worlds side by side as maps, each in its own frame with x right and y up, under its name.

    Every tile is `size` pixels wide and high; rows are filled from the left. What passes through
    `watch` is drawn. Raises ConfigError where there is no world, no column, `size` isn't 64 to 4096
    pixels, or the sheet has more than 36 megapixels.
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
    """Write a picture as PNG. Raises ConfigError for another suffix, or if it can't be written."""
    path = Path(path)
    check_name(path)
    bounded.write(path, encode(image))


def check_name(path: Path) -> None:
    """ConfigError unless this is the name of a PNG file."""
    if path.suffix.lower() != ".png":
        raise ConfigError(f"{path}: pictures are PNG files; use a name that ends in .png")


def _thinned(path: Sequence[Point]) -> Floats:
    """At most about a thousand points of a path, with its last one, (N, 2)."""
    step = 1
    while len(path) > MOST_POINTS * step:
        step *= 2  # doubling leaves most points where they were in the picture before
    points = np.array(path[::step], np.float64).reshape(-1, 2)
    return points if step == 1 else np.concatenate([points, np.array(path[-1:])])


def _all_around(angles: Floats) -> bool:
    """Whether evenly spaced angles leave no gap between the last and the first."""
    if len(angles) < 3:
        return False
    turn = float(angles[-1] - angles[0])
    return math.tau - turn < 1.5 * turn / (len(angles) - 1)


def _placed(points: Floats, pose: Pose) -> Floats:
    """Points (N, 2) in the frame of a pose, in the frame that the pose is in."""
    x, y, theta = pose
    cos, sin = math.cos(theta), math.sin(theta)
    placed: Floats = points @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
    return placed
