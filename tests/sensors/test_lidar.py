"""Simulated scans: directions, limits, noise and drop-outs, and which LiDAR a URL means."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym.config import LidarConfig, RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.links import open_link
from acsar_gym.sensors.lidar import SimulatedLidar, add_noise, noise_draws
from acsar_gym.sensors.rplidar import RplidarLidar
from acsar_gym.sensors.suite import open_lidar
from acsar_gym.worlds import Scene, World

ACSAR = RobotConfig.preset("acsar")
PILLAR = World(np.array([[0.85, 2.0, 0.5]]))


def scanner(**lidar: Any) -> SimulatedLidar:
    config = ACSAR.with_(lidar={"noise": 0.0, **lidar})
    link = open_link("planar", config)
    link.open()
    scene = Scene(start=(1.0, 0.0, 0.0), world=PILLAR)
    link.reset(scene)
    made = SimulatedLidar(link, config)
    made.reset(scene, np.random.default_rng(0))
    return made


def test_a_pillar_to_the_left_is_seen_from_the_lidars_own_place() -> None:
    """The LiDAR sits 15 cm behind the robot's centre, so the pillar is exactly at its side."""
    ranges = scanner(rays=4).scan().ranges
    assert ranges == pytest.approx([5.0, 5.0, 5.0, 1.5])


def test_ranges_have_limits() -> None:
    assert scanner(rays=4, max_range=1.2).scan().ranges == pytest.approx([1.2] * 4)
    assert scanner(rays=4, min_range=2.5).scan().ranges == pytest.approx([5.0, 5.0, 5.0, 2.5])


def noisy(true: float, count: int = 20_000, **lidar: Any) -> Any:
    """Ranges of many scans, (count, rays)."""
    settings = LidarConfig(**{"rays": 1, **lidar})
    limits = settings.noise, settings.dropouts, settings.min_range, settings.max_range
    rng, found = np.random.default_rng(1), np.full((count, settings.rays), true)
    for ranges in found:
        add_noise(ranges, rng.random(noise_draws(settings)), *limits)
    return found


def test_noise_is_normal() -> None:
    errors = (noisy(2.0, noise=0.02) - 2.0) / 0.02
    assert errors.mean() == pytest.approx(0.0, abs=0.03)
    assert errors.std() == pytest.approx(1.0, abs=0.03)
    assert np.mean(np.abs(errors) < 1.0) == pytest.approx(0.683, abs=0.015)


def test_both_rays_of_a_pair_have_noise_of_their_own() -> None:
    correlation = np.corrcoef(noisy(2.0, 4000, rays=3, noise=0.05).T)
    assert np.abs(correlation - np.eye(3)).max() < 0.06


def test_dropouts_read_as_nothing_in_reach() -> None:
    found = noisy(2.0, noise=0.01, dropouts=0.2)
    assert np.mean(found == 5.0) == pytest.approx(0.2, abs=0.015)
    assert (np.abs(found[found < 5.0] - 2.0) < 0.1).all()


def test_noise_stays_within_the_limits_and_what_is_out_of_reach_has_none() -> None:
    assert (noisy(5.0, 100, noise=0.5) == 5.0).all()
    found = noisy(0.3, 2000, noise=1.0)
    assert found.min() == 0.1
    assert found.max() <= 5.0


def test_urls_name_lidars() -> None:
    link = open_link("planar", ACSAR)
    for url in (None, "simulated"):
        assert isinstance(open_lidar(url, link, ACSAR), SimulatedLidar)
    assert isinstance(open_lidar("rplidar:///dev/ttyUSB1", link, ACSAR), RplidarLidar)
    ready = scanner()
    assert open_lidar(ready, link, ACSAR) is ready
    bad: list[Any] = ["rplidar://", "/dev/ttyUSB1", 7, "rplidr:///dev/ttyUSB1"]
    for url in bad:
        with pytest.raises(ConfigError, match=r"rplidar:///dev/ttyUSB1"):
            open_lidar(url, link, ACSAR)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rays": 0}, "lidar.rays"),
        ({"field_of_view": 7.0}, "lidar.field_of_view"),
        ({"min_range": 6.0}, "min_range"),
        ({"dropouts": 1.0}, "dropouts"),
        ({"rate": 1.0}, "lidar.timeout"),
        ({"noise": math.nan}, "noise"),
    ],
)
def test_bad_settings_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ACSAR.with_(lidar=settings)
