"""Courses that a robot can take now, and on which of them it would meet what moves.

On a course it keeps a velocity for a while, and so do those who move: what a dynamic window (Fox,
Burgard and Thrun, 1997) predicts for its candidates, a policy gets as numbers, as it gets the free
ways between what stands (`arcs`).
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import subroutine
from acsar_gym.sensors.map.arcs import CURVATURES

Floats = NDArray[np.float64]
COURSES = (
    *((1.0, curvature) for curvature in CURVATURES),
    *((0.5, curvature) for curvature in (-0.55, -0.15, 0.0, 0.15, 0.55)),
    (0.0, 0.0),
    *((-0.5, curvature) for curvature in (-0.55, 0.0, 0.55)),
)
"""Speed, in parts of the robot's top speed, and curvature, in units of 1 / radius of the
footprint, positive to the left. Where its turn rate doesn't suffice, a course is slower."""
COURSE_STEP, COURSE_STEPS = 0.2, 12
"""Places on a course are compared at so many times, one each COURSE_STEP [s]."""
CONTACT_GAP = 0.1
"""Who comes nearer than this to the disc around the footprint is met, in radii."""
MOST_GAP = 4.0
"""A larger gap counts as this one, in radii."""


@lru_cache(maxsize=1024)
def tabulate_courses(radius: float, speed: float, turn_rate: float) -> Floats:
    """Compute where a robot is on each course, (COURSES, COURSE_STEPS, 2), in the base frame [m].

    Args:
        radius: of its footprint [m].
        speed: its top speed [m/s].
        turn_rate: its greatest one [rad/s].
    """
    places = np.empty((len(COURSES), COURSE_STEPS, 2))
    for course, (share, curvature) in enumerate(COURSES):
        bend = curvature / radius
        most = turn_rate / max(abs(bend), 1e-9)
        pace = math.copysign(min(abs(share) * speed, most), share)
        driven = pace * COURSE_STEP * np.arange(1, COURSE_STEPS + 1)
        if bend == 0.0:
            places[course] = np.column_stack([driven, np.zeros(COURSE_STEPS)])
        else:
            angles = bend * driven
            places[course] = np.column_stack([np.sin(angles), 1.0 - np.cos(angles)]) / bend
    return places


@subroutine
def measure_courses(places: Floats, radius: float, movers: Floats, out: Floats) -> None:
    """Measure when each course meets somebody, and how near it comes to anybody.

    Args:
        places: of `tabulate_courses`.
        radius: of the footprint [m].
        movers: (n, 5): x, y [m], velocity x, y [m/s] and radius [m], in the base frame.
        out: (2 COURSES,): gets the time until the first contact of each course, in parts of all
            its time, 1 for none; then the smallest gap of each until then, in radii.
    """
    for course in range(len(COURSES)):
        free, least = COURSE_STEPS, MOST_GAP * radius
        for k in range(len(movers)):
            for step in range(free):
                time = COURSE_STEP * (step + 1)
                dx = movers[k, 0] + time * movers[k, 2] - places[course, step, 0]
                dy = movers[k, 1] + time * movers[k, 3] - places[course, step, 1]
                gap = math.sqrt(dx * dx + dy * dy) - radius - movers[k, 4]
                least = min(least, gap)
                if gap < CONTACT_GAP * radius:
                    free = step
                    break
        out[course] = free / COURSE_STEPS
        out[len(COURSES) + course] = max(least, 0.0) / radius
