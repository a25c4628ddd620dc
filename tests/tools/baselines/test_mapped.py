"""Odometry, map and plan of the baselines that keep a map, and what they do before walls."""

from __future__ import annotations

import math

import numpy as np
import pytest
from baseline_tools import CONFIG, PERIOD, equipped, goal_seen

from acsar_gym.tools.baselines.mapping import (
    Costmap,
    DeadReckoning,
    MapConstants,
    compute_potential,
    interpolate_field,
    points_clearance,
)
from acsar_gym.tools.evaluation import runs

pytest.importorskip("numba")
PLANNERS = ("dwa", "mppi", "navfn")
BOX = np.array(CONFIG.outline)
SIDES = np.hstack([BOX, np.roll(BOX, -1, axis=0)])
OUTER = math.hypot(*BOX[0])


def test_motion_is_found_from_views_of_the_goal_though_the_velocities_are_biased() -> None:
    rng = np.random.default_rng(0)
    goal = (4.0, -3.0)
    x, y, theta = 0.0, 0.0, 0.0
    motion = DeadReckoning(goal, PERIOD)
    for _ in range(200):
        linear, angular = rng.uniform(-0.1, 0.5), rng.uniform(-1.5, 1.5)
        x += linear * PERIOD * math.cos(theta + angular * PERIOD / 2.0)
        y += linear * PERIOD * math.sin(theta + angular * PERIOD / 2.0)
        theta += angular * PERIOD
        dx, dy, cos, sin = goal[0] - x, goal[1] - y, math.cos(theta), math.sin(theta)
        seen = (dx * cos + dy * sin, dy * cos - dx * sin)
        motion.update(seen, (linear + 0.05, angular + 0.1), 20.0)
    assert motion.pose[:2] == pytest.approx((x, y), abs=0.06)  # 1 m by the velocities alone
    assert motion.pose[2] == pytest.approx(theta, abs=0.02)


@pytest.mark.parametrize(
    ("point", "turned", "wanted"),
    [
        ((1.0, 0.0), 0.0, 0.83),
        ((0.0, 0.1), 0.0, 0.0),
        ((0.47, 0.57), 0.0, 0.5),
        ((9.0, 0.0), 0.0, 1.0),
        ((0.23, 0.0), 0.0, 0.06),
        ((0.23, 0.0), math.pi / 4.0, 0.0),
    ],
)
def test_clearance_is_the_distance_of_the_rectangle(
    point: tuple[float, float], turned: float, wanted: float
) -> None:
    free = points_clearance(0.0, 0.0, turned, np.array([point]), SIDES, OUTER, 1.0)
    assert free == pytest.approx(wanted, abs=1e-9)


def test_the_map_keeps_what_is_behind_and_clears_what_has_gone() -> None:
    known = Costmap((3.0, 0.0))
    end, met = np.array([[1.013, 0.0]]), np.ones(1)
    known.update((0.0, 0.0), end, met)
    assert known.points(0.0, 0.0, 2.0) == pytest.approx(end)
    known.update((0.0, 0.0), np.array([[0.0, 1.0]]), met)  # looks elsewhere
    assert len(known.points(0.0, 0.0, 2.0)) == 2
    for _ in range(100):
        known.update((0.0, 0.0), np.array([[3.0, 0.0]]), np.zeros(1))
    assert known.points(0.0, 0.0, 2.0) == pytest.approx(np.array([[0.0, 1.0]]))


def test_the_potential_of_an_open_floor_is_the_distance_in_every_direction() -> None:
    known = Costmap((3.0, 2.0))
    plan = compute_potential(known, (0.0, 0.0), (3.0, 2.0), (0.17, 0.24), MapConstants())
    for angle in np.linspace(-math.pi, math.pi, 17):
        x, y = 3.0 + 1.4 * math.cos(angle), 2.0 + 1.4 * math.sin(angle)
        left = interpolate_field(plan.values, plan.x, plan.y, x, y)
        assert left == pytest.approx(1.4, rel=0.06)
    way = plan.way(0.0, 0.0, 2.0)
    assert np.abs(way @ (-2.0, 3.0)).max() / math.hypot(2.0, 3.0) < 0.06  # along the straight line


def test_the_plan_leads_around_a_wall() -> None:
    """A wall at x = 1 from y = -3 to y = 0.6: its end is nearest."""
    known = Costmap((2.0, 0.0))
    wall = np.column_stack([np.full(73, 1.0), np.linspace(-3.0, 0.6, 73)])
    known.update((0.0, 0.0), wall, np.ones(len(wall)))
    plan = compute_potential(known, (0.0, 0.0), (2.0, 0.0), (0.17, 0.24), MapConstants())
    way = plan.way(0.0, 0.0, 4.0)
    across = way[np.abs(way[:, 0] - 1.0).argmin()]
    assert 0.84 < across[1] < 1.3
    assert math.dist(way[-1], (2.0, 0.0)) < 0.1


@pytest.mark.parametrize("name", PLANNERS)
def test_a_goal_ahead_is_driven_to_straight(name: str) -> None:
    policy = equipped(name)
    driven = [policy.act(goal_seen(3.0, 0.0, moving=0.5)) for _ in range(8)][-1]
    assert driven[0] > 0.8 * CONFIG.max_linear
    assert abs(driven[1]) < 0.3


@pytest.mark.parametrize("name", PLANNERS)
def test_a_goal_behind_is_turned_to(name: str) -> None:
    policy = equipped(name)
    linear, angular = policy.act(goal_seen(-2.0, 0.5))
    assert linear < 0.15
    assert angular > 0.1


@pytest.mark.parametrize("name", PLANNERS)
def test_it_doesnt_drive_into_a_wall_that_hides_the_goal(name: str) -> None:
    """The wall is 5 cm ahead of the bumper, the robot stands."""
    policy = equipped(name)
    wall = ((0.0, 0.22),)
    driven = [policy.act(goal_seen(2.0, 0.0, wall)) for _ in range(3)]
    assert max(linear for linear, _ in driven) < 0.05


@pytest.mark.parametrize("name", PLANNERS)
def test_the_same_seed_gives_the_same_episode(name: str) -> None:
    def path() -> list[float]:
        policy = runs.load_policy(name, trust=False, env="obstacle_goal")
        done = runs.evaluate_policy(
            policy, "planar", None, range(1), worlds="clutter:1", difficulty=0.0
        )
        results = done.results
        assert results[0].success
        return [results[0].path, results[0].episode_return]

    assert path() == path()


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANNERS)
@pytest.mark.parametrize("env", ["obstacle_goal", "barn"])
def test_unseen_worlds_are_crossed(name: str, env: str) -> None:
    policy = runs.load_policy(name, trust=False, env=env)
    done = runs.evaluate_policy(policy, "planar", None, range(10))
    assert done.summary.success_rate == 1.0
