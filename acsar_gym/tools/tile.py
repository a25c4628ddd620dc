"""A world as a map with its name: a tile of a contact sheet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from acsar_gym.render.canvas import FINE_SCALE, LABEL_COLOUR, Canvas, Floats, View
from acsar_gym.render.top_view import (
    GRID_COLOUR,
    MOVER_COLOUR,
    PICTURE_INSET,
    START_COLOUR,
    UNSEEN_COLOURS,
    WORLD_MARGIN,
    RgbImage,
    draw_goal,
    draw_movers,
    draw_world,
    place_points,
    widen_bounds,
)
from acsar_gym.worlds import Mover, Region, World

TITLE_HEIGHT = 24
"""Height of a tile's title [pixels]."""
MAX_TITLE = 28
"""Longest title of a tile of 320 pixels [characters]."""
WAY_POINTS = 9
"""Points of each piece of a mover's way."""


def draw_tile(world: World, size: int) -> RgbImage:
    """Draw a world as a map with its name, a square of `size` pixels."""
    bounds = widen_bounds(world.bounds, WORLD_MARGIN / 2.0)
    view = View.fitted(bounds, (size, size - TITLE_HEIGHT), "y", PICTURE_INSET / 2.0)
    below_title = (view.centre[0], view.centre[1] + TITLE_HEIGHT / 2.0 / view.scale)
    view = replace(view, centre=below_title, size=(size, size))

    canvas = draw_world(world, view, *UNSEEN_COLOURS)
    draw_motions(canvas, world)
    draw_start(canvas, world.start)
    draw_goal(canvas, (world.goal.x, world.goal.y), world.goal.radius)
    draw_title(canvas, world.name)
    return canvas.picture()


def draw_motions(canvas: Canvas, world: World) -> None:
    """Draw a world's movers as an episode starts, and thin lines along their ways."""
    for mover in world.movers:
        canvas.line(trace_way(mover), (*MOVER_COLOUR, 130), 1.0)
    for mover in world.movers:
        state = (*mover.position(0.0), *mover.velocity(0.0), mover.radius)
        draw_movers(canvas, np.array([state]))


def trace_way(mover: Mover) -> Floats:
    """Return points (N, 2) of a mover's way [m]."""
    starts, x_cubic, y_cubic = np.split(mover.pieces, [1, 5], axis=1)
    lengths = np.diff(starts[:, 0], append=mover.duration)
    times = np.outer(lengths, np.linspace(0.0, 1.0, WAY_POINTS))
    powers = times[:, :, None] ** np.arange(4)
    axes = np.stack([x_cubic, y_cubic], axis=2)
    return (powers @ axes).reshape(-1, 2)


def draw_start(canvas: Canvas, start: Region) -> None:
    """Draw a start: a disc, and an arrow if its heading is known."""
    place = (start.x, start.y)
    if start.radius > 0.0:
        canvas.discs(place, start.radius, (*START_COLOUR, 50), START_COLOUR)
    canvas.discs(place, 0.0, START_COLOUR, least=3.5)
    if start.theta is not None:
        arrow = np.array([[0.0, 0.0], [13.0, 0.0], [18.0, 0.0], [11.0, 4.5], [11.0, -4.5]])
        points = place_points(arrow / canvas.view.scale, (*place, start.theta))
        canvas.line(points[:2], START_COLOUR, 2.0)
        canvas.shape(points[2:], START_COLOUR)


def draw_title(canvas: Canvas, title: str) -> None:
    """Draw a strip along the top with a title and a scale bar, and lines around it and the tile."""
    right, low = (side - 1 for side in canvas.layer.size)
    base = FINE_SCALE * TITLE_HEIGHT
    canvas.pen.rectangle((0, 0, right, base), fill=LABEL_COLOUR[:3])
    canvas.pen.line((0, base, right, base), GRID_COLOUR, FINE_SCALE)
    canvas.pen.rectangle((0, 0, right, low), outline=GRID_COLOUR, width=FINE_SCALE)
    canvas.text((PICTURE_INSET, TITLE_HEIGHT / 2.0), title[:MAX_TITLE], anchor="lm")
    canvas.scale_bar(TITLE_HEIGHT - 6.0, 0.2, PICTURE_INSET, right=True)
