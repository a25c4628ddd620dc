"""Limits of what may be commanded: speed, acceleration and jerk, and where the robot may go."""

from __future__ import annotations

import math
from typing import Annotated, Self

from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError

LINEAR_ACCELERATION = 2.0
"""Of a robot that doesn't say otherwise [m/s^2]; ROS configures mobile bases with 1 to 3."""
ANGULAR_ACCELERATION = 8.0
"""[rad/s^2]"""


class SpeedLimits(Section):
    """Limits of one axis, named and behaving as in ROS diff_drive_controller; None is no limit.

    m/s or rad/s, and their derivatives, at most 1e6. A minimum that is None is minus the maximum.
    They are for driving: a twist of zero is sent at once.
    """

    section = "limits"
    max_velocity: Annotated[float, Field(ge=0.0, le=1e6)] | None = None
    min_velocity: Annotated[float, Field(ge=-1e6, le=0.0)] | None = None
    max_acceleration: Annotated[float, Field(gt=0.0, le=1e6)] | None = None
    min_acceleration: Annotated[float, Field(ge=-1e6, lt=0.0)] | None = None
    max_jerk: Annotated[float, Field(gt=0.0, le=1e6)] | None = None
    min_jerk: Annotated[float, Field(ge=-1e6, lt=0.0)] | None = None


def accelerating(limit: float) -> BeforeValidator:
    """Fills in this limit where a mapping of limits doesn't name one, not even null."""
    return BeforeValidator(
        lambda given: {"max_acceleration": limit, **given} if isinstance(given, dict) else given
    )


class Geofence(Section):
    """A rectangle of the odometry frame [m]; outside of it the robot is commanded to stop."""

    section = "geofence"
    min_x: float = -math.inf
    max_x: float = math.inf
    min_y: float = -math.inf
    max_y: float = math.inf
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=True)

    @model_validator(mode="after")
    def _holds_the_start(self) -> Self:
        if not (self.min_x < 0.0 < self.max_x and self.min_y < 0.0 < self.max_y):
            raise ConfigError(
                f"geofence = {self.min_x:g} to {self.max_x:g}, {self.min_y:g} to {self.max_y:g} m: "
                "must have the start (0, 0) inside"
            )
        return self
