"""Which gap is followed, and how."""

from __future__ import annotations

import math

import numpy as np
import pytest
from baseline_tools import CONFIG, equipped, goal_seen

from acsar_gym.tools.baselines.follow_gap import choose_course

RADIUS = 0.28


def ring(*openings: tuple[float, float]) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Points around the robot, 1 m away, except within (centre, half width) [rad]."""
    angles = np.linspace(-math.pi, math.pi, 120, endpoint=False)
    for centre, half in openings:
        angles = angles[np.abs(angles - centre) > half]
    return np.column_stack([np.cos(angles), np.sin(angles)])


def test_nothing_around_means_straight_to_the_goal() -> None:
    course, nearest = choose_course(np.zeros((0, 2)), RADIUS, 0.7, 3.0)
    assert (course, nearest) == (0.7, math.inf)


@pytest.mark.parametrize(("bearing", "wanted"), [(0.2, 1.0), (-0.2, -1.5)])
def test_the_gap_nearest_to_the_goal_is_taken(bearing: float, wanted: float) -> None:
    """Its centre is 1.0 or -1.5 rad; the course lies between it and the goal."""
    points = ring((1.0, 0.5), (-1.5, 1.2))
    course, nearest = choose_course(points, RADIUS, bearing, 3.0)
    assert nearest == pytest.approx(1.0)
    assert min(bearing, wanted) < course < max(bearing, wanted)


def test_a_gap_that_is_too_narrow_is_none() -> None:
    points = ring((0.0, 0.2), (2.0, 0.8))
    course, _ = choose_course(points, RADIUS, 0.0, 3.0)
    assert course > 0.3


def test_it_turns_away_from_a_wall_ahead() -> None:
    linear, angular = equipped("follow_gap").act(goal_seen(3.0, 0.1, walls=((0.0, 0.5),)))
    assert linear < CONFIG.max_linear
    assert abs(angular) > 0.5
