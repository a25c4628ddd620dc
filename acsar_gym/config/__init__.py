"""Frozen, validated parameters of the robot and of its simulation.

The first block of `RobotConfig` has the parameters that the robot's own driver reads from its URDF.
The sections `motor`, `encoder`, `firmware` and `body` describe board and robot for simulated links
only. `lidar` is the range sensor, simulated or real, and `measured` has the intervals of what was
measured. Bad values raise one `ConfigError` that names field, value and allowed range.
"""

from acsar_gym.config.robot import (
    BAUD_RATES,
    BITS_PER_BYTE,
    LINE_BYTES,
    RobotConfig,
    RobotSource,
    whole_ratio,
)
from acsar_gym.config.sections import (
    BodyConfig,
    EncoderConfig,
    FirmwareConfig,
    Geofence,
    LidarConfig,
    Measured,
    MotorConfig,
    Ros2Config,
    SpeedLimits,
    WheelConfig,
    WheelMotor,
    WheelsConfig,
    update_measured,
)

__all__ = [
    "BAUD_RATES",
    "BITS_PER_BYTE",
    "LINE_BYTES",
    "BodyConfig",
    "EncoderConfig",
    "FirmwareConfig",
    "Geofence",
    "LidarConfig",
    "Measured",
    "MotorConfig",
    "RobotConfig",
    "RobotSource",
    "Ros2Config",
    "SpeedLimits",
    "WheelConfig",
    "WheelMotor",
    "WheelsConfig",
    "update_measured",
    "whole_ratio",
]
