"""Courses: where a robot is on them, and whom it meets."""

from __future__ import annotations

import math

import numpy as np
import pytest

from acsar_gym.sensors.map.courses import (
    CONTACT_GAP,
    COURSE_STEP,
    COURSE_STEPS,
    COURSES,
    MOST_GAP,
    measure_courses,
    tabulate_courses,
)

RADIUS, SPEED, TURN_RATE = 0.25, 0.5, 1.0
STRAIGHT, STOP = COURSES.index((1.0, 0.0)), COURSES.index((0.0, 0.0))


def measured(*movers: tuple[float, ...]) -> np.ndarray:
    """Contacts and gaps of all courses, (2, COURSES), among movers of x, y, velocities, radius."""
    out = np.full(2 * len(COURSES), np.nan)
    places = tabulate_courses(RADIUS, SPEED, TURN_RATE)
    measure_courses(places, RADIUS, np.reshape(movers, (-1, 5)), out)
    return out.reshape(2, -1)


@pytest.mark.parametrize("course", range(len(COURSES)))
def test_a_course_is_driven_with_a_constant_twist(course: int) -> None:
    """Small steps of an odometry arrive where the table says."""
    share, curvature = COURSES[course]
    linear = share * SPEED
    angular = linear * curvature / RADIUS
    slower = min(1.0, TURN_RATE / max(abs(angular), 1e-9))
    linear, angular = linear * slower, angular * slower
    x = y = theta = 0.0
    places = tabulate_courses(RADIUS, SPEED, TURN_RATE)[course]
    for row in places:
        for _ in range(2000):
            step = COURSE_STEP / 2000
            x += step * linear * math.cos(theta + 0.5 * step * angular)
            y += step * linear * math.sin(theta + 0.5 * step * angular)
            theta += step * angular
        assert row == pytest.approx([x, y], abs=1e-6)


def test_nobody_is_met_where_nobody_is() -> None:
    contacts, gaps = measured()
    assert (contacts == 1.0).all()
    assert (gaps == MOST_GAP).all()


def test_who_comes_is_met_when_the_discs_touch() -> None:
    """Somebody comes straight at the robot, which drives towards it or stands."""
    radius, coming, ahead = 0.2, 0.7, 2.0
    contacts, gaps = measured((ahead, 0.0, -coming, 0.0, radius))
    apart = ahead - RADIUS - radius - CONTACT_GAP * RADIUS
    steps = {STRAIGHT: apart / (coming + SPEED), STOP: apart / coming}
    for course, time in steps.items():
        expected = math.floor(time / COURSE_STEP) / COURSE_STEPS
        assert contacts[course] == pytest.approx(min(expected, 1.0))
        assert gaps[course] < CONTACT_GAP
    assert (contacts >= contacts[STRAIGHT]).all()


def test_left_and_right_are_mirror_images() -> None:
    mover = (0.8, 0.5, -0.3, -0.4, 0.2)
    image = (0.8, -0.5, -0.3, 0.4, 0.2)
    pairs = [COURSES.index((share, -curvature)) for share, curvature in COURSES]
    np.testing.assert_allclose(measured(mover)[:, pairs], measured(image), rtol=0.0, atol=1e-12)


def test_who_is_far_or_walks_away_counts_less_than_who_is_near() -> None:
    near = (0.7, 0.0, 0.0, 0.0, 0.1)
    away = (0.9, 0.0, 2.0, 0.0, 0.1)
    assert measured(near, away).tolist() == measured(near).tolist()
    assert measured(away)[0].min() == 1.0
