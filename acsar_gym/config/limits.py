"""Limits of commands: velocity, acceleration and jerk, and the geofence."""

from __future__ import annotations

import math
from typing import Annotated, Any, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError

LINEAR_ACCELERATION = 2.0  # default limit [m/s^2]; ROS configurations of mobile bases use 1 to 3
ANGULAR_ACCELERATION = 8.0  # default limit [rad/s^2]


def _not_zero(value: float) -> float:
    """Return an acceleration; ValueError for zero, which would never let the robot go."""
    if value == 0.0:
        raise ValueError("must not be 0")
    return value


AccelerationLimit = Annotated[float, Field(ge=-1e6, le=1e6), AfterValidator(_not_zero)]
"""An acceleration whose sign follows from its name, so that it doesn't matter."""


class SpeedLimits(Section):
    """Limits of one axis, with names and meaning of ROS diff_drive_controller; None is no limit.

    Units are m/s or rad/s and their derivatives, at most 1e6. If a minimum is None, it is the
    negative maximum. A twist of zero isn't limited, but sent at once. NaN is None, and so is a jerk
    of 0, as in ROS.

    Accelerations have the names of Humble (`min_acceleration` limits braking, and speeding up
    backward) or of Jazzy, which tells these two apart.
    """

    section = "limits"
    max_velocity: Annotated[float, Field(ge=0.0, le=1e6)] | None = None
    """Forward or counter-clockwise."""
    min_velocity: Annotated[float, Field(ge=-1e6, le=0.0)] | None = None
    """Backward or clockwise; not positive."""
    max_acceleration: Annotated[float, Field(gt=0.0, le=1e6)] | None = None
    """Of a robot that speeds up forward, and in the names of Humble also of one that brakes
    backward."""
    min_acceleration: Annotated[float, Field(ge=-1e6, lt=0.0)] | None = None
    """Humble's; negative, and an error beside a name of Jazzy."""
    max_deceleration: AccelerationLimit | None = None
    """Of a robot that goes forward; None: as `max_acceleration`."""
    max_acceleration_reverse: AccelerationLimit | None = None
    """Of a robot that goes backward; None: as `max_acceleration`."""
    max_deceleration_reverse: AccelerationLimit | None = None
    """Of a robot that goes backward; None: as `max_deceleration`."""
    max_jerk: Annotated[float, Field(gt=0.0, le=1e6)] | None = None
    """How fast the acceleration may grow [m/s^3 or rad/s^3]."""
    min_jerk: Annotated[float, Field(ge=-1e6, lt=0.0)] | None = None
    """How fast the acceleration may fall; negative."""

    @field_validator("*", mode="before")
    @classmethod
    def _without_unset(cls, value: Any, info: ValidationInfo) -> Any:
        """Return None for ROS's words for no limit."""
        if not isinstance(value, float | int):
            return value
        is_jerk = str(info.field_name).endswith("_jerk")
        return None if math.isnan(value) or (is_jerk and value == 0.0) else value

    @model_validator(mode="after")
    def _names_of_one_release(self) -> Self:
        """Check that accelerations don't have names of both Humble and Jazzy."""
        for name in ("max_deceleration", "max_acceleration_reverse", "max_deceleration_reverse"):
            if self.min_acceleration is not None and getattr(self, name) is not None:
                raise ConfigError(
                    f"{self.section}.min_acceleration (of ROS 2 Humble) and {self.section}.{name} "
                    "(of Jazzy) limit the same: use the names of one of them"
                )
        return self


class LinearLimits(SpeedLimits):
    """Limits of the linear velocity."""

    section = "linear_limits"


class AngularLimits(SpeedLimits):
    """Limits of the angular velocity."""

    section = "angular_limits"


def default_acceleration(limit: float) -> BeforeValidator:
    """Return a validator that sets a missing `max_acceleration` to this limit; null stays null."""

    def complete(given: Any) -> Any:
        if isinstance(given, SpeedLimits):
            return given.model_dump()
        return {"max_acceleration": limit, **given} if isinstance(given, dict) else given

    return BeforeValidator(complete)


class Geofence(Section):
    """A rectangle in the odometry frame [m]; outside of it the robot is stopped."""

    section = "geofence"
    min_x: float = -math.inf
    """Least x [m]; negative."""
    max_x: float = math.inf
    """Largest x [m]; positive."""
    min_y: float = -math.inf
    """Least y [m]; negative."""
    max_y: float = math.inf
    """Largest y [m]; positive."""
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
