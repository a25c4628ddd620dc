"""A task that needs a LiDAR over two real ttys: the board's twin and an RPLIDAR's, in one world."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from processes import first_line
from serial_tools import Emulated, StartEmulator, no_leak

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.guard.shutdown import install_handlers
from acsar_gym.tasks.state import CrowdInfo
from acsar_gym.worlds import Pose, Scene
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import footprint_radius

ENV_ID = "acsar_gym/ObstacleGoal-v1"
WORLD = "clutter:3-3"
FORWARD = np.array([0.4, 0.0], np.float32)
STILL = np.zeros(2, np.float32)


def start(
    start_emulator: StartEmulator, world: str, *options: str
) -> tuple[Emulated, dict[str, Any]]:
    """Start an emulator of both devices. Returns it, and the env's options."""
    emulated = start_emulator("--world", world, "--lidar", *options)
    line = first_line(emulated.process)
    assert line.startswith("serving a LiDAR on /dev/")
    lidar = f"rplidar://{line.split(' ')[-1]}"
    return emulated, {"link": emulated.device, "lidar": lidar, "worlds": world}


@pytest.fixture
def patient(config: RobotConfig) -> RobotConfig:
    """A robot whose LiDAR may be late, on a busy machine."""
    return config.with_(lidar={"noise": 0.0, "timeout": 5.0})


def assert_seen(observation: Any, config: RobotConfig, pose: Pose) -> None:
    """The ranges are those of a simulation. Rays at the edge of an obstacle may meet it or not."""
    world = Pool.of(WORLD, None, footprint_radius(config))[3]
    with Robot(open_link("planar", config), config, ["lidar"]) as robot:
        robot.reset(Scene(start=pose, world=world), np.random.default_rng(0))
        errors = np.abs(observation[-config.lidar.rays :] - robot.read()) * config.lidar.max_range
    assert np.median(errors) < 0.05
    assert np.mean(errors < 0.15) > 0.8


def test_lidar_over_a_tty_sees_what_the_simulation_sees(
    start_emulator: StartEmulator, patient: RobotConfig
) -> None:
    emulated, options = start(start_emulator, WORLD)
    install_handlers()  # the pipe that a program's first link opens stays open
    with no_leak():
        env = gymnasium.make(ENV_ID, robot=patient, **options)
        first, info = env.reset(seed=0)
        begun = emulated.poses()[0]
        assert_seen(first, patient, begun)
        for _ in range(10):
            env.step(FORWARD)
        while not emulated.stands():
            env.step(STILL)

        stop = time.monotonic()
        while time.monotonic() - info.get("scan_age", 5.0) < stop + 2.0 / patient.lidar.rate:
            last, *_, info = env.step(STILL)
        env.close()
        del env
    pose = emulated.poses()[-1]
    assert math.dist(pose[:2], begun[:2]) > 0.1
    assert_seen(last, patient, pose)
    assert 0.0 <= info["scan_age"] < 5.0
    assert np.isnan(info["true_x"])


def test_movers_are_seen_over_a_tty(start_emulator: StartEmulator, patient: RobotConfig) -> None:
    """Rays see them walk by. How near they came only the emulator knows."""
    emulated, options = start(start_emulator, "crowd:9-9", "--key", "0.3")
    env = gymnasium.make(ENV_ID, robot=patient, **options)
    observation, info = env.reset(seed=0)
    ranges = []
    for _ in range(20):
        ranges.append(observation[-patient.lidar.rays :] * patient.lidar.max_range)
        observation, *_, info = env.step(STILL)
    env.close()
    assert all(np.isnan(info[key]) for key in CrowdInfo._fields)
    assert np.ptp(ranges, axis=0).max() > 1.0
    assert not any("hit" in event for event in emulated.events())


def test_replay_of_two_devices_is_the_same_bit_for_bit(
    start_emulator: StartEmulator, patient: RobotConfig, tmp_path: Path
) -> None:
    _, devices = start(start_emulator, WORLD)
    tape = tmp_path / "tape.mcap"

    def drive(**options: Any) -> list[bytes]:
        env = gymnasium.make(ENV_ID, robot=patient, **options)
        observation, info = env.reset(seed=0)
        results = []
        for step in range(12):
            assert info["scan_age"] >= 0.0
            results.append(observation.tobytes() + repr(info).encode())
            action = np.array([0.3, (-1.0) ** (step // 4)], np.float32)
            observation, *_, info = env.step(action)
        env.close()
        return results

    driven = drive(**devices, record=tape)
    assert drive(link=f"replay:{tape}", worlds=WORLD) == driven
