"""Limits of commands: velocity, acceleration and jerk, and the geofence."""

from __future__ import annotations

import math
from typing import Annotated, Self

from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError

LINEAR_ACCELERATION = 2.0
"""Default limit [m/s^2]; ROS configurations of mobile bases use 1 to 3."""
ANGULAR_ACCELERATION = 8.0
"""Default limit [rad/s^2]."""


class SpeedLimits(Section):
    """Limits of one axis, with names and meaning of ROS diff_drive_controller; None is no limit.

    Units are m/s or rad/s and their derivatives, at most 1e6. If a minimum is None, it is the
    negative maximum. A twist of zero isn't limited, but sent at once.
    """

    section = "limits"
    max_velocity: Annotated[float, Field(ge=0.0, le=1e6)] | None = None
    min_velocity: Annotated[float, Field(ge=-1e6, le=0.0)] | None = None
    max_acceleration: Annotated[float, Field(gt=0.0, le=1e6)] | None = None
    min_acceleration: Annotated[float, Field(ge=-1e6, lt=0.0)] | None = None
    max_jerk: Annotated[float, Field(gt=0.0, le=1e6)] | None = None
    min_jerk: Annotated[float, Field(ge=-1e6, lt=0.0)] | None = None


def accelerating(limit: float) -> BeforeValidator:
    """Return a validator that sets a missing `max_acceleration` to this limit; null stays null."""
    return BeforeValidator(
        lambda given: {"max_acceleration": limit, **given} if isinstance(given, dict) else given
    )


class Geofence(Section):
    """A rectangle in the odometry frame [m]; outside of it the robot is stopped."""

    section = "geofence"
    min_x: float = -math.inf
    max_x: float = math.inf
    min_y: float = -math.inf
    max_y: float = math.inf
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=True)

    @model_validator(mode="after")
    def _holds_the_start(self) -> Self:
        """Check that the start of the odometry frame is inside."""
        if not (self.min_x < 0.0 < self.max_x and self.min_y < 0.0 < self.max_y):
            raise ConfigError(
                f"geofence = {self.min_x:g} to {self.max_x:g}, {self.min_y:g} to {self.max_y:g} m: "
                "must have the start (0, 0) inside"
            )
        return self
