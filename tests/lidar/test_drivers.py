"""Which LiDAR a URL means."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lidar_twins import MAKERS

from acsar_gym import RobotConfig, open_link
from acsar_gym.errors import ConfigError
from acsar_gym.lidar.drivers import find_drivers
from acsar_gym.lidar.factory import open_lidar
from acsar_gym.lidar.serial import SerialLidar
from acsar_gym.lidar.simulated import SimulatedLidar
from acsar_gym.recording import Recorder
from acsar_gym.recording.recorder import RecordedLink
from acsar_gym.worlds import Scene

ACSAR = RobotConfig.preset("acsar")


class OwnLidar:
    """A user's LiDAR."""

    def __init__(self, link: Any, config: RobotConfig) -> None:
        self.config = config

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Nothing to open."""

    def scan(self) -> None:
        """Nothing to measure."""

    def close(self) -> None:
        """Nothing to close."""


def make_none(link: Any, config: RobotConfig) -> None:
    """A factory that makes no LiDAR."""


def test_find_drivers_has_a_driver_for_each_model() -> None:
    drivers = find_drivers()
    made = {name: make() for name, make in drivers.items()}
    assert all(driver.product for driver in made.values())
    assert {type(made[name]) for name in MAKERS} == {type(driver) for driver in made.values()}


@pytest.mark.parametrize("model", ["rplidar", "LD06", "ydlidar-x4"])
def test_open_lidar_knows_models(model: str) -> None:
    lidar = open_lidar(f"{model}:///dev/ttyUSB1", open_link("/dev/ttyUSB0", ACSAR), ACSAR)
    assert isinstance(lidar, SerialLidar)
    assert lidar.device == "/dev/ttyUSB1"


def test_open_lidar_takes_the_simulated_lidar_and_a_users() -> None:
    link = open_link("planar", ACSAR)
    for url in (None, "simulated"):
        assert isinstance(open_lidar(url, link, ACSAR), SimulatedLidar)
    lidar = open_lidar(f"{__name__}:OwnLidar", link, ACSAR)
    assert type(lidar).__name__ == "OwnLidar"
    assert open_lidar(lidar, link, ACSAR) is lidar
    assert open_lidar(OwnLidar, link, ACSAR).config is ACSAR  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", ["planar", "replay:none.mcap"])
@pytest.mark.parametrize("wrapped", [False, True])
def test_open_lidar_needs_real_time_for_a_device(name: str, wrapped: bool, tmp_path: Path) -> None:
    link = open_link(name, ACSAR)
    if wrapped:
        link = RecordedLink(link, Recorder(tmp_path / "tape.mcap"), ACSAR)
    with pytest.raises(ConfigError, match="measures in real time, and this link is a simulation"):
        open_lidar("ld06:///dev/ttyUSB1", link, ACSAR)


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("rplidr:///dev/ttyUSB1", r"unknown model; known: ld06, .*rplidar, .*ydlidar_x4_pro$"),
        ("rplidar://", "names no device: must be like 'rplidar:///dev/ttyUSB1'"),
        ("ld06:/dev/ttyUSB1", "must be like 'rplidar:///dev/ttyUSB1', 'ros2', 'module:Class'"),
        (f"{__name__}:make_none", "must be like"),
        (f"{__name__}:Nobody", "has no attribute 'Nobody'"),
    ],
)
def test_open_lidar_refuses_other_names(url: Any, said: str) -> None:
    with pytest.raises(ConfigError, match=said) as caught:
        open_lidar(url, open_link("planar", ACSAR), ACSAR)
    assert "\n" not in str(caught.value)
