"""Faults of links, boards and LiDARs in the env: what ends an episode, and what continues."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from boards import FailingLink

from acsar_gym import RobotConfig, open_link
from acsar_gym.errors import LidarError, LinkError
from acsar_gym.lidar.scan import Revolution
from acsar_gym.worlds import Scene

OBSTACLE_GOAL = "acsar_gym/ObstacleGoal-v1"
TURN = np.array([0.0, 0.2], np.float32)
AHEAD = np.array([1.0, 0.0], np.float32)


@pytest.mark.parametrize(("silent", "code"), [(True, 1.0), (False, 3.0)])
def test_fault_truncates_the_episode_and_the_next_reset_recovers(
    link: str, silent: bool, code: float, make: Any
) -> None:
    env = make(link=FailingLink(open_link(link), 1.0, silent=silent))
    for _ in range(2):
        env.reset(seed=0)
        ends: list[bool] = []
        while not any(ends):
            *_, terminated, truncated, info = env.step(TURN)
            assert not terminated
            ends.append(truncated)
        assert info["fault"] == code
        assert 10 <= len(ends) < 20
        assert not env.unwrapped.robot.active


def test_on_fault_raise(make: Any) -> None:
    env = make(link=FailingLink(open_link("planar"), 0.3), on_fault="raise")
    env.reset(seed=0)
    with pytest.raises(LinkError):
        for _ in range(20):
            env.step(TURN)


class FailingLidar:
    """A LiDAR that falls silent after some scans, all of which are of time 0."""

    def __init__(self, scans: int) -> None:
        self.remaining = scans
        self.closed = False

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Nothing to begin."""

    def scan(self) -> Revolution:
        self.remaining -= 1
        if self.remaining < 0:
            raise LidarError("the LiDAR is silent", "check its cable")
        return Revolution(np.zeros(1), np.ones(1), np.zeros(1), 0.0)

    def close(self) -> None:
        self.closed = True


def test_lidar_that_is_silent_stops_the_robot(make: Any) -> None:
    lidar = FailingLidar(15)
    env = make(OBSTACLE_GOAL, lidar=lidar)
    env.reset(seed=0)
    env.step(AHEAD)
    *result, info = env.step(AHEAD)
    assert (result[1:], info["fault"]) == ([0.0, False, True], 4.0)
    assert "LiDAR" in info["fault_reason"]
    assert not env.unwrapped.robot.active
    with pytest.raises(LinkError, match="reset"):
        env.step(AHEAD)
    env.close()
    assert lidar.closed


def test_lidar_scans_come_at_their_own_rate_and_stale_ones_are_marked(make: Any) -> None:
    quiet = RobotConfig.preset("acsar").with_(lidar={"noise": 0.0, "rate": 4.0})
    env = make(OBSTACLE_GOAL, robot=quiet)
    env.reset(seed=0)
    ages = [env.step(0.0 * AHEAD)[4]["scan_age"] for _ in range(10)]
    assert ages[0] not in (0.0, 0.1)  # the phase is drawn
    assert ages == pytest.approx((ages[0] + 0.1 * np.arange(10)) % 0.25, abs=1e-9)

    env = make(OBSTACLE_GOAL, lidar=FailingLidar(1000))
    env.reset(seed=0)
    assert [env.step(0.0 * AHEAD)[4]["scan_stale"] for _ in range(4)] == [0.0, 1.0, 1.0, 1.0]
