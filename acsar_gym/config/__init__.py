"""Frozen, validated parameters of the robot and of its simulated twin.

The first block of `RobotConfig` is what the robot's own driver reads from its URDF; the sections
(`motor`, `encoder`, `firmware`, `body`) describe what stands on the other side of the wire and are
used by simulated links only; `lidar` is the range sensor, simulated or real. Every bad value is one
`ConfigError` that names field, value and what is allowed.
"""

from acsar_gym.config.lidar import LidarConfig
from acsar_gym.config.limits import Geofence, SpeedLimits
from acsar_gym.config.parts import BodyConfig, EncoderConfig, FirmwareConfig, MotorConfig
from acsar_gym.config.rates import whole_ratio
from acsar_gym.config.robot import RobotConfig, RobotSource
from acsar_gym.config.wire import BAUD_RATES, BITS_PER_BYTE, LINE_BYTES

__all__ = [
    "BAUD_RATES",
    "BITS_PER_BYTE",
    "LINE_BYTES",
    "BodyConfig",
    "EncoderConfig",
    "FirmwareConfig",
    "Geofence",
    "LidarConfig",
    "MotorConfig",
    "RobotConfig",
    "RobotSource",
    "SpeedLimits",
    "whole_ratio",
]
