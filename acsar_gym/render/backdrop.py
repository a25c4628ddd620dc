"""What stands still in a picture from above: floor, obstacles, start, goal, and a scale bar."""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.render.canvas import Bounds, Canvas, Colour, View, round_length
from acsar_gym.worlds import Region, World

Point = tuple[float, float]
"""x, y [m]."""

FLOOR: Colour = (251, 251, 249)
GRID: Colour = (231, 233, 236)
UNSEEN, SEEN = (FLOOR, GRID), ((249, 238, 237), (232, 220, 223))
"""Colours of the floor and its grid without and with the LiDAR's light."""
INK: Colour = (70, 76, 88)
LABEL: Colour = (255, 255, 255, 205)
OBSTACLE: Colour = (58, 64, 77)
PLAN: Colour = (120, 128, 142)
GOAL: Colour = (38, 173, 97)
START: Colour = (30, 110, 220)
MARGIN = 0.35
"""Floor shown around a world [m]."""
STRAY = 1.0
"""Floor shown around start and goal where there is no world [m]."""
INSET = 10.0
"""Pixels to every edge that neither a world nor the robot comes into."""
TEXT = 12.0
"""Height of the letters' line [pixels]."""


def still(world: World | None, view: View, floor: Colour, grid: Colour) -> Canvas:
    """A canvas with a floor, and what stands on it."""
    canvas = Canvas(view, floor)
    _grid(canvas, grid)
    if world is not None:
        _obstacles(canvas, world)
    return canvas


def _grid(canvas: Canvas, colour: Colour) -> None:
    """Lines every 1 m, or more where that would be too fine."""
    left, low, right, high = canvas.view.bounds
    step = max(1.0, round_length(30.0 / canvas.view.scale))
    for x in np.arange(math.ceil(left / step), math.floor(right / step) + 1) * step:
        canvas.line(np.array([[x, low], [x, high]]), colour, 1.0)
    for y in np.arange(math.ceil(low / step), math.floor(high / step) + 1) * step:
        canvas.line(np.array([[left, y], [right, y]]), colour, 1.0)


def _obstacles(canvas: Canvas, world: World) -> None:
    """The world's path, then what stands in the way."""
    if world.path is not None:
        canvas.dashes(world.path, PLAN, 1.0, 5.0)
    for x, y, radius in world.circles.tolist():
        canvas.disc((x, y), radius, OBSTACLE, least=1.0)
    for ends in world.segments.reshape(-1, 2, 2):
        canvas.line(ends, OBSTACLE, 2.5)
        canvas.dots(ends, 1.25, OBSTACLE)


def goal_disc(canvas: Canvas, place: Point, radius: float) -> None:
    """A goal, which can be seen however small it is."""
    canvas.disc(place, radius, (*GOAL, 70), GOAL, width=1.5, least=4.0)
    canvas.disc(place, 0.0, GOAL, least=2.5)


def start_arrow(canvas: Canvas, start: Region) -> None:
    """A disc, and an arrow where the heading is known."""
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
    """A bar of a round length in the left or right corner; returns its length [pixels].

    It is at most a `share` of the picture's width.
    """
    width, scale = canvas.view.size[0], canvas.view.scale
    length = round_length(share * width / scale)
    label = f"{length:g} m" if length >= 1.0 else f"{100.0 * length:g} cm"
    column = width - INSET - length * scale if right else INSET
    canvas.bar(column, row, length, label, TEXT, INK, LABEL)
    return length * scale


def episode_bounds(world: World | None, goal: Point | None) -> Bounds:
    """What to show of an episode: world and goal; without a world goal and origin [m]."""
    if world is not None:
        return wider(_union(world.bounds, (*goal, *goal) if goal else world.bounds), MARGIN)
    points = np.array([(0.0, 0.0), goal or (0.0, 0.0)])
    (left, low), (right, high) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    longest = max(right - left, high - low)
    x, y, side = (left + right) / 2.0, (low + high) / 2.0, max(STRAY, 0.25 * longest)
    return wider((x, y, x, y), longest / 2.0 + side)


def wider(bounds: Bounds, margin: float) -> Bounds:
    """Bounds with a margin on every side [m]."""
    left, low, right, high = bounds
    return left - margin, low - margin, right + margin, high + margin


def grown(bounds: Bounds, x: float, y: float) -> Bounds:
    """Bounds that also hold a place, and so much more that they need not grow again soon [m]."""
    more = 0.25 * max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    return _union(bounds, wider((x, y, x, y), more))


def _union(one: Bounds, other: Bounds) -> Bounds:
    left, low, right, high = one
    return min(left, other[0]), min(low, other[1]), max(right, other[2]), max(high, other[3])
