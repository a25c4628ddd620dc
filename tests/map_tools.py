"""A map that is given scans, without a robot around it."""

from __future__ import annotations

from typing import Any

import numpy as np

from acsar_gym import RobotConfig
from acsar_gym.lidar.scan import make_rays
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

    def __init__(self, config: RobotConfig, goal: tuple[float, float] = (9.0, 0.0)) -> None:
        self.sensor = MapSensor(None, config)
        self.record: Any = self.sensor.records.view(np.recarray)[0]
        self.goal = goal
        self.now = 0.0
        self.rays = make_rays(config)
        self.bearings = self.rays.start + np.arange(config.lidar.rays) * self.rays.step
        self.nothing = np.full(config.lidar.rays, config.lidar.max_range)
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
