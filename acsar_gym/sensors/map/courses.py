"""Courses that a robot can take now, and on which of them it would meet a moving object.

On a course the robot keeps a velocity for a while, and so do the objects: the dynamic window
approach (Fox, Burgard and Thrun, 1997) predicts this for its candidates, and a policy gets it as
numbers, as it gets the free ways between standing obstacles (`arcs`). Policies that were trained
with courses solved 34 % of crowds with ACSAR instead of 24 % (docs/experiments.md).
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from acsar_gym.jit import subroutine
from acsar_gym.sensors.map.arcs import CURVATURES
from acsar_gym.sensors.map.seen import Floats, length_of
from acsar_gym.sensors.map.tracks import RADIUS, VX, VY, X, Y

COURSES = (
    *((1.0, curvature) for curvature in CURVATURES),
    *((0.5, curvature) for curvature in (-0.55, -0.15, 0.0, 0.15, 0.55)),
    (0.0, 0.0),
    *((-0.5, curvature) for curvature in (-0.55, 0.0, 0.55)),
)
"""Speed, as a share of the robot's top speed, and curvature, in units of 1 / radius of the
footprint, positive to the left. If its turn rate doesn't suffice, a course is slower."""
COURSE_STEP = 0.2
"""Time between two compared places on a course [s]."""
COURSE_STEPS = 12
"""Compared places on a course."""
CONTACT_GAP = 0.1
"""An object is met if it comes nearer than this to the disc around the footprint, in radii."""
MOST_GAP = 4.0
"""A larger gap counts as this, in radii."""


@lru_cache(maxsize=1024)
def tabulate_courses(radius: float, speed: float, turn_rate: float) -> Floats:
    """Compute where a robot is on each course, (COURSES, COURSE_STEPS, 2), in the base frame [m].

    Args:
        radius: Radius of the footprint [m].
        speed: Top speed [m/s].
        turn_rate: Largest turn rate [rad/s].
    """
    places = np.empty((len(COURSES), COURSE_STEPS, 2))
    for course, (share, curvature) in enumerate(COURSES):
        bend = curvature / radius
        # A course that the turn rate doesn't allow at this speed is driven slower.
        limit = turn_rate / max(abs(bend), 1e-9)
        pace = math.copysign(min(abs(share) * speed, limit), share)
        driven = pace * COURSE_STEP * np.arange(1, COURSE_STEPS + 1)
        # Along the arc, whose centre is at the side of the robot.
        if bend == 0.0:
            places[course] = np.column_stack([driven, np.zeros(COURSE_STEPS)])
        else:
            angles = bend * driven
            places[course] = np.column_stack([np.sin(angles), 1.0 - np.cos(angles)]) / bend
    return places


@subroutine
def measure_courses(places: Floats, radius: float, movers: Floats, out: Floats) -> None:
    """Measure when each course meets an object, and how near it comes to any object.

    Args:
        places: Table of `tabulate_courses`.
        radius: Radius of the footprint [m].
        movers: (n, RADIUS + 1): The first columns of tracks, in the base frame.
        out: (2 COURSES,): Gets the time until the first contact on each course, as a share of the
            course and 1 if there is no contact, then the smallest gap until that time, in radii.
    """
    for course in range(len(COURSES)):
        free = COURSE_STEPS
        smallest = MOST_GAP * radius

        # Each object shortens the part of the course that the next objects are compared with.
        for k in range(len(movers)):
            for step in range(free):
                time = COURSE_STEP * (step + 1)
                dx = movers[k, X] + time * movers[k, VX] - places[course, step, 0]
                dy = movers[k, Y] + time * movers[k, VY] - places[course, step, 1]
                gap = length_of(dx, dy) - radius - movers[k, RADIUS]
                smallest = min(smallest, gap)
                if gap < CONTACT_GAP * radius:
                    free = step
                    break
        out[course] = free / COURSE_STEPS
        out[len(COURSES) + course] = max(smallest, 0.0) / radius
