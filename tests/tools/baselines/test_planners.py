"""The planners on the robot's map: what they do before walls, and in worlds of the test split."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.errors import PolicyError
from acsar_gym.tools.baselines.mapped import Footprint, footprint_clearance
from acsar_gym.tools.evaluation import runs
from acsar_gym.worlds.movers import walk
from acsar_gym.worlds.world import Region, World

PLANNERS = ("dwa", "dwa_movers", "navfn", "orca", "orca_true")
CONFIG = RobotConfig.preset("acsar")
START = Region(0.0, 0.0, 0.0, 0.0)


def load(name: str) -> Any:
    return runs.load_policy(name, trust=False, env="obstacle_goal")


def open_env(name: str, world: World, robot: Any = None) -> tuple[Any, Any, Any]:
    """A planner, its env in a world, and the first observation."""
    policy = load(name)
    env = runs.make_env(policy, "planar", robot, {"worlds": world})
    observation, _ = env.reset(seed=0)
    policy.reset()
    return policy, env, observation


def drive(name: str, goal: tuple[float, float], *walls: list[float], steps: int = 8) -> Any:
    """Commands (steps, 2) [m/s, rad/s] towards a goal, between walls (x1, y1, x2, y2) [m]."""
    segments = np.array(walls).reshape(-1, 4)
    world = World(segments=segments, start=START, goal=Region(*goal))
    policy, env, observation = open_env(name, world)
    actions = []
    for _ in range(steps):
        actions.append(policy(observation))
        observation, *_ = env.step(actions[-1])
    env.close()
    return np.array(actions) * (CONFIG.max_linear, CONFIG.max_angular)


BOX = [(-0.17, -0.13), (0.17, -0.13), (0.17, 0.13), (-0.17, 0.13)]
TRIANGLE = [(-0.1, -0.1), (0.2, 0.0), (-0.1, 0.1)]


@pytest.mark.parametrize(
    ("outline", "point", "turned", "wanted"),
    [
        (BOX, (0.0, 0.1), 0.0, 0.0),
        (BOX, (0.47, 0.53), 0.0, 0.5),
        (BOX, (9.0, 0.0), 0.0, 1.0),
        (BOX, (0.0, -0.47), math.pi / 2.0, 0.3),
        (TRIANGLE, (-0.4, 0.05), 0.0, 0.3),
    ],
)
def test_footprint_clearance(
    outline: Any, point: tuple[float, float], turned: float, wanted: float
) -> None:
    sides = np.hstack([outline, np.roll(outline, -1, axis=0)])
    footprint = Footprint(sides, outer=0.22)
    free = footprint_clearance((0.0, 0.0, turned), np.array([point]), footprint, 1.0)
    assert free == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize("name", PLANNERS)
def test_planners_drive_straight_to_a_goal_ahead(name: str) -> None:
    linear, angular = drive(name, (3.0, 0.0))[-1]
    assert linear > 0.8 * CONFIG.max_linear
    assert abs(angular) < 0.3


@pytest.mark.parametrize(("name", "share"), [("dwa", 1.0), ("navfn", 0.01), ("orca", 0.2)])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_planners_turn_to_a_goal_beside_them(name: str, share: float, side: float) -> None:
    """On the spot, but for the planner that drives an arc."""
    linear, angular = drive(name, (-0.2, 2.0 * side), steps=3)[-1]
    assert abs(linear) <= share * CONFIG.max_linear
    assert angular * side > 0.3


@pytest.mark.parametrize("name", PLANNERS)
def test_planners_dont_drive_into_a_wall_that_hides_the_goal(name: str) -> None:
    """The wall is 9 cm ahead of the bumper. Its ends are 1 m to the sides."""
    driven = drive(name, (2.0, 0.0), [0.26, -1.0, 0.26, 1.0], steps=3)
    assert driven[:, 0].max() < 0.1


def test_obstacles_are_remembered() -> None:
    """A wall to the left, which the robot turns away from: a LiDAR that sees ahead alone."""
    world = World(segments=np.array([[1.0, -0.5, 1.0, 0.5]]), start=START, goal=Region(-2.0, 0.0))
    robot = CONFIG.with_(lidar={"rays": 61, "field_of_view": math.pi / 2.0})
    policy, env, _ = open_env("navfn", world, robot)
    for _ in range(20):
        observation, *_ = env.step(np.array([0.0, 1.0], np.float32))

    decoded = policy.setting.seen(observation)
    assert (decoded.ranges < 1.2).sum() == 0
    points = policy.obstacles(policy.map.pose, decoded, 2.0)
    assert len(points) > 5
    assert points[:, 0] == pytest.approx(1.0, abs=0.12)
    env.close()


@pytest.mark.parametrize("name", ["dwa_movers", "orca", "orca_true"])
def test_planners_let_walkers_pass(name: str) -> None:
    """A Jackal drives to a goal 4 m ahead, across whose way two walk."""
    movers = (walk([[1.2, -1.5], [1.2, 2.5]], 0.8), walk([[2.6, 3.0], [2.6, -3.0]], 0.6))
    world = World(start=START, goal=Region(4.0, 0.0), movers=movers)
    done = runs.evaluate_policy(load(name), "planar", "jackal", range(1), worlds=world)
    assert done.results[0].success


def test_privileged_baselines_need_a_simulator() -> None:
    policy = load("orca_true")
    real = SimpleNamespace(robot=SimpleNamespace(link=SimpleNamespace(truth=None)))
    with pytest.raises(PolicyError, match="knows what only a simulator does"):
        policy.watch(real)
    options: dict[str, Any] = {"worlds": "clutter:1", "difficulty": 0.0}
    done = runs.evaluate_policy(policy, "planar", None, range(1), **options)
    assert done.header["policy"]["privileged"]
    assert "knows what only a simulator does" in done.notes[0]


def test_obstacles_without_scans_of_a_mover() -> None:
    pillar = np.array([[1.0, 1.0, 0.2]])
    movers = (walk([[1.5, -0.5]]),)
    world = World(pillar, start=START, goal=Region(4.0, 0.0), movers=movers)
    policy, env, observation = open_env("dwa_movers", world)

    decoded = policy.setting.seen(observation)
    every = policy.obstacles(policy.map.pose, decoded, 3.0)
    policy.tracks = lambda: np.array([[1.5, -0.5, 0.0, 0.0, 0.25]])
    standing = policy.obstacles(policy.map.pose, decoded, 3.0)
    distances = np.hypot(*(every - (1.5, -0.5)).T)
    assert 0 < len(standing) < len(every)
    assert len(standing) == (distances > 0.4).sum()
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANNERS)
@pytest.mark.parametrize("env", ["obstacle_goal", "barn"])
def test_planners_cross_unseen_worlds(name: str, env: str) -> None:
    policy = runs.load_policy(name, trust=False, env=env)
    done = runs.evaluate_policy(policy, "planar", None, range(10))
    assert done.summary.success_rate >= 0.8
