"""Sensors beside the wheel encoders: the base class, and the sensors of a robot."""

from acsar_gym.lidar.scan import Revolution
from acsar_gym.sensors.sensor import (
    LIDAR,
    MAP,
    MOVERS,
    Bound,
    Factory,
    Sensor,
    Truths,
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
    "Sensors",
    "Truths",
    "draw_normal",
    "draw_uniform",
]
