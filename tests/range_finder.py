"""A sensor of a user's own: one file, in the public names alone."""

from __future__ import annotations

from typing import Any

import numpy as np

import acsar_gym
from acsar_gym.sensors import SensorInput
from acsar_gym.worlds.geometry import measure_ranges

BEARINGS = np.radians([-30.0, 0.0, 30.0])
REACH = 3.0
"""[m]"""


class ThreeRays(acsar_gym.Sensor):
    """Three noisy rays ahead, as shares of their reach."""

    name = "three_rays"
    size = 3
    low = 0.0
    high = 1.0
    noise = 0.01
    """[m]"""

    def read(self, robots: SensorInput, out: Any) -> None:
        """Ranges / REACH, right to left."""
        for i, scene in enumerate(robots.scenes):
            x, y, theta = robots.pose[i]
            ranges = measure_ranges((x, y), theta + BEARINGS, scene.world)
            ranges += robots.rngs[i].normal(0.0, self.noise, 3)
            out[i] = np.clip(ranges, 0.0, REACH) / REACH

    def info(self, robots: SensorInput) -> dict[str, Any]:
        """When it was read."""
        return {"three_rays_time": robots.now}


def three_rays(link: Any, config: acsar_gym.RobotConfig) -> ThreeRays:
    """A factory that is a function."""
    return ThreeRays(link, config)
