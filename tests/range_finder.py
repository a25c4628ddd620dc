"""A sensor of a user's own: one file, in the public names alone."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import acsar_gym
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds.geometry import measure_ranges

BEARINGS = np.radians([-30.0, 0.0, 30.0])
REACH = 3.0
"""[m]"""


class ThreeRays(acsar_gym.Sensor):
    """Three noisy rays ahead, as shares of their reach."""

    name, size, low, high = "three_rays", 3, 0.0, 1.0
    noise = 0.01
    """[m]"""

    def read(self, truth: GroundTruth | None, now: float) -> NDArray[np.float64]:
        """Ranges / REACH, right to left."""
        assert truth is not None
        x, y, theta = truth.pose
        ranges = measure_ranges((x, y), theta + BEARINGS, self.scene.world)
        return np.clip(ranges + self.rng.normal(0.0, self.noise, 3), 0.0, REACH) / REACH

    def info(self, now: float) -> dict[str, float]:
        """When it was read."""
        return {"three_rays_time": now}


def three_rays(link: Any, config: acsar_gym.RobotConfig) -> ThreeRays:
    """A factory that is a function."""
    return ThreeRays(link, config)
