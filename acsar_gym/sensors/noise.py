"""Random numbers of sensors that read all robots of a batch at once, compiled or not.

A compiled sensor has no NumPy generators. These functions draw the same numbers from both.
"""

from __future__ import annotations

import math
from typing import Any

from acsar_gym.jit import compilable


def draw_uniform(rngs: Any, i: int) -> float:
    """Draw a number of [0, 1) from robot i's generator, the one of `Generator.random()`.

    Args:
        rngs: as `read_batch` and `reset_batch` get them.
        i: place of the robot in them.

    Returns:
        The number.
    """
    return float(rngs[i].random())


@compilable
def draw_normal(rngs: Any, i: int) -> float:
    """Draw a number of mean 0 and standard deviation 1 from robot i's generator.

    Made of two uniform ones as by Box and Muller (1958), so it isn't what `Generator.normal()`
    draws.

    Args:
        rngs: as `read_batch` and `reset_batch` get them.
        i: place of the robot in them.

    Returns:
        The number.
    """
    radius = math.sqrt(-2.0 * math.log(1.0 - draw_uniform(rngs, i)))
    return radius * math.cos(2.0 * math.pi * draw_uniform(rngs, i))
