"""The simulated LiDAR among movers: each beam meets them where they were when it was measured."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from acsar_gym import RobotConfig
from acsar_gym.hashing import hash_sample
from acsar_gym.lidar.scan import ray_spec
from acsar_gym.lidar.simulated import SimulatedLidar
from acsar_gym.links.simulated import SimulatedLink
from acsar_gym.physics.planar import PlanarBody
from acsar_gym.protocol import encode
from acsar_gym.worlds import Scene, World
from acsar_gym.worlds.geometry import measure_ranges
from acsar_gym.worlds.movers import Mover, Repeat, follow_keys, walk
from acsar_gym.worlds.world import make_rectangle

Floats = NDArray[np.float64]
KEY = 0.37
EXACT = {"noise": 0.0, "bias": 0.0, "dropouts": 0.0, "outliers": 0.0}
NARROW = {"field_of_view": 4.0, "rays": 81, "max_range": 4.0, "rate": 5.0}
ROBOTS = {
    "jackal": RobotConfig.preset("jackal").with_(lidar=EXACT),
    "a slow head with a narrow view": RobotConfig.preset("acsar").with_(
        lidar=EXACT | NARROW, lidar_x_offset=0.12, lidar_y_offset=-0.07
    ),
}
DRIVES = (
    (0.0, 0.0, 0.0, 0.0),
    (8.0, 8.0, 8.0, 8.0),
    (6.0, -6.0, -6.0, 6.0),
    (9.0, 4.0, 4.0, 9.0),
)
"""Speeds of the wheels [rad/s]: at rest, ahead, turning, on an arc."""
MOVERS: dict[str, list[Mover]] = {
    "walkers": [
        walk([[-2.0, 1.2], [2.0, 1.2]], 1.5, spread=5.0),
        walk([[1.5, -1.5], [1.5, 1.5], [2.5, 0.0]], [0.8, 2.0], pauses=[0.0, 0.3, 0.0], phase=1.0),
        walk([[-1.0, -1.0], [-1.0, -1.0]], radius=0.1),
        walk([[-3.0, -2.0], [3.0, -2.0]], 1.8, repeat=Repeat.STOP),
    ],
    "those who turn within a revolution": [
        walk([[0.9, y], [0.95, y], [1.0, y + 0.05]], 1.5, radius=0.15) for y in (-1.0, 0.0, 1.0)
    ],
    "those who jump": [
        follow_keys([0.0, 0.71], [[1.0, -1.5], [2.0, 1.5]]),
        follow_keys([0.0, 0.13], [[-1.2, -0.6], [-1.2, -0.4]], radius=0.2, spread=1.0),
        follow_keys(
            [0.0, 0.3, 0.5], [[-2.0, 1.0], [-1.0, 2.0], [0.0, 1.5]], smooth=True, phase=0.2
        ),
    ],
    "people who react": [
        walk([[-2.0, 0.8], [2.5, 0.2]], 1.3, reacts=True),
        walk([[2.0, 0.5], [-2.5, 0.7]], 1.5, reacts=True, radius=0.35),
        walk([[-1.0, -2.0], [-1.0, 2.0]], 1.0, reacts=True, sees_robot=False, spread=3.0),
    ],
}
ROOM = World(
    segments=make_rectangle(-4.0, -3.5, 4.0, 3.5),
    circles=np.array([[1.8, 0.9, 0.2], [-1.5, 0.2, 0.1]]),
)


def find_places(link: SimulatedLink, config: RobotConfig) -> list[complex]:
    """The present places of the LiDAR and of the movers."""
    x, y, theta = link.truth.pose
    mount = complex(config.lidar_x_offset, config.lidar_y_offset)
    crowd: Any = link.truth.crowd
    return [complex(x, y) + mount * np.exp(1j * theta), *(crowd.states[:, :2] @ (1.0, 1.0j))]


def measure_exactly(
    times: Floats, bearings: Floats, ways: dict[float, list[complex]], world: World, reach: float
) -> Floats:
    """Distances along bearings in the world, each from the LiDAR's place at its time.

    Between two ticks, the LiDAR and people who react move evenly. `ways` has their places.
    """
    way = [np.interp(times, [*ways], places) for places in zip(*ways.values(), strict=True)]
    lidar = way[0]
    moved = np.empty((len(times), len(world.movers), 2))
    for m, mover in enumerate(world.movers):
        moved[:, m] = [mover.position(time, hash_sample(KEY, m)) for time in times.tolist()]
        if mover.reacts:
            moved[:, m] = np.column_stack([way[m + 1].real, way[m + 1].imag])

    ranges = measure_ranges((lidar.real, lidar.imag), bearings, world, moved)
    is_inside = np.abs(moved @ (1.0, 1.0j) - lidar[:, None]) <= [m.radius for m in world.movers]
    ranges[is_inside.any(axis=1)] = 1e-6  # something very near
    return np.where(ranges < reach, ranges, 0.0)


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("kind", MOVERS)
def test_simulated_lidar_meets_movers_where_they_were(kind: str, robot: str) -> None:
    config = ROBOTS[robot]
    world = replace(ROOM, movers=tuple(MOVERS[kind]))
    link = SimulatedLink(config, lambda: PlanarBody(config))
    lidar = SimulatedLidar(link, config)
    scene = Scene((0.1, -0.2, 0.4), None, world, None, KEY)
    link.reset(scene)
    lidar.reset(scene, np.random.default_rng(3))
    ways = {link.now(): find_places(link, config)}
    met = 0
    for wheels in DRIVES:
        for tick in range(round(0.7 / config.period)):
            link.write(encode(wheels))
            link.advance(config.period)
            lidar.poll(link.truth, link.now())
            ways[link.now()] = find_places(link, config)
            revolution = lidar.scan()
            since = revolution.times >= 0.0
            if tick % 9 or not since.any():
                continue

            # A beam points along the ray that the robot has now.
            times = revolution.times[since]
            bearings = link.truth.pose[2] + ray_spec(config).angles()[since]
            reach = config.lidar.max_range
            expected = measure_exactly(times, bearings, ways, world, reach=reach)
            assert revolution.distances[since] == pytest.approx(expected, abs=1e-9)
            without = measure_exactly(times, bearings, ways, ROOM, reach=reach)
            met += (expected < without - 0.01).sum()
    assert met > 50
