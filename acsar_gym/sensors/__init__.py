"""Sensors beside the wheel encoders: the base class, and the sensors of a robot."""

from acsar_gym.lidar.scan import Revolution
from acsar_gym.sensors.sensor import (
    LIDAR,
    MAP,
    MOVERS,
    Bound,
    Factory,
    Sensor,
    SensorInput,
    draw_normal,
    draw_uniform,
)
from acsar_gym.sensors.suite import Sensors

__all__ = [
    "LIDAR",
    "MAP",
    "MOVERS",
    "Bound",
    "Factory",
    "Revolution",
    "Sensor",
    "SensorInput",
    "Sensors",
    "draw_normal",
    "draw_uniform",
]
