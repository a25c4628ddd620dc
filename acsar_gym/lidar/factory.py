"""Make the LiDAR that a user names."""

from __future__ import annotations

from typing import Any

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError, ConfigError, TranslatedErrors, show_value
from acsar_gym.lidar.contract import Lidar
from acsar_gym.lidar.replayed import ReplayedLidar
from acsar_gym.lidar.simulated import SimulatedLidar
from acsar_gym.links.base import Link
from acsar_gym.reading import import_object


def open_lidar(url: Any, link: Link, config: RobotConfig) -> Lidar:
    """Make the LiDAR that a user names. Nothing is opened before its `reset`.

    Raises:
        ConfigError: There is no such LiDAR, a simulated LiDAR is on a link without a simulation, or
            a device is on a link that doesn't run in real time.
    """
    # A robot in ROS has its LiDAR there, unless another one is named.
    if url is None and link.ros is not None:
        url = link.ros.device
    name = url if isinstance(url, str) else ""

    if name == "ros2" or name.startswith("ros2:"):
        return _open_topic(name, link, config)
    if url is None or name == "simulated":
        if link.scans is not None:
            return ReplayedLidar(link.scans, link)
        if link.truth is None:
            raise ConfigError(
                "this env needs a LiDAR and this link simulates none: name its model and device as "
                "lidar (--lidar), like rplidar:///dev/ttyUSB1"
            )
        return SimulatedLidar(link, config)
    if "://" in name:
        return _open_device(name, link, config)

    # A user's own: an object, its class, or "module:Class".
    made = import_object("lidar", name) if ":" in name and "/" not in name else url
    if isinstance(made, type) or made is not url:
        with TranslatedErrors(AcsarError, lambda: f"lidar = {show_value(url)}"):
            made = made(link, config)
    if not all(callable(getattr(made, method, None)) for method in ("reset", "scan", "close")):
        raise ConfigError(
            f"lidar = {show_value(url)}: must be like 'rplidar:///dev/ttyUSB1', 'ros2', "
            "'module:Class', or 'simulated'"
        )
    ready: Lidar = made
    return ready


def _check_real_time(url: str, link: Link) -> None:
    """Raise ConfigError for a LiDAR that measures in real time on a link that doesn't."""
    if link.truth is not None or link.scans is not None:
        raise ConfigError(
            f"lidar = {show_value(url)}: a device measures in real time, and this link is a "
            "simulation or a recording: leave it out there"
        )


def _open_topic(url: str, link: Link, config: RobotConfig) -> Lidar:
    from acsar_gym.lidar.ros2 import RosLidar  # noqa: PLC0415

    _check_real_time(url, link)
    return RosLidar(url, link, config)


def _open_device(url: str, link: Link, config: RobotConfig) -> Lidar:
    from acsar_gym.lidar.drivers import find_drivers  # noqa: PLC0415 - imports pyserial
    from acsar_gym.lidar.serial import SerialLidar  # noqa: PLC0415

    # Names of models are written in many ways: RPLIDAR-A1, rplidar_a1.
    model, _, device = url.partition("://")
    drivers = find_drivers()
    make_driver = drivers.get(model.lower().replace("-", "_"))
    if make_driver is None:
        raise ConfigError(f"lidar = {show_value(url)}: unknown model; known: {', '.join(drivers)}")
    if not device:
        raise ConfigError(
            f"lidar = {show_value(url)}: names no device: must be like '{model}:///dev/ttyUSB1'"
        )

    _check_real_time(url, link)
    return SerialLidar(device, make_driver, config, link.clock)
