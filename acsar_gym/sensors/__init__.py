"""What a robot senses beside its wheels: the contract of a sensor, and the list of a robot."""

from acsar_gym.sensors.base import LIDAR, Bound, Factory, Sensor
from acsar_gym.sensors.suite import Sensors

__all__ = ["LIDAR", "Bound", "Factory", "Sensor", "Sensors"]
