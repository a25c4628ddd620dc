"""A search in space and time: can a disc that knows all motions cross a scene with movers?

In each time step, the cells that the disc may have reached grow by one cell, along the axes and
along the diagonals in turn, and those near obstacles or movers are left out.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from acsar_gym.worlds import World
from acsar_gym.worlds.geometry import segment_clearance
from acsar_gym.worlds.movers import draw_offset, locate_mover, make_motions

Floats = NDArray[np.float64]
CELL = 0.07
"""Side of a cell [m]. Larger areas have larger cells."""
MAX_CELLS = 50_000
MARGIN = 1.0
"""The search may leave the bounds of the world by this distance [m]."""
TOLERANCE = 0.2
"""The goal counts as reached from this distance [m]."""
CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], bool)
SQUARE = np.ones((3, 3), bool)
LONGEST_MOVE = math.hypot(2.0, 1.0) / 2.0
"""Of two steps, one of them diagonal, per step [cells]."""


def search_time(
    world: World,
    radius: float,
    speed: float,
    *,
    margin: float = 0.0,
    key: float = 0.0,
    horizon: float = 60.0,
) -> float | None:
    """Find when a disc that touches nobody can be at the goal [s]. None if it can't.

    People who react count as if they followed their motion.

    Args:
        world: Obstacles, movers, start and goal.
        radius: Radius of the disc [m].
        speed: Greatest speed of the disc [m/s].
        margin: Distance that it keeps from movers [m].
        key: The episode's draw, see `Scene.key`.
        horizon: Longest time until the goal [s].
    """
    bounds = np.array(world.standing_bounds)
    low = bounds[:2] - MARGIN
    high = bounds[2:] + MARGIN
    side = max(CELL, math.sqrt(float((high - low).prod()) / MAX_CELLS))
    x = np.arange(low[0], high[0], side)
    y = np.arange(low[1], high[1], side)
    centres = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    flat = centres.reshape(-1, 2)
    free = (segment_clearance(flat, flat, world) >= radius).reshape(len(x), len(y))

    start_distance = np.hypot(*np.moveaxis(centres - (world.start.x, world.start.y), -1, 0))
    goal_distance = np.hypot(*np.moveaxis(centres - (world.goal.x, world.goal.y), -1, 0))
    reached = start_distance <= start_distance.min() + 1e-9
    is_goal = goal_distance <= max(TOLERANCE, 0.75 * side)
    free |= reached

    motions = make_motions([world.movers])
    reaches = [radius + margin + mover.radius for mover in world.movers]
    period = LONGEST_MOVE * side / speed
    for step in range(1, math.ceil(horizon / period)):
        reached = binary_dilation(reached, SQUARE if step % 2 else CROSS) & free
        for number, reach in enumerate(reaches):
            mover = motions.movers[0, number]
            for share in (0.5, 1.0):  # a mover covers half a cell or so between two looks
                clock = (step - 1 + share) * period + draw_offset(mover, number, key)
                place = locate_mover(mover, motions.pieces[0], clock)[:2]
                reached &= ((centres - place) ** 2).sum(axis=-1) >= reach**2
        if (reached & is_goal).any():
            return step * period
        if not reached.any():
            return None
    return None
