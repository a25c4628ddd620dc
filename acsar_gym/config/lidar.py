"""Parameters of the LiDAR, simulated or real."""

from __future__ import annotations

import math
from typing import Annotated, Self

from pydantic import Field, model_validator

from acsar_gym.config.section import Section
from acsar_gym.config.units import Rate, Wait
from acsar_gym.errors import ConfigError


class LidarConfig(Section):
    """The LiDAR and how its scans are used; its position is lidar_x/y/z_offset of the robot."""

    section = "lidar"
    rays: Annotated[int, Field(gt=0, le=10_000)] = 64
    """Rays of an observation; each takes the measurement nearest in direction."""
    field_of_view: Annotated[float, Field(gt=0.0, le=2.0 * math.pi + 1e-9)] = 2.0 * math.pi
    """Angle covered by the rays, centred on the x axis [rad]; a full turn has no duplicate ray."""
    min_range: Annotated[float, Field(ge=0.0, le=1e3)] = 0.1
    """Smaller measurements are set to this range [m]."""
    max_range: Annotated[float, Field(gt=0.0, le=1e3)] = 5.0
    """Larger or failed measurements are set to this range [m], at most 1 km."""
    rate: Rate = 10.0
    """Scans per second [Hz], at most 10,000."""
    noise: Annotated[float, Field(ge=0.0, le=1e3)] = 0.01
    """Standard deviation of simulated ranges [m]; typical of hobby LiDARs at a few metres."""
    dropouts: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    """Share of simulated rays whose measurement fails."""
    timeout: Wait = 1.0
    """A scan older than this is an error that stops the robot [s], at most 1 h."""

    @model_validator(mode="after")
    def _ranges_and_times_fit(self) -> Self:
        """Check the order of the ranges, and the time-out against the rate."""
        if self.min_range >= self.max_range:
            raise ConfigError(
                f"lidar.min_range = {self.min_range:g}: must be less than lidar.max_range = "
                f"{self.max_range:g} m"
            )
        if self.timeout < 1.5 / self.rate:
            raise ConfigError(
                f"lidar.timeout = {self.timeout:g} s: must be at least one and a half periods of "
                f"lidar.rate = {self.rate:g} Hz"
            )
        return self
