"""The planners on the robot's map: what they do before walls, and in worlds of the test split."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.errors import PolicyError
from acsar_gym.tools import baselines
from acsar_gym.tools.baselines.mapped import points_clearance
from acsar_gym.tools.evaluation import runs
from acsar_gym.worlds.movers import walk
from acsar_gym.worlds.world import Region, World

PLANNERS = ("dwa", "dwa_movers", "navfn", "orca", "orca_true")
CONFIG = RobotConfig.preset("acsar")
BOX = np.array(CONFIG.outline)
SIDES = np.hstack([BOX, np.roll(BOX, -1, axis=0)])


def drive(name: str, goal: tuple[float, float], *walls: list[float], steps: int = 8) -> Any:
    """Commands (steps, 2) [m/s, rad/s] towards a goal, between walls (x1, y1, x2, y2) [m]."""
    policy = runs.load_policy(name, trust=False, env="obstacle_goal")
    segments = np.array(walls).reshape(-1, 4)
    world = World(segments=segments, start=Region(0.0, 0.0, 0.0, 0.0), goal=Region(*goal))
    env = runs.make_env(policy, "planar", None, {"worlds": world})
    observation, _ = env.reset(seed=0)
    policy.reset()
    actions = []
    for _ in range(steps):
        actions.append(policy(observation))
        observation, *_ = env.step(actions[-1])
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
def test_points_clearance_of_the_rectangle(
    point: tuple[float, float], turned: float, wanted: float
) -> None:
    outer = math.hypot(*BOX[0])
    free = points_clearance((0.0, 0.0, turned), np.array([point]), SIDES, outer, 1.0)
    assert free == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize("name", PLANNERS)
def test_planners_drive_straight_to_a_goal_ahead(name: str) -> None:
    linear, angular = drive(name, (3.0, 0.0))[-1]
    assert linear > 0.8 * CONFIG.max_linear
    assert abs(angular) < 0.3


@pytest.mark.parametrize("name", PLANNERS)
def test_planners_dont_drive_into_a_wall_that_hides_the_goal(name: str) -> None:
    """The wall is 9 cm ahead of the bumper. Its ends are 1 m to the sides."""
    driven = drive(name, (2.0, 0.0), [0.26, -1.0, 0.26, 1.0], steps=3)
    assert driven[:, 0].max() < 0.1


def test_obstacles_are_remembered() -> None:
    """A wall to the left, which the robot turns away from: a LiDAR that sees ahead alone."""
    policy: Any = runs.load_policy("navfn", trust=False, env="obstacle_goal")
    wall = np.array([[1.0, -0.5, 1.0, 0.5]])
    world = World(segments=wall, start=Region(0.0, 0.0, 0.0, 0.0), goal=Region(-2.0, 0.0))
    robot = CONFIG.with_(lidar={"rays": 61, "field_of_view": math.pi / 2.0})
    env = runs.make_env(policy, "planar", robot, {"worlds": world})
    observation, _ = env.reset(seed=0)
    for _ in range(20):
        observation, *_ = env.step(np.array([0.0, 1.0], np.float32))

    decoded = policy.setting.seen(observation)
    assert (decoded.ranges < 1.2).sum() == 0
    points = policy.obstacles(policy.map.pose, decoded, 2.0)
    assert len(points) > 5
    assert points[:, 0] == pytest.approx(1.0, abs=0.12)
    assert policy.map.cells_met(0.5).shape == (0, 2)
    assert policy.map.way_ahead[-1, :2] == pytest.approx((-2.0, 0.0))
    env.close()


def cross(name: str) -> Any:
    """Drive a Jackal to a goal 4 m ahead, across whose way two walk: info of the last step."""
    movers = (walk([[1.2, -1.5], [1.2, 2.5]], 0.8), walk([[2.6, 3.0], [2.6, -3.0]], 0.6))
    world = World(start=Region(0.0, 0.0, 0.0, 0.0), goal=Region(4.0, 0.0), movers=movers)
    policy = runs.load_policy(name, trust=False, env="obstacle_goal")
    env = runs.make_env(policy, "planar", "jackal", {"worlds": world})
    observation, info = env.reset(seed=0)
    policy.reset()
    done = False
    while not done:
        observation, _, terminated, truncated, info = env.step(policy(observation))
        done = terminated or truncated
    env.close()
    return info


@pytest.mark.parametrize("name", ["dwa_movers", "orca", *baselines.PRIVILEGED_BASELINES])
def test_planners_let_walkers_pass(name: str) -> None:
    assert cross(name)["is_success"] == 1.0


@pytest.mark.parametrize("name", baselines.PRIVILEGED_BASELINES)
def test_privileged_baselines_need_a_simulator(name: str) -> None:
    policy: Any = runs.load_policy(name, trust=False, env="obstacle_goal")
    real = SimpleNamespace(robot=SimpleNamespace(link=SimpleNamespace(truth=None)))
    with pytest.raises(PolicyError, match="knows what only a simulator does"):
        policy.watch(real)
    done = runs.evaluate_policy(
        policy, "planar", None, range(1), worlds="clutter:1", difficulty=0.0
    )
    assert done.header["policy"]["privileged"]
    assert "knows what only a simulator does" in done.notes[0]


def test_obstacles_without_scans_of_a_mover() -> None:
    policy: Any = runs.load_policy("dwa_movers", trust=False, env="obstacle_goal")
    world = World(
        np.array([[1.0, 1.0, 0.2]]),
        start=Region(0.0, 0.0, 0.0, 0.0),
        goal=Region(4.0, 0.0),
        movers=(walk([[1.5, -0.5]]),),
    )
    env = runs.make_env(policy, "planar", None, {"worlds": world})
    observation, _ = env.reset(seed=0)

    decoded = policy.setting.seen(observation)
    every = policy.obstacles(policy.map.pose, decoded, 3.0)
    without_mover = policy.obstacles(
        policy.map.pose, decoded, 3.0, np.array([[1.5, -0.5, 0, 0, 0.25]])
    )
    distances = np.hypot(*(every - (1.5, -0.5)).T)
    assert 0 < len(without_mover) < len(every)
    assert len(without_mover) == (distances > 0.4).sum()
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANNERS)
@pytest.mark.parametrize("env", ["obstacle_goal", "barn"])
def test_planners_cross_unseen_worlds(name: str, env: str) -> None:
    policy = runs.load_policy(name, trust=False, env=env)
    done = runs.evaluate_policy(policy, "planar", None, range(10))
    assert done.summary.success_rate >= 0.8
