"""Linear programmes of two variables: the velocity nearest to a wanted one within half planes.

The incremental algorithm of de Berg, Cheong, van Kreveld & Overmars, "Computational Geometry"
(2008), chapter 4, and where the soft half planes leave nothing, the velocity that breaks the worst
of them least, as in section 5.3 of van den Berg, Guy, Lin & Manocha, "Reciprocal n-body collision
avoidance" (ISRR 2011).

A half plane is a row (a, b, c) with a^2 + b^2 = 1: the points where a x + b y >= c. The first BOX
of each programme bound x and y from both sides.
"""

from __future__ import annotations

import numpy as np

from acsar_gym.jit import loop
from acsar_gym.tasks.state import Floats

BOX = 4
"""How many half planes bound the variables."""
PARALLEL = 1e-9
"""Lines whose normals have a smaller cross product than this are parallel."""


def make_box(x: tuple[float, float], y: tuple[float, float], planes: Floats) -> None:
    """Write the half planes of the least and greatest x and y into the first BOX rows."""
    planes[:BOX] = (1.0, 0.0, x[0]), (-1.0, 0.0, -x[1]), (0.0, 1.0, y[0]), (0.0, -1.0, -y[1])


@loop
def solve_programme(planes: Floats, hard: int, x: float, y: float) -> tuple[float, float]:
    """Find the point within all half planes that is nearest to (x, y).

    Args:
        planes: (n, 3), the first BOX of which bound the variables.
        hard: so many of the first ones hold in any case, as far as they leave something.
        x: of the wanted point.
        y: of the wanted point.

    Returns:
        The point; where there is none, the one within the hard half planes whose distance from the
        worst of the others is least.
    """
    found_x, found_y, met = find_nearest(planes, len(planes), x, y, False)
    if met == len(planes):
        return found_x, found_y
    projected = np.empty((len(planes), 3))
    worst = 0.0
    for i in range(met, len(planes)):
        a, b, c = planes[i, 0], planes[i, 1], planes[i, 2]
        if c - a * found_x - b * found_y <= worst:
            continue
        first = min(hard, i)
        projected[:first] = planes[:first]
        count = first
        for j in range(first, i):
            across_a, across_b = planes[j, 0] - a, planes[j, 1] - b
            length = np.sqrt(across_a * across_a + across_b * across_b)
            if length > PARALLEL:
                projected[count, 0] = across_a / length
                projected[count, 1] = across_b / length
                projected[count, 2] = (planes[j, 2] - c) / length
                count += 1
        there_x, there_y, held = find_nearest(projected, count, a, b, True)
        if held == count:
            found_x, found_y = there_x, there_y
        worst = max(worst, c - a * found_x - b * found_y)
    return found_x, found_y


@loop
def find_nearest(
    planes: Floats, count: int, x: float, y: float, is_direction: bool
) -> tuple[float, float, int]:
    """Find the point within half planes that is nearest to (x, y), or farthest in that direction.

    Returns:
        The point, and how many of the half planes hold: `count`, or the place of the first one that
        leaves nothing.
    """
    if is_direction:
        found_x = -planes[1, 2] if x > 0.0 else planes[0, 2]
        found_y = -planes[3, 2] if y > 0.0 else planes[2, 2]
    else:
        found_x = min(max(x, planes[0, 2]), -planes[1, 2])
        found_y = min(max(y, planes[2, 2]), -planes[3, 2])
    for i in range(BOX, count):
        a, b, c = planes[i, 0], planes[i, 1], planes[i, 2]
        if a * found_x + b * found_y >= c:
            continue
        least, most = -np.inf, np.inf  # along the line: c (a, b) + s (-b, a)
        for j in range(i):
            slope = planes[j, 1] * a - planes[j, 0] * b
            room = planes[j, 2] - c * (planes[j, 0] * a + planes[j, 1] * b)
            if slope > PARALLEL:
                least = max(least, room / slope)
            elif slope < -PARALLEL:
                most = min(most, room / slope)
            elif room > 0.0:
                most = -np.inf
        if least > most:
            return found_x, found_y, i
        along = y * a - x * b
        if is_direction:
            along = most if along > 0.0 else least
        along = min(max(along, least), most)
        found_x, found_y = c * a - along * b, c * b + along * a
    return found_x, found_y, count
