"""Episodes in worlds that don't move: the robot begins at the scene's start."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym.envs.base import RobotEnv
from acsar_gym.worlds import Region, World
from acsar_gym.worlds.world import to_world

START = (5.0, -3.0, 2.0)
PILLAR = World(
    circles=np.array([[*to_world(START, (1.5, 0.0, 0.0))[:2], 0.1]]),
    start=Region(*START[:2], 0.0, START[2]),
    goal=Region(*to_world(START, (3.0, 1.0, 0.0))[:2]),
    name="pillar",
)
AHEAD = np.array([1.0, 0.0], np.float32)
LINKS = ["bullet", "planar"]


def make(link: str, **options: Any) -> Any:
    robot = {"lidar": {"noise": 0.0}}
    return gymnasium.make(
        "acsar_gym/ObstacleGoal-v1", link=link, robot=robot, worlds=PILLAR, **options
    )


def driven(env: Any) -> list[bytes]:
    """What is seen on the way to the pillar."""
    seen = [env.reset(seed=0)[0].tobytes()]
    for _ in range(60):
        observation, _, over, _, _ = env.step(AHEAD)
        seen.append(observation.tobytes())
        if over:
            break
    return seen


@pytest.mark.parametrize("link", LINKS)
def test_info_is_told_in_the_odometry_frame(link: str) -> None:
    env = make(link)
    inner: RobotEnv = env.unwrapped
    _, info = env.reset(seed=0)
    assert (info["true_x"], info["true_y"], info["true_theta"]) == pytest.approx((0, 0, 0))
    assert info["true_goal_distance"] == pytest.approx(math.hypot(3.0, 1.0))
    truth = inner.robot.link.truth
    assert truth is not None
    assert truth.pose == pytest.approx(START, abs=1e-9)
    for _ in range(10):
        observation, *_, info = env.step(AHEAD)
    true = tuple(info[f"true_{name}"] for name in ("x", "y", "theta"))
    assert true[0] > 0.2
    assert info["odometry_error"] < 0.05
    truth = inner.robot.link.truth
    assert truth is not None
    assert to_world(START, true)[:2] == pytest.approx(truth.pose[:2])
    lidar = inner.robot.config.lidar_x_offset
    ahead = observation[10 + 32] * inner.robot.config.lidar.max_range
    assert ahead == pytest.approx(1.4 - true[0] - lidar, abs=0.02)
    env.close()


@pytest.mark.parametrize("link", LINKS)
def test_a_world_that_was_hit_leaves_no_trace(link: str) -> None:
    """PyBullet keeps what stands still as long as the world is the same."""
    env = make(link)
    first = driven(env)
    statics = getattr(env.unwrapped.robot.link.body, "_statics", None)
    assert len(first) < 60, "the pillar was hit"
    assert driven(env) == first
    assert getattr(env.unwrapped.robot.link.body, "_statics", None) is statics
    env.close()


def test_a_picture_shows_the_world_as_it_is() -> None:
    env = make("planar", render_mode="rgb_array")
    env.reset(seed=0)
    env.step(AHEAD)
    env.render()
    top = env.unwrapped._screen._top
    assert top.view.up == "y"
    for place in (START[:2], PILLAR.circles[0, :2], (PILLAR.goal.x, PILLAR.goal.y)):
        assert top.view.shows(*place, 0.0)
    layers = top.layers
    env.reset(seed=1)
    env.render()
    assert top.layers == layers, "the same world isn't drawn again"
    env.close()
