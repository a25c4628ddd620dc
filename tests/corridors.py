"""A generator of worlds of a user's own: a corridor with bottlenecks."""

from __future__ import annotations

import numpy as np

from acsar_gym.worlds import Region, World, register

LENGTH = 6.0


def corridors(rng: np.random.Generator, difficulty: float, footprint_radius: float) -> World:
    """A straight corridor. With difficulty it has more and narrower bottlenecks."""
    half = 2.0 * footprint_radius + 0.4
    pieces = [[-1.0, side, LENGTH + 1.0, side] for side in (-half, half)]
    gap = 2.0 * footprint_radius + 0.2 + 0.4 * (1.0 - difficulty)
    for x in np.linspace(1.0, LENGTH - 1.0, 1 + round(3.0 * difficulty)):
        middle = rng.uniform(gap / 2.0 - half, half - gap / 2.0)
        pieces += [[x, -half, x, middle - gap / 2.0], [x, middle + gap / 2.0, x, half]]
    return World(
        segments=np.array(pieces),
        start=Region(0.0, 0.0, 0.0, 0.0),
        goal=Region(LENGTH, 0.0),
    )


register("corridors", corridors)
