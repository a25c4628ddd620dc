"""Draws the static part of a top view: floor, obstacles, start, goal and scale bar."""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.render.canvas import Bounds, Canvas, Colour, View, round_length
from acsar_gym.worlds import Region, World

Point = tuple[float, float]
"""Position (x, y) [m]."""

FLOOR: Colour = (251, 251, 249)
GRID: Colour = (231, 233, 236)
UNSEEN, SEEN = (FLOOR, GRID), ((249, 238, 237), (232, 220, 223))
"""Colours of floor and grid outside and inside the area that the LiDAR sees."""
INK: Colour = (70, 76, 88)
LABEL: Colour = (255, 255, 255, 205)
OBSTACLE: Colour = (58, 64, 77)
PLAN: Colour = (120, 128, 142)
GOAL: Colour = (38, 173, 97)
START: Colour = (30, 110, 220)
MARGIN = 0.35
"""Width of the floor shown around a world [m]."""
STRAY = 1.0
"""Width of the floor shown around start and goal if there is no world [m]."""
INSET = 10.0
"""Smallest distance of world and robot from the edges of the picture [pixels]."""
TEXT = 12.0
"""Height of text [pixels]."""


def still(world: World | None, view: View, floor: Colour, grid: Colour) -> Canvas:
    """Draw the floor with its grid, and the world's path and obstacles.

    Args:
        world: the world; None for an open floor.
        view: the part of the plane to show.
        floor: colour of the floor.
        grid: colour of the grid.

    Returns:
        A new canvas.
    """
    canvas = Canvas(view, floor)
    _grid(canvas, grid)
    if world is not None:
        _obstacles(canvas, world)
    return canvas


def _grid(canvas: Canvas, colour: Colour) -> None:
    """Draw grid lines every 1 m, or at a larger round distance in a small scale."""
    left, low, right, high = canvas.view.bounds
    step = max(1.0, round_length(30.0 / canvas.view.scale))
    for x in np.arange(math.ceil(left / step), math.floor(right / step) + 1) * step:
        canvas.line(np.array([[x, low], [x, high]]), colour, 1.0)
    for y in np.arange(math.ceil(low / step), math.floor(high / step) + 1) * step:
        canvas.line(np.array([[left, y], [right, y]]), colour, 1.0)


def _obstacles(canvas: Canvas, world: World) -> None:
    """Draw the world's path, then its obstacles."""
    if world.path is not None:
        canvas.dashes(world.path, PLAN, 1.0, 5.0)
    for x, y, radius in world.circles.tolist():
        canvas.disc((x, y), radius, OBSTACLE, least=1.0)
    for ends in world.segments.reshape(-1, 2, 2):
        canvas.line(ends, OBSTACLE, 2.5)
        canvas.dots(ends, 1.25, OBSTACLE)


def goal_disc(canvas: Canvas, place: Point, radius: float) -> None:
    """Draw a goal of `radius` [m], large enough to be visible."""
    canvas.disc(place, radius, (*GOAL, 70), GOAL, width=1.5, least=4.0)
    canvas.disc(place, 0.0, GOAL, least=2.5)


def start_arrow(canvas: Canvas, start: Region) -> None:
    """Draw a start: a disc, and an arrow if its heading is known."""
    place = (start.x, start.y)
    if start.radius > 0.0:
        canvas.disc(place, start.radius, (*START, 50), START)
    canvas.disc(place, 0.0, START, least=3.5)
    if start.theta is not None:
        ahead = np.array([math.cos(start.theta), math.sin(start.theta)]) / canvas.view.scale
        left = np.array([-ahead[1], ahead[0]])
        tip = place + np.array([18.0 * ahead, 11.0 * ahead + 4.5 * left, 11.0 * ahead - 4.5 * left])
        canvas.line(np.array([place, place + 13.0 * ahead]), START, 2.0)
        canvas.shape(tip, START)


def scale_bar(canvas: Canvas, row: float, share: float, *, right: bool = False) -> float:
    """Draw a scale bar of a round length in the lower left or right corner.

    Args:
        canvas: the canvas.
        row: row of the bar [pixels].
        share: largest length of the bar, as a share of the picture's width.
        right: whether it is in the right corner.

    Returns:
        Length of the bar [pixels].
    """
    width, scale = canvas.view.size[0], canvas.view.scale
    length = round_length(share * width / scale)
    label = f"{length:g} m" if length >= 1.0 else f"{100.0 * length:g} cm"
    column = width - INSET - length * scale if right else INSET
    canvas.bar(column, row, length, label, TEXT, INK, LABEL)
    return length * scale


def episode_bounds(world: World | None, goal: Point | None) -> Bounds:
    """Return the area to show in an episode [m].

    It contains world and goal, or, without a world, origin and goal.
    """
    if world is not None:
        return wider(_union(world.bounds, (*goal, *goal) if goal else world.bounds), MARGIN)
    points = np.array([(0.0, 0.0), goal or (0.0, 0.0)])
    (left, low), (right, high) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    longest = max(right - left, high - low)
    x, y, side = (left + right) / 2.0, (low + high) / 2.0, max(STRAY, 0.25 * longest)
    return wider((x, y, x, y), longest / 2.0 + side)


def wider(bounds: Bounds, margin: float) -> Bounds:
    """Return bounds with a margin added on every side [m]."""
    left, low, right, high = bounds
    return left - margin, low - margin, right + margin, high + margin


def grown(bounds: Bounds, x: float, y: float) -> Bounds:
    """Return bounds that also contain (x, y), with room to spare for further growth [m]."""
    more = 0.25 * max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    return _union(bounds, wider((x, y, x, y), more))


def _union(one: Bounds, other: Bounds) -> Bounds:
    """Return the smallest bounds that contain both."""
    left, low, right, high = one
    return min(left, other[0]), min(low, other[1]), max(right, other[2]), max(high, other[3])
