"""The map as a sensor: what it adds to the observation. Parity tests compare batches with it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.config.footprint import outline_radius, outline_reach
from acsar_gym.errors import ConfigError
from acsar_gym.sensors import LIDAR, MAP, MOVERS
from acsar_gym.sensors.map.seen import CELL_SHIFT, CELL_SIDE, HALF, OCCUPIED
from acsar_gym.sensors.map.sensor import (
    FARTHEST_CLEARANCE,
    SECTORS,
    UNSEEN_CLEARANCE,
    clear_map,
    length_of_share,
)

ACSAR = RobotConfig.preset("acsar")
CIRCLE = tuple((0.3 * math.cos(a), 0.3 * math.sin(a)) for a in np.arange(24) * math.tau / 24)
ROUND = ACSAR.with_(footprint=CIRCLE, lidar_x_offset=0.12, lidar_y_offset=-0.08)
LONG = ACSAR.with_(lidar_x_offset=0.1, lidar_y_offset=0.05, lidar={"rays": 96, "max_range": 9.0})
HALF_TURN = ACSAR.with_(lidar={"rays": 61, "field_of_view": math.pi})
ORIGIN = (0.0, 0.0, 0.0)


def clearances(numbers: dict[str, float]) -> Any:
    """(SECTORS,) [m]: in radii of the footprint."""
    shares = np.array([numbers[f"clearance_{n}"] for n in range(SECTORS)])
    return length_of_share(shares, FARTHEST_CLEARANCE)  # type: ignore[arg-type]


@pytest.mark.parametrize("config", [ROUND, LONG], ids=["circle", "long"])
def test_clearances_are_those_of_the_exact_footprint(config: RobotConfig, make_map: Any) -> None:
    mapped = make_map(config)
    rng = np.random.default_rng(0)
    radius = outline_radius(config.outline)
    nearest = max(config.lidar.min_range, 2.2 * radius)
    ranges = rng.uniform(nearest, config.lidar.max_range, config.lidar.rays)
    ranges[rng.random(len(ranges)) < 0.2] = config.lidar.max_range

    expected = np.full(SECTORS, np.inf)
    mount = complex(mapped.rays.mount_x, mapped.rays.mount_y)
    for distance, place in zip(ranges, mount + ranges * np.exp(1j * mapped.bearings), strict=True):
        bearing = np.angle(place)
        free = (abs(place) - outline_reach(config.outline, (0.0, 0.0), bearing)) / radius
        if distance == config.lidar.max_range:
            free = FARTHEST_CLEARANCE
        sector = int((bearing + math.pi) / math.tau * SECTORS) % SECTORS
        expected[sector] = min(expected[sector], free, FARTHEST_CLEARANCE)

    observed = clearances(mapped.see((1.0, -2.0, 0.7), ranges))
    measured = np.isfinite(expected)
    assert measured.sum() > 0.6 * SECTORS
    assert observed[measured] == pytest.approx(expected[measured], abs=0.02)
    between = ~measured & np.roll(measured, 1) & np.roll(measured, -1)
    nearer = np.minimum(np.roll(expected, 1), np.roll(expected, -1))
    assert observed[between] == pytest.approx(nearer[between], abs=0.02)


def test_map_of_a_lidar_that_only_sees_ahead_remembers_what_is_behind(make_map: Any) -> None:
    mapped = make_map(HALF_TURN)
    cos = np.cos(mapped.bearings)
    wall = np.minimum((1.2 - mapped.rays.mount_x) / np.maximum(cos, 1e-9), mapped.nothing)
    for _ in range(3):
        observed = clearances(mapped.see(ORIGIN, wall))
    ahead = observed[SECTORS // 2]
    radius = outline_radius(HALF_TURN.outline)
    assert ahead == pytest.approx((1.2 - HALF_TURN.body.length / 2.0) / radius, abs=0.1)
    assert observed[[0, -1]] == pytest.approx(UNSEEN_CLEARANCE)

    turned = (0.0, 0.0, math.pi)
    observed = clearances(mapped.see(turned, mapped.nothing))
    assert observed[[0, -1]] == pytest.approx(ahead, abs=2.0 * CELL_SIDE)
    assert observed[SECTORS // 2] == pytest.approx(FARTHEST_CLEARANCE)
    for turn in range(64):  # the wall is gone, and all directions are seen in turn
        observed = clearances(mapped.see((0.0, 0.0, 0.2 * turn), mapped.nothing))
    assert observed[0] == pytest.approx(FARTHEST_CLEARANCE)
    clear_map(mapped.record)
    observed = clearances(mapped.see(turned, mapped.nothing))
    assert observed[0] == pytest.approx(UNSEEN_CLEARANCE)


def test_cells_met_are_those_of_echoes_within_reach(make_map: Any) -> None:
    mapped = make_map(LONG)
    x = 1.0
    y = -2.0
    yaw = 0.7
    mapped.see((x, y, yaw), np.full(LONG.lidar.rays, 2.3))
    cells = mapped.sensor.cells_met(3.0)
    places = (cells + 0.5 - CELL_SHIFT) * mapped.sensor.cell_side
    mount = complex(mapped.rays.mount_x, mapped.rays.mount_y) * np.exp(1j * yaw)
    distances = np.abs(places @ (1, 1j) - complex(x, y) - mount)
    assert len(cells) > 30
    assert distances == pytest.approx(2.3, abs=mapped.sensor.cell_side)
    assert not len(mapped.sensor.cells_met(1.0))

    # The farthest cells are those in which the map isn't cut off.
    mapped.record.counts[:] = OCCUPIED
    cells = mapped.sensor.cells_met(100.0)
    assert len(np.unique(cells, axis=0)) == len(cells) == (2 * HALF - 1) ** 2


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        ([MAP], "sensor 'map': the robot has no 'lidar', which it needs"),
        ([MOVERS, LIDAR], "sensor 'movers': the robot has no 'map', which it needs"),
    ],
)
def test_map_needs_a_lidar_and_movers_a_map(sensors: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Robot(open_link("planar", ACSAR), ACSAR, sensors)


def test_map_needs_a_goal() -> None:
    robot = Robot(open_link("planar", ACSAR), ACSAR, [LIDAR, MAP])
    with pytest.raises(ConfigError, match="the scene has no goal, to which it shows the way"):
        robot.activate()
