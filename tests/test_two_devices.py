"""A task that needs a LiDAR over two real ttys: the board's twin and an RPLIDAR's, in one world."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from serial_tools import StartEmulator, cli, no_leak

from acsar_gym import RobotConfig
from acsar_gym.errors import LidarError

ENV_ID = "acsar_gym/ObstacleGoal-v0"
WORLD = "clutter:3-3"
FORWARD = np.array([0.4, 0.0], np.float32)


@pytest.fixture
def devices(start_emulator: StartEmulator) -> tuple[str, str]:
    """The robot's device and the LiDAR's."""
    emulated = start_emulator("--world", WORLD, "--lidar")
    assert emulated.process.stdout is not None
    line = emulated.process.stdout.readline().strip()
    assert line.startswith("serving a LiDAR on /dev/")
    return emulated.device, line.split(" ")[-1]


def simulated(config: RobotConfig, steps: int) -> tuple[Any, Any]:
    """Observations of the planar env in the same world."""
    env = gymnasium.make(ENV_ID, link="planar", worlds=WORLD, robot=config)
    first, _ = env.reset(seed=0)
    for _ in range(steps):
        last, *_ = env.step(FORWARD)
    env.close()
    return first, last


def test_hardware_sees_what_the_simulation_sees(
    devices: tuple[str, str], config: RobotConfig
) -> None:
    config = config.with_(lidar={"noise": 0.0, "timeout": 5.0})
    port, lidar = devices
    with no_leak():
        env = gymnasium.make(
            ENV_ID, link=port, lidar=f"rplidar://{lidar}", worlds=WORLD, robot=config
        )
        first, info = env.reset(seed=0)
        for _ in range(10):
            last, *_, info = env.step(FORWARD)
        env.close()
        del env
    for seen, expected in zip((first, last), simulated(config, 10), strict=True):
        # Rays at the edge of an obstacle may meet it or not, and a moving scan is a turn old.
        errors = np.abs(seen[7:] - expected[7:]) * config.lidar.max_range
        assert np.median(errors) < 0.05
        assert np.mean(errors < 0.15) > 0.8
        assert seen[:3] == pytest.approx(expected[:3], abs=0.02)
    assert 0.0 <= info["scan_age"] < 5.0
    assert np.isnan(info["true_x"])


def test_a_lidar_that_is_none_is_one_clear_error(devices: tuple[str, str]) -> None:
    port, _ = devices
    env = gymnasium.make(ENV_ID, link=port, lidar="rplidar:///dev/no-such-lidar", worlds=WORLD)
    with pytest.raises(LidarError, match="/dev/no-such-lidar") as caught:
        env.reset(seed=0)
    assert "\n" not in str(caught.value)
    env.close()


def test_the_command_line_evaluates_over_both(devices: tuple[str, str], tmp_path: Path) -> None:
    port, lidar = devices
    goal, policy = ("0.5", "0.0"), ("--policy", "obstacle_goal")
    options = ("--link", port, "--lidar", f"rplidar://{lidar}", "--json", tmp_path / "run.json")
    done = cli("run", *goal, *policy, *options)
    assert done.returncode in (0, 1), done.stderr
    assert "behind the wire" in done.stdout
    assert (tmp_path / "run.json").exists()
