"""Open the LiDAR that a URL names, and find the sensors that names stand for."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, shown, suggestion
from acsar_gym.lidars.base import Lidar, LidarSensor
from acsar_gym.lidars.replayed import ReplayedLidar
from acsar_gym.lidars.simulated import SimulatedLidar
from acsar_gym.links.base import Link, tape_of
from acsar_gym.reading.objects import imported
from acsar_gym.sensors import LIDAR, Factory, Sensor


def open_lidar(url: Any, link: Link, config: RobotConfig) -> Lidar:
    """Make the LiDAR that a user names; nothing is opened before its `reset`.

    Args:
        url: None or "simulated" for rays in the world of a simulated link, or the scans of a
            recording, or
            "rplidar:///dev/ttyUSB1" for an RPLIDAR on a serial device, or a Lidar.
        link: of the robot.
        config: of the robot.

    Raises:
        ConfigError: for anything else, and for a simulated LiDAR on a link without a simulation.
    """
    if hasattr(url, "scan"):
        ready: Lidar = url
        return ready
    if url is None or (isinstance(url, str) and url == "simulated"):
        if (tape := tape_of(link)) is not None:
            return ReplayedLidar(tape, link, config)
        if link.truth is None:
            raise ConfigError(
                "this env needs a LiDAR and this link simulates none: "
                "pass lidar='rplidar:///dev/ttyUSB1'"
            )
        return SimulatedLidar(link, config)
    if isinstance(url, str) and url.startswith("rplidar://") and len(url) > len("rplidar://"):
        from acsar_gym.lidars.rplidar import RplidarLidar  # noqa: PLC0415 - optional

        clock = getattr(link, "clock", link.now)
        return RplidarLidar(url.removeprefix("rplidar://"), config, clock)
    raise ConfigError(
        f"lidar = {shown(url)}: must be like 'rplidar:///dev/ttyUSB1', or 'simulated'"
    )


def factories(
    sensors: Iterable[str | Sensor | Factory], lidar: Any = None
) -> list[Sensor | Factory]:
    """Replace names among the sensors of a task or an env by factories.

    Args:
        sensors: "lidar", names like "mine.rays:ThreeRays", factories and ready sensors.
        lidar: What "lidar" means, as `open_lidar` takes it.

    Raises:
        ConfigError: A name is unknown.
    """
    return [_named(one, lidar) if isinstance(one, str) else one for one in sensors]


def _named(name: str, lidar: Any) -> Factory:
    """The factory that a name stands for."""
    if ":" in name:
        made: Factory = imported("sensor", name)
        return made
    if name != LIDAR:
        raise ConfigError(f"unknown sensor {shown(name)}{suggestion(name, [LIDAR])}")

    def make(link: Link, config: RobotConfig) -> Sensor:
        return LidarSensor(open_lidar(lidar, link, config), config)

    return make
