"""A generator of a room in which people walk around a robot at 1.5 m/s."""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.worlds import Region, World, register
from acsar_gym.worlds.movers import Repeat, follow_keys, walk
from acsar_gym.worlds.world import make_rectangle

SPEED = 1.5
"""[m/s]."""


def walkers(rng: np.random.Generator, difficulty: float, footprint_radius: float) -> World:
    """Four people along a square, one to and fro, and one along a circle, around the start."""
    square = np.array([[2.4, -2.4], [2.4, 2.4], [-2.4, 2.4], [-2.4, -2.4]])
    side = 4.8 / SPEED
    angles = np.linspace(0.0, math.tau, 25)
    circle = 1.7 * np.column_stack([np.cos(angles), np.sin(angles)])
    return World(
        segments=make_rectangle(-4.0, -3.5, 4.0, 3.5),
        start=Region(0.0, 0.0, 0.0, 0.0),
        goal=Region(0.8, 0.0),
        movers=(
            *(walk(square, SPEED, repeat=Repeat.LOOP, phase=k * side) for k in range(4)),
            walk([[3.4, -3.0], [3.4, 3.0]], SPEED, pauses=0.5, spread=3.0),
            follow_keys(angles * 1.7 / SPEED, circle, smooth=True),
        ),
    )


register("walkers", walkers)
