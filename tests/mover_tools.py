"""A world in which people walk."""

from __future__ import annotations

from acsar_gym.worlds import Region, World
from acsar_gym.worlds.movers import walk
from acsar_gym.worlds.world import make_rectangle

HALL = World(
    segments=make_rectangle(-1.0, -2.0, 5.0, 2.0),
    start=Region(0.2, -0.1, 0.0, 0.3),
    goal=Region(4.0, 0.0, 0.25),
    movers=(
        walk([[1.6, -1.5], [1.6, 1.5]], 0.8, spread=4.0, name="across"),
        walk([[4.5, 0.6], [-0.5, 0.9]], 1.3, radius=0.3, reacts=True, name="towards"),
        walk([[3.0, -1.2], [3.0, -1.2]], name="waiting"),
    ),
    name="hall",
)
"""One walks across, one comes towards the robot and keeps a distance, one stands."""
