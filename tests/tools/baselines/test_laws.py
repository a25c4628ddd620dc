"""Baselines without a map: laws to a point, trackers of a path, random actions, and gaps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from baseline_tools import CONFIG, equipped, goal_seen, path_seen

from acsar_gym.tasks.state import Floats
from acsar_gym.tools.baselines.follow_gap import choose_course
from acsar_gym.tools.baselines.goal_laws import curvature_to

TO_A_GOAL = ("turn_drive", "smooth")
TRACKERS = ("pure_pursuit", "stanley")
AHEAD = np.column_stack([0.25 * np.arange(1, 5), np.zeros(4)])


def arc(radius: float) -> Floats:
    """(4, 2): points of a circle to the left that begins at the origin, 0.25 m apart [m]."""
    turned = 0.25 * np.arange(1, 5) / radius
    points: Floats = radius * np.column_stack([np.sin(turned), 1.0 - np.cos(turned)])
    return points


@pytest.mark.parametrize("name", TO_A_GOAL)
def test_a_goal_ahead_is_driven_to_at_full_speed(name: str) -> None:
    assert equipped(name).act(goal_seen(2.0, 0.0)) == pytest.approx((CONFIG.max_linear, 0.0))


@pytest.mark.parametrize("name", TO_A_GOAL)
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_goal_behind_is_turned_to(name: str, side: float) -> None:
    linear, angular = equipped(name).act(goal_seen(-0.3, side * 0.01))
    assert linear < 0.05
    assert angular * side > 0.1


def test_the_smooth_law_has_the_papers_curvature() -> None:
    """With theta = 0: -(k2 delta + (1 + k1) sin delta) / r for k1 = 1, k2 = 3."""
    wanted = (3.0 * 0.4 + 2.0 * math.sin(0.4)) / 2.0
    assert curvature_to(2.0, 0.4) == pytest.approx(wanted)


@pytest.mark.parametrize("name", TRACKERS)
def test_a_straight_path_is_followed_straight(name: str) -> None:
    linear, angular = equipped(name).act(path_seen(AHEAD))
    assert (linear, angular) == pytest.approx((CONFIG.max_linear, 0.0))


@pytest.mark.parametrize("name", TRACKERS)
def test_beside_a_path_it_steers_back(name: str) -> None:
    linear, angular = equipped(name).act(path_seen(AHEAD - (0.0, 0.1), cross_track=0.1))
    assert linear > 0.0
    assert angular < -0.1


def test_pure_pursuit_drives_the_arc_that_the_path_is() -> None:
    """But for the straight pieces between the observed points, which lie within the circle."""
    linear, angular = equipped("pure_pursuit").act(path_seen(arc(1.0)))
    assert angular / linear == pytest.approx(1.0, rel=0.15)


def test_stanleys_front_axle_is_on_the_arc() -> None:
    linear, angular = equipped("stanley").act(path_seen(arc(1.0)))
    assert angular / linear == pytest.approx(1.0, rel=0.35)


@pytest.mark.parametrize("name", TRACKERS)
def test_a_path_that_leads_back_is_turned_to(name: str) -> None:
    linear, angular = equipped(name).act(path_seen(-AHEAD + (0.0, 0.05), 0.05, -math.pi + 0.2))
    assert linear == 0.0
    assert abs(angular) == CONFIG.max_angular


def test_random_actions_fill_the_action_space() -> None:
    policy = equipped("random")
    drawn = np.array([policy.act(goal_seen(1.0, 0.0)) for _ in range(1000)])
    top = np.array([CONFIG.max_linear, CONFIG.max_angular])
    assert (np.abs(drawn) <= top).all()
    assert drawn.min(axis=0) == pytest.approx(-top, rel=0.05)
    assert drawn.max(axis=0) == pytest.approx(top, rel=0.05)


RADIUS, REACH, WEIGHT = 0.28, 1.5, 0.35


def ring(*openings: tuple[float, float]) -> Floats:
    """Points around the robot, 1 m away, except within (centre, half width) [rad]."""
    angles = np.linspace(-math.pi, math.pi, 120, endpoint=False)
    for centre, half in openings:
        angles = angles[np.abs(angles - centre) > half]
    points: Floats = np.column_stack([np.cos(angles), np.sin(angles)])
    return points


@pytest.mark.parametrize(("bearing", "wanted"), [(0.2, 1.0), (-0.2, -1.5)])
def test_the_gap_nearest_to_the_goal_is_taken(bearing: float, wanted: float) -> None:
    """Its centre is 1.0 or -1.5 rad; the course lies between it and the goal."""
    points = ring((1.0, 0.5), (-1.5, 1.2))
    course, nearest = choose_course(points, RADIUS, bearing, REACH, WEIGHT)
    assert nearest == pytest.approx(1.0)
    assert min(bearing, wanted) < course < max(bearing, wanted)


def test_a_gap_that_is_too_narrow_is_none_and_an_open_floor_is_one() -> None:
    points = ring((0.0, 0.2), (2.0, 0.8))
    course, _ = choose_course(points, RADIUS, 0.0, REACH, WEIGHT)
    assert course > 0.3
    assert choose_course(np.zeros((0, 2)), RADIUS, 0.7, REACH, WEIGHT) == (0.7, math.inf)


def test_it_turns_away_from_a_wall_ahead() -> None:
    linear, angular = equipped("follow_gap").act(goal_seen(3.0, 0.1, walls=((0.0, 0.5),)))
    assert linear < CONFIG.max_linear
    assert abs(angular) > 0.5
