"""The planners on the robot's map: what they do before walls, and in worlds of the test split."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.tools.baselines.mapped import points_clearance
from acsar_gym.tools.evaluation import runs
from acsar_gym.worlds.world import Region, World

PLANNERS = ("dwa", "navfn")
CONFIG = RobotConfig.preset("acsar")
BOX = np.array(CONFIG.outline)
SIDES = np.hstack([BOX, np.roll(BOX, -1, axis=0)])


def drive(name: str, goal: tuple[float, float], *walls: list[float], steps: int = 8) -> Any:
    """Commands (steps, 2) [m/s, rad/s] towards a goal, between walls (x1, y1, x2, y2) [m]."""
    policy = runs.load_policy(name, trust=False, env="obstacle_goal")
    segments = np.array(walls).reshape(-1, 4)
    world = World(segments=segments, start=Region(0.0, 0.0, 0.0, 0.0), goal=Region(*goal))
    env = runs.make_env(policy, "planar", None, {"worlds": world})
    seen, _ = env.reset(seed=0)
    policy.reset()
    actions = []
    for _ in range(steps):
        actions.append(policy(seen))
        seen, *_ = env.step(actions[-1])
    env.close()
    return np.array(actions) * (CONFIG.max_linear, CONFIG.max_angular)


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
    outer = math.hypot(*BOX[0])
    free = points_clearance(0.0, 0.0, turned, np.array([point]), SIDES, outer, 1.0)
    assert free == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize("name", PLANNERS)
def test_a_goal_ahead_is_driven_to_straight(name: str) -> None:
    linear, angular = drive(name, (3.0, 0.0))[-1]
    assert linear > 0.8 * CONFIG.max_linear
    assert abs(angular) < 0.3


@pytest.mark.parametrize("name", PLANNERS)
def test_a_goal_behind_is_turned_to(name: str) -> None:
    linear, angular = drive(name, (-2.0, 0.5))[0]
    assert linear < 0.15
    assert angular > 0.1


@pytest.mark.parametrize("name", PLANNERS)
def test_it_doesnt_drive_into_a_wall_that_hides_the_goal(name: str) -> None:
    """The wall is 9 cm ahead of the bumper; its ends are 1 m to the sides."""
    driven = drive(name, (2.0, 0.0), [0.26, -1.0, 0.26, 1.0], steps=3)
    assert driven[:, 0].max() < 0.05


def test_what_was_seen_is_remembered_and_the_scan_counts_once() -> None:
    """A wall to the left, which the robot turns away from: a LiDAR that sees ahead alone."""
    policy: Any = runs.load_policy("navfn", trust=False, env="obstacle_goal")
    wall = np.array([[1.0, -0.5, 1.0, 0.5]])
    world = World(segments=wall, start=Region(0.0, 0.0, 0.0, 0.0), goal=Region(-2.0, 0.0))
    robot = CONFIG.with_(lidar={"rays": 61, "field_of_view": math.pi / 2.0})
    env = runs.make_env(policy, "planar", robot, {"worlds": world})
    seen, _ = env.reset(seed=0)
    for _ in range(20):
        seen, *_ = env.step(np.array([0.0, 1.0], np.float32))
    decoded = policy.setting.seen(seen)
    assert (decoded.ranges < 1.2).sum() == 0
    points = policy.obstacles(policy.map.pose, decoded, 2.0)
    assert len(points) > 5
    assert points[:, 0] == pytest.approx(1.0, abs=0.12)
    assert policy.map.cells_met(0.5).shape == (0, 2)
    assert policy.map.way_ahead[-1, :2] == pytest.approx((-2.0, 0.0))
    env.close()


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
    assert done.summary.success_rate >= 0.8
