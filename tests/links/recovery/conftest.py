"""A board on a cable that can be pulled, and what stands on this side of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import yaml
from recovery_tools import CURVE, made, name
from serial_tools import (
    TIMEOUT,
    Emulated,
    no_leak,
    start,
)

from acsar_gym import RobotConfig
from acsar_gym.links import watchdog
from acsar_gym.links.serial import SerialLink
from acsar_gym.worlds import Scene


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulated]:
    """It stops soon without commands, so that the next test needn't wait for it."""
    folder = tmp_path_factory.mktemp("board")
    hasty = RobotConfig.preset("acsar").with_(firmware={"command_timeout": 0.1})
    robot = folder / "robot.yaml"
    robot.write_text(yaml.safe_dump(hasty.model_dump()), encoding="utf-8")
    options = "--name", str(folder / "usb-acsar"), "--robot", str(robot)
    emulated = start(folder / "emulator.jsonl", *options)
    yield emulated
    emulated.end()


@pytest.fixture
def plugged(board: Emulated) -> Iterator[Emulated]:
    """A robot that is plugged in, with a lasting name."""
    board.plug()
    yield board
    board.resume()
    watchdog.end_searches()


@pytest.fixture
def emulator(plugged: Emulated) -> Emulated:
    """The same at rest, with an empty log."""
    plugged.forget()
    return plugged


@pytest.fixture
def config(config: RobotConfig) -> RobotConfig:
    return config.with_(reconnect_timeout=TIMEOUT)


@pytest.fixture
def link(plugged: Emulated, config: RobotConfig) -> Iterator[SerialLink]:
    with no_leak():
        link = SerialLink(name(plugged), config)
        link.open()
        link.reset(Scene())
        yield link
        link.close()


@pytest.fixture
def env(plugged: Emulated, config: RobotConfig) -> Iterator[Any]:
    """An environment in the middle of an episode."""
    env = made(plugged, config)
    env.reset(seed=0)
    env.step(CURVE)
    yield env
    env.close()
