"""Odometry that turns as far as scans say."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import ConfigError
from acsar_gym.physics.model import turn_factor
from acsar_gym.worlds import Scene, World
from acsar_gym.worlds.world import make_rectangle, to_odometry

ROOM = World(
    circles=np.array([(1.2, 0.9, 0.2), (-0.9, 1.1, 0.3), (0.3, -1.2, 0.15)]),
    segments=np.array([*make_rectangle(-2.0, -1.6, 2.4, 1.8), (-2.0, 0.4, -1.2, 0.4)]),
)
START = (0.1, -0.2, 0.4)
ROBOTS = {
    "acsar": RobotConfig.preset("acsar"),
    "a narrow view": RobotConfig.preset("acsar").with_(
        lidar={"field_of_view": 4.0, "rays": 81}, lidar_x_offset=0.12, lidar_y_offset=-0.07
    ),
    "a slow head": RobotConfig.preset("acsar").with_(lidar={"rate": 5.0, "rays": 180}),
}


def drive(
    config: RobotConfig, twist: tuple[float, float], seconds: float = 3.0, *, correct: bool = True
) -> tuple[Robot, tuple[float, float, float]]:
    """Drive in the room, an env step after the other; returns the robot and where it truly is."""
    link = open_link("planar", config)
    with Robot(link, config, ["lidar"], correct_turns=correct) as robot:
        robot.reset(Scene(START, None, ROOM))
        for tick in range(round(seconds / config.period)):
            robot.drive(*twist)
            if tick % 10 == 9:
                robot.read()
        assert link.truth is not None
        return robot, to_odometry(START, link.truth.pose)


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("factor", [0.6, 0.75, 1.3, 1.6])
def test_scans_say_how_far_it_turns(name: str, factor: float) -> None:
    config = ROBOTS[name]
    unmeasured = config.with_(wheel_separation_multiplier=turn_factor(config) * factor)
    robot, (x, y, theta) = drive(unmeasured, (0.3, 0.8))
    assert robot.odometry.turn_factor == pytest.approx(factor, rel=0.02)
    assert math.dist(robot.odometry.pose[:2], (x, y)) < 0.04
    assert abs(math.remainder(robot.odometry.pose[2] - theta, math.tau)) < 0.05
    uncorrected, _ = drive(unmeasured, (0.3, 0.8), correct=False)
    assert math.dist(uncorrected.odometry.pose[:2], (x, y)) > 0.2
    assert abs(math.remainder(uncorrected.odometry.pose[2] - theta, math.tau)) > 0.5


@pytest.mark.parametrize("name", ROBOTS)
def test_a_small_error_shows_after_more_pairs(name: str) -> None:
    config = ROBOTS[name]
    unmeasured = config.with_(wheel_separation_multiplier=turn_factor(config) * 0.95)
    assert drive(unmeasured, (0.3, 0.8), 1.0)[0].odometry.turn_factor == 1.0
    assert drive(unmeasured, (0.3, 0.8), 6.0)[0].odometry.turn_factor == pytest.approx(0.95, 0.01)


def test_weak_evidence_does_not_add_up_for_ever() -> None:
    config = ROBOTS["acsar"]
    unmeasured = config.with_(wheel_separation_multiplier=turn_factor(config) * 0.97)
    assert drive(unmeasured, (0.3, 0.8), 30.0)[0].odometry.turn_factor == 1.0


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("twist", [(0.1, 0.8), (0.0, -1.5), (0.2, 0.0)])
def test_nothing_changes_for_a_calibrated_robot(name: str, twist: tuple[float, float]) -> None:
    config = ROBOTS[name]
    config = config.with_(wheel_separation_multiplier=turn_factor(config))
    corrected, plain = (drive(config, twist, correct=correct)[0] for correct in (True, False))
    assert corrected.odometry.turn_factor == 1.0
    assert corrected.odometry.pose == plain.odometry.pose


def test_nothing_changes_without_turning() -> None:
    config = ROBOTS["acsar"].with_(wheel_separation_multiplier=2.1)
    robot, _ = drive(config, (0.2, 0.0), 5.0)
    assert robot.odometry.turn_factor == 1.0


def test_an_episode_knows_nothing_of_the_one_before() -> None:
    config = ROBOTS["acsar"].with_(wheel_separation_multiplier=2.1)
    robot, _ = drive(config, (0.1, 0.8))
    assert robot.odometry.turn_factor != 1.0
    robot.reset(Scene(START, None, ROOM))
    assert robot.odometry.turn_factor == 1.0
    for _ in range(8):  # too few scans to be sure
        for _ in range(10):
            robot.drive(0.1, 0.8)
        robot.read()
    assert robot.odometry.turn_factor == 1.0
    robot.close()


def test_it_needs_a_lidar() -> None:
    with pytest.raises(ConfigError, match="correct_turns: the robot has no 'lidar'"):
        Robot(open_link("planar"), correct_turns=True)


def run(env: Any) -> list[float]:
    """Turn for 3 s, and tell the factor and the pose."""
    env.reset(seed=1, options={"goal": (3.0, 0.0)})
    for _ in range(30):
        env.step(np.array([0.1, 0.8], np.float32))
    odometry = env.unwrapped.robot.odometry
    env.close()
    return [odometry.turn_factor, *odometry.pose]


def test_a_copy_and_a_replay_drive_as_the_environment_does(tmp_path: Path) -> None:
    tape, env_id = tmp_path / "drive.mcap", "acsar_gym/ObstacleGoal-v1"
    options: dict[str, Any] = {
        "robot": ROBOTS["acsar"].with_(wheel_separation_multiplier=2.1),
        "worlds": "clutter:0-3",
        "correct_turns": True,
    }
    env = gymnasium.make(env_id, link="planar", **options)
    copied = copy.deepcopy(env.unwrapped)
    driven = run(env)
    assert driven[0] == pytest.approx(2.1 / turn_factor(ROBOTS["acsar"]), rel=0.05)
    assert run(copied) == driven
    assert run(gymnasium.make(env_id, link="planar", record=tape, **options)) == driven
    assert run(gymnasium.make(env_id, link=f"replay:{tape}", **options)) == driven
