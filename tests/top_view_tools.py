"""A world to be drawn."""

from __future__ import annotations

import numpy as np

from acsar_gym.render.top_view import TopViewFrame
from acsar_gym.worlds import Region, World

COURT = World(
    circles=np.array([[2.0, 1.0, 0.25], [3.25, -1.5, 0.5]]),
    segments=np.array([[-1.0, -2.5, 5.0, -2.5], [-1.0, 2.5, 5.0, 2.5]]),
    start=Region(0.0, 0.0, 0.0, 0.0),
    goal=Region(4.0, 0.25, 0.25),
    name="court",
)
FRAME = TopViewFrame(world=COURT, goal=(4.0, 0.25), goal_radius=0.25)
