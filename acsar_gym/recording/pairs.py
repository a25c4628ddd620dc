"""Which episodes of two recordings belong together: those of the same seed and goal."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence

SAME_GOAL_DISTANCE = 0.01
"""Goals that are nearer to each other are one [m]."""
SeedKey = tuple[int | None, int]
"""A seed, and how many episodes before have the same one."""


def number_seeds(seeds: Iterable[int | None]) -> list[SeedKey]:
    """Tell episodes with the same seed apart.

    Args:
        seeds: of the episodes, in their order; None where one isn't known.
    """
    seen: Counter[int | None] = Counter()
    keys = []
    for seed in seeds:
        keys.append((seed, seen[seed]))
        seen[seed] += 1
    return keys


def have_same_goal(goal: Sequence[float] | None, other: Sequence[float] | None) -> bool:
    """Whether two goals (x, y) in odometry frames [m] are one; true where one isn't told."""
    return not (goal and other) or math.dist(goal, other) < SAME_GOAL_DISTANCE
