"""The simulated LiDAR among movers: each beam meets them where they were when it was measured."""

from __future__ import annotations

from typing import Any, NamedTuple

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
ROBOTS = {
    "acsar": RobotConfig.preset("acsar").with_(lidar=EXACT),
    "jackal": RobotConfig.preset("jackal").with_(lidar=EXACT),
    "a narrow view": RobotConfig.preset("acsar").with_(
        lidar=EXACT | {"field_of_view": 4.0, "rays": 81, "max_range": 4.0},
        lidar_x_offset=0.12,
        lidar_y_offset=-0.07,
    ),
    "a slow head": RobotConfig.preset("acsar").with_(lidar=EXACT | {"rate": 5.0, "rays": 180}),
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
        follow_keys([0.0, 1.0, 1.5, 3.0], [[1, 1], [1, -1], [2, 0], [1, 1]], smooth=True),
    ],
    "people who react": [
        walk([[-2.0, 0.8], [2.5, 0.2]], 1.3, reacts=True),
        walk([[2.0, 0.5], [-2.5, 0.7]], 1.5, reacts=True, radius=0.35),
        walk([[0.9, -2.0], [0.9, 2.0]], 1.0),
        walk([[-1.0, -2.0], [-1.0, 2.0]], 1.0, reacts=True, sees_robot=False, spread=3.0),
    ],
}
ROOM = {
    "segments": make_rectangle(-4.0, -3.5, 4.0, 3.5),
    "circles": np.array([[1.8, 0.9, 0.2], [-1.5, 0.2, 0.1]]),
}


class Ways(NamedTuple):
    """Places of the LiDAR and of the movers at the ends of ticks."""

    times: list[float]
    lidar: list[list[float]]
    movers: list[Floats]

    def mark(self, link: SimulatedLink, config: RobotConfig) -> float:
        """Add the present places, and return the heading."""
        x, y, theta = link.truth.pose
        mount = complex(config.lidar_x_offset, config.lidar_y_offset) * np.exp(1j * theta)
        self.times.append(link.now())
        self.lidar.append([x + mount.real, y + mount.imag])
        assert link.truth.crowd is not None
        self.movers.append(link.truth.crowd.states[:, :2].copy())
        return theta

    def interpolate(self, times: Floats, values: Any) -> Floats:
        """Values of the ends of ticks, (ticks, n), at other times, (times, n)."""
        return np.column_stack([np.interp(times, self.times, column) for column in values.T])


def measure_exactly(
    times: Floats, bearings: Floats, ways: Ways, world: World, reach: float
) -> Floats:
    """Distances along bearings in the world, each from the LiDAR's place at its time."""
    lidar = ways.interpolate(times, np.array(ways.lidar))
    moved = np.empty((len(times), len(world.movers), 2))
    for m, mover in enumerate(world.movers):
        if mover.reacts:
            moved[:, m] = ways.interpolate(times, np.array(ways.movers)[:, m])
        else:
            moved[:, m] = [mover.position(time, hash_sample(KEY, m)) for time in times.tolist()]

    ranges = measure_ranges((lidar[:, 0], lidar[:, 1]), bearings, world, moved)
    radii = [mover.radius for mover in world.movers]
    is_inside = np.hypot(*np.moveaxis(moved - lidar[:, None], -1, 0)) <= radii
    ranges[is_inside.any(axis=1)] = 1e-6  # something very near
    return np.where(ranges < reach, ranges, 0.0)


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("kind", MOVERS)
def test_simulated_lidar_meets_movers_where_they_were(kind: str, robot: str) -> None:
    config = ROBOTS[robot]
    world = World(movers=MOVERS[kind], **ROOM)  # type: ignore[arg-type]
    empty = World(**ROOM)  # type: ignore[arg-type]
    link = SimulatedLink(config, lambda: PlanarBody(config))
    lidar = SimulatedLidar(link, config)
    scene = Scene((0.1, -0.2, 0.4), None, world, None, KEY)
    link.reset(scene)
    lidar.reset(scene, np.random.default_rng(3))
    ways = Ways([], [], [])
    ways.mark(link, config)
    met = 0
    for wheels in DRIVES:
        for tick in range(round(0.7 / config.period)):
            link.write(encode(wheels))
            link.advance(config.period)
            lidar.poll(link.truth, link.now())
            theta = ways.mark(link, config)
            revolution = lidar.scan()
            since = revolution.times >= ways.times[0]
            if tick % 9 or not since.any():
                continue

            # A beam points along the ray that the robot has now.
            times = revolution.times[since]
            bearings = theta + ray_spec(config).angles()[since]
            reach = config.lidar.max_range
            expected = measure_exactly(times, bearings, ways, world, reach=reach)
            assert revolution.distances[since] == pytest.approx(expected, abs=1e-9)
            without = measure_exactly(times, bearings, ways, empty, reach=reach)
            met += (expected < without - 0.01).sum()
    assert met > 50
