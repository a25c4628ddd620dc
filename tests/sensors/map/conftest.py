"""Maps that are given scans, without a robot around them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.lidar.scan import make_rays
from acsar_gym.sensors.map.seen import CELL_SHIFT, CELLS, HALF, OCCUPIED
from acsar_gym.sensors.map.sensor import (
    MAP_HIGH,
    MAP_LOW,
    MAP_NAMES,
    MapSensor,
    clear_map,
    update_alone,
)
from acsar_gym.sensors.map.way import SCRATCH

STEP = 0.1
"""Time between two scans [s]."""
Pose = tuple[float, float, float]


class Mapped:
    """The map of a robot that has a goal."""

    def __init__(
        self, config: RobotConfig, goal: tuple[float, float] = (9.0, 0.0), seed: int = 0
    ) -> None:
        self.sensor = MapSensor(None, config)
        self.record: Any = self.sensor.records.view(np.recarray)[0]
        self.goal = goal
        self.now = 0.0
        self.rays = make_rays(config)
        self.bearings = self.rays.start + np.arange(config.lidar.rays) * self.rays.step
        self.nothing = np.full(config.lidar.rays, config.lidar.max_range)
        self.rng = np.random.default_rng(seed)
        clear_map(self.record)

    def see(self, pose: Pose, ranges: Any, ages: Any = 0.0) -> dict[str, float]:
        """Give it a scan whose rays were measured at these ages, and return its numbers."""
        self.now += STEP
        times = np.broadcast_to(self.now + ages, ranges.shape).copy()
        measured = self.bearings, times, float(times.max())
        scratch = np.zeros(SCRATCH, np.int32)
        out = np.zeros(len(MAP_NAMES))
        inputs = self.now, pose, self.goal, ranges, self.rays, measured, scratch, out
        update_alone(self.sensor.records, *inputs)
        assert (out >= MAP_LOW - 1e-9).all()
        assert (out <= MAP_HIGH + 1e-9).all()
        return dict(zip(MAP_NAMES, out.tolist(), strict=True))

    def watch(
        self, pose: Pose, circles: Any, velocity: complex = 0.0, odometry: Pose | None = None
    ) -> Any:
        """Scan circles, rows of place and radius, while the LiDAR turns, and return the movers."""
        x, y, radius = np.reshape(circles, (-1, 3)).T
        ages = -STEP * (1.0 - np.mod(-self.bearings / math.tau, 1.0))
        mount = complex(self.rays.mount_x, self.rays.mount_y)
        eye = complex(*pose[:2]) + mount * np.exp(1j * pose[2])
        toward = x + 1j * y - eye + ages[:, None] * velocity
        toward *= np.exp(-1j * (self.bearings + pose[2]))[:, None]
        depth = radius**2 - toward.imag**2
        hit = (depth > 0.0) & (toward.real > 0.0)
        distances = toward.real - np.sqrt(np.maximum(depth, 0.0))
        ranges = np.where(hit, distances, np.inf).min(axis=1)
        noisy = ranges + self.rng.normal(0.0, 0.01, len(ranges))
        self.see(odometry or pose, np.minimum(noisy, self.nothing), ages)
        return self.sensor.movers

    def occupied(self) -> Any:
        """(n, 2): Centres of occupied cells [m], of a robot near the origin."""
        cells = (np.argwhere(self.record.counts >= OCCUPIED) + HALF) % CELLS - HALF
        return (cells + 0.5 - CELL_SHIFT) * self.record.side


@pytest.fixture(scope="session")
def make_map() -> type[Mapped]:
    """`make_map(config, goal, seed)` is an empty map."""
    return Mapped
