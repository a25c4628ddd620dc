"""Fixtures of the tests here."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from lidar_tools import Open, Start, open_serial, start_lidar
from serial_tools import Emulated

from acsar_gym.lidar.serial import SerialLidar


@pytest.fixture(scope="module")
def sensor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulated]:
    """An RPLIDAR in a room, for tests that leave it as it is."""
    emulated = start_lidar(tmp_path_factory.mktemp("lidar") / "log.jsonl")
    yield emulated
    emulated.end()


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """`start("--model", "ld06", ...)` starts a sensor for this test."""
    running: list[Emulated] = []

    def begin(*arguments: str) -> Emulated:
        running.append(start_lidar(tmp_path / f"lidar{len(running)}.jsonl", *arguments))
        return running[-1]

    yield begin
    for emulated in running:
        emulated.end()


@pytest.fixture
def make() -> Iterator[Open]:
    """`make(emulated, "ld06", timeout=0.5)` is a LiDAR, which is closed at the end of the test."""
    made: list[SerialLidar] = []

    def begin(device: Emulated | str, model: str = "rplidar", timeout: float = 20.0) -> SerialLidar:
        made.append(open_serial(device, model, timeout))
        return made[-1]

    yield begin
    for lidar in made:
        lidar.close()
