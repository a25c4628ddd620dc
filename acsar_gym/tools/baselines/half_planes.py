"""Linear programmes of two variables: velocities within half planes.

The incremental algorithm of de Berg, Cheong, van Kreveld & Overmars, "Computational Geometry"
(2008), chapter 4, and if the soft half planes leave nothing, the velocity that breaks the worst
of them least, as in section 5.3 of van den Berg, Guy, Lin & Manocha, "Reciprocal n-body collision
avoidance" (ISRR 2011).

A half plane is a row (a, b, c) with a^2 + b^2 = 1: the points with a x + b y >= c. The first BOX
of each programme bound x and y from both sides.
"""

from __future__ import annotations

import numpy as np

from acsar_gym.jit import loop
from acsar_gym.tasks.state import Floats

A = 0
B = 1
C = 2
"""Columns of a half plane."""
BOX = 4
"""How many half planes bound the variables."""
PARALLEL = 1e-9
"""Lines whose normals have a smaller cross product than this are parallel."""


def make_box(x: tuple[float, float], y: tuple[float, float]) -> Floats:
    """Return the half planes of the least and greatest x and y, (BOX, 3)."""
    return np.array([(1, 0, x[0]), (-1, 0, -x[1]), (0, 1, y[0]), (0, -1, -y[1])], np.float64)


@loop
def solve_programme(planes: Floats, hard: int, x: float, y: float) -> tuple[float, float]:
    """Find the point within all half planes that is nearest to (x, y).

    Args:
        planes: (n, 3), the first BOX of which bound the variables.
        hard: Number of half planes, from the first on, that hold in any case, as far as they leave
            something.
        x: Coordinate of the wanted point.
        y: Coordinate of the wanted point.

    Returns:
        The point. If there is none, the point within the hard half planes whose distance from the
        worst of the others is least.
    """
    best_x, best_y, met = find_nearest(planes, len(planes), x, y, False)
    if met == len(planes):
        return best_x, best_y

    # Nothing is left of all: half plane by half plane, accept the least violation of the worst.
    projected = np.empty((len(planes), 3))
    worst = 0.0
    for i in range(met, len(planes)):
        a = planes[i, A]
        b = planes[i, B]
        c = planes[i, C]
        if c - a * best_x - b * best_y <= worst:
            continue

        # Along its border, as far within the soft half planes before it as possible.
        count = min(hard, i)
        projected[:count] = planes[:count]
        for j in range(min(hard, i), i):
            across_a = planes[j, A] - a
            across_b = planes[j, B] - b
            length = np.sqrt(across_a * across_a + across_b * across_b)
            if length > PARALLEL:
                projected[count, A] = across_a / length
                projected[count, B] = across_b / length
                projected[count, C] = (planes[j, C] - c) / length
                count += 1
        # Rounding may leave nothing, and then the point before is as good.
        next_x, next_y, met = find_nearest(projected, count, a, b, True)
        if met == count:
            best_x = next_x
            best_y = next_y
        worst = max(worst, c - a * best_x - b * best_y)
    return best_x, best_y


@loop
def find_nearest(
    planes: Floats, count: int, x: float, y: float, is_direction: bool
) -> tuple[float, float, int]:
    """Find the point within half planes that is nearest to (x, y), or farthest in that direction.

    Returns:
        The point, and how many of the half planes hold: `count`, or the place of the first half
        plane that leaves nothing.
    """
    # Without the others the nearest point is in the box, in a direction it is a corner of the box.
    if is_direction:
        best_x = -planes[1, C] if x > 0.0 else planes[0, C]
        best_y = -planes[3, C] if y > 0.0 else planes[2, C]
    else:
        best_x = min(max(x, planes[0, C]), -planes[1, C])
        best_y = min(max(y, planes[2, C]), -planes[3, C])

    for i in range(BOX, count):
        a = planes[i, A]
        b = planes[i, B]
        c = planes[i, C]
        if a * best_x + b * best_y >= c:
            continue

        # What the half planes before leave of the border: c (a, b) + s (-b, a) from low to high.
        low = -np.inf
        high = np.inf
        for j in range(i):
            slope = planes[j, B] * a - planes[j, A] * b
            room = planes[j, C] - c * (planes[j, A] * a + planes[j, B] * b)
            if slope > PARALLEL:
                low = max(low, room / slope)
            elif slope < -PARALLEL:
                high = min(high, room / slope)
            elif room > 0.0:
                high = -np.inf
        if low > high:
            return best_x, best_y, i

        # The nearest place of that part of the border.
        along = y * a - x * b
        if is_direction:
            along = high if along > 0.0 else low
        along = min(max(along, low), high)
        best_x = c * a - along * b
        best_y = c * b + along * a
    return best_x, best_y, count
