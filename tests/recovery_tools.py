"""What is asked of a board whose cable is pulled."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from serial_tools import (
    Emulated,
    wait_until,
)

from acsar_gym import Robot, RobotConfig
from acsar_gym.envs.base import RobotEnv
from acsar_gym.protocol import Decoder

CURVE = np.array([0.1, 0.1], np.float32)

Step = tuple[Any, float, bool, bool, dict[str, Any]]


def name(emulator: Emulated) -> str:
    return str(emulator.log.with_name("usb-acsar"))


def made(emulator: Emulated, config: RobotConfig, **options: Any) -> Any:
    options = {"max_episode_steps": 10**6} | options
    device = name(emulator)
    return gymnasium.make("acsar_gym/PointGoal-v0", link=device, robot=config, **options)


def robot_of(env: Any) -> Robot:
    assert isinstance(env.unwrapped, RobotEnv)
    return env.unwrapped.robot


def step_until_fault(env: Any) -> Step:
    """The step that a fault ends."""
    for _ in range(200):
        result: Step = env.step(CURVE)
        if result[3]:
            return result
    raise AssertionError("no fault")


def drives(emulator: Emulated) -> None:
    wait_until(emulator.is_driven, "a command that turns the wheels")


def spoken(emulator: Emulated) -> set[Any]:
    """The commands since the cable was plugged in."""
    return {reading.speeds for reading in Decoder().feed(emulator.since_plugged())}
