"""Free ways along arcs, and courses: where a robot is on them, and whom it meets."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym.config.footprint import make_rectangle, outline_radius
from acsar_gym.sensors.map.arcs import (
    ARCS,
    CURVATURES,
    LONGEST_ARC,
    MARGIN,
    measure_arcs,
    tabulate_arcs,
)
from acsar_gym.sensors.map.courses import (
    CONTACT_GAP,
    COURSE_STEP,
    COURSE_STEPS,
    COURSES,
    MOST_GAP,
    measure_courses,
    tabulate_courses,
)

RADIUS = 0.25
SPEED = 0.5
PLACES = tabulate_courses(RADIUS, SPEED, turn_rate=1.0)


def measure(*movers: tuple[float, ...]) -> Any:
    """Contacts and gaps of all courses, (2, COURSES), among movers of x, y, velocities, radius."""
    out = np.full((2, len(COURSES)), np.nan)
    measure_courses(PLACES, RADIUS, np.reshape(movers, (-1, 5)), out=out.ravel())
    return out


def test_measure_courses_meets_an_object_when_the_discs_touch() -> None:
    """It comes straight at the robot, which drives towards it or stands."""
    contacts, gaps = measure((2.0, 0.0, -0.7, 0.0, 0.2))
    distance = 2.0 - RADIUS - 0.2 - CONTACT_GAP * RADIUS
    for twist, closing in (((1.0, 0.0), 0.7 + SPEED), ((0.0, 0.0), 0.7)):
        course = COURSES.index(twist)
        steps = math.floor(distance / closing / COURSE_STEP)
        assert contacts[course] == pytest.approx(min(steps / COURSE_STEPS, 1.0))
        assert gaps[course] < CONTACT_GAP


def test_measure_courses_ignores_an_object_that_walks_away() -> None:
    near = (0.7, 0.0, 0.0, 0.0, 0.1)
    away = (0.9, 0.0, 2.0, 0.0, 0.1)
    assert measure(near, away).tolist() == measure(near).tolist()
    assert (measure(away)[0] == 1.0).all()
    assert (measure()[1] == MOST_GAP).all()


@pytest.mark.parametrize(("share", "wide"), [(0.5, 0.75), (1.01, None)])
def test_measure_arcs_of_the_wider_footprint(share: float, wide: float | None) -> None:
    outline = make_rectangle(0.5, 0.4)
    radius = outline_radius(outline)
    spots = np.array([[1.0, 0.2 + share * MARGIN * radius]])
    shares = np.empty((2, ARCS))
    measure_arcs(*tabulate_arcs(outline), radius, spots=spots, out=shares.ravel())
    longest = LONGEST_ARC * radius
    ahead = shares[:, CURVATURES.index(0.0)] * radius
    assert ahead == pytest.approx([longest, wide or longest], abs=1e-3)
