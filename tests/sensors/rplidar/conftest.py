"""Fixtures of the tests here."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from lidar_tools import start_lidar
from rplidar_tools import Open, Start
from serial_tools import Emulated

from acsar_gym import RobotConfig
from acsar_gym.sensors.rplidar import RplidarLidar


@pytest.fixture(scope="module")
def sensor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulated]:
    """A sensor in a room, for tests that leave it as it is."""
    emulated = start_lidar(tmp_path_factory.mktemp("lidar") / "log.jsonl")
    yield emulated
    emulated.end()


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """`start("--spin-up", "1", ...)` starts a sensor of the test's own."""
    running: list[Emulated] = []

    def begin(*arguments: str) -> Emulated:
        running.append(start_lidar(tmp_path / f"lidar{len(running)}.jsonl", *arguments))
        return running[-1]

    yield begin
    for emulated in running:
        emulated.end()


@pytest.fixture
def make() -> Iterator[Open]:
    """`make(emulated, rays=63, ...)` is a LiDAR; all of them are closed with the test."""
    made: list[RplidarLidar] = []

    def begin(device: Emulated | str, **lidar: float) -> RplidarLidar:
        config = RobotConfig.preset("acsar").with_(
            lidar={"timeout": 20.0, **lidar}, reconnect_timeout=0.5
        )
        name = device if isinstance(device, str) else device.device
        made.append(RplidarLidar(name, config, time.monotonic))
        return made[-1]

    yield begin
    for lidar in made:
        lidar.close()
