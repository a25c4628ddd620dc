"""Makes links from URLs, by one table of backends.

Backends are imported late, since hardware needs no simulator.
"""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, show_value, suggest_name
from acsar_gym.links.base import Link
from acsar_gym.physics.bodies import BODIES, check_installed, make_body


class Backend(NamedTuple):
    """What `open_link` makes of a name, or of a prefix such as "replay:"."""

    make: Callable[[str, RobotConfig, bool], Link]
    """Makes a link from a URL and a robot, with a window if the last argument is True."""
    is_simulated: bool = False
    is_real: bool = False
    has_window: bool = False


def _make_simulated(url: str, config: RobotConfig, window: bool) -> Link:
    from acsar_gym.links.simulated import SimulatedLink  # noqa: PLC0415

    config.check_simulated()
    check_installed(url)
    return SimulatedLink(config, partial(make_body, url, config, window=window))


def _make_serial(url: str, config: RobotConfig, window: bool) -> Link:
    from acsar_gym.links.serial import SerialLink  # noqa: PLC0415

    config.check_four_wheels()
    device = config.serial_port if url == "serial" else url
    if device is None:
        raise ConfigError(
            "serial_port is missing: set it in the robot's config, or name the device"
        )
    return SerialLink(device, config)


def _make_replay(url: str, config: RobotConfig, window: bool) -> Link:
    # By its name, since recordings are made of what a robot does, and so lie above the links.
    replay = importlib.import_module("acsar_gym.recording.replay")
    link: Link = replay.ReplayLink(Path(url.removeprefix("replay:")))
    return link


def _make_ros2(url: str, config: RobotConfig, window: bool) -> Link:
    from acsar_gym.links.ros2 import Ros2Link  # noqa: PLC0415

    return Ros2Link(url, config)


BACKENDS = {
    name: Backend(_make_simulated, is_simulated=True, has_window=body.has_window)
    for name, body in BODIES.items()
} | {
    "replay:": Backend(_make_replay),
    "serial": Backend(_make_serial, is_real=True),
    "ros2": Backend(_make_ros2, is_real=True),
    "ros2:": Backend(_make_ros2, is_real=True),
}
"""All kinds of links. Devices and URLs that aren't in this table are serial."""

LINK_NAMES = (*BACKENDS, "/dev/ttyUSB0", "COM3", "usb:SERIAL_NUMBER")  # for messages
_DEVICE = re.compile(r"(/|\./|COM\d+$|usb:.|(socket|rfc2217)://)", re.IGNORECASE)


def open_link(
    url: str | os.PathLike[str],
    config: RobotConfig | str | Path | None = None,
    *,
    window: bool = False,
    realtime: bool | float = False,
) -> Link:
    """Return a closed link. It connects only in `open()` or `Robot.activate()`.

    Args:
        url: "bullet", "planar" or "mujoco" for a simulation. "/dev/ttyUSB0", "COM3",
            "usb:A50285BI" (USB serial number of an adapter) or "socket://host:port" for a serial
            device. "serial" for the device that the config names. "ros2" or "ros2:/namespace" for
            a robot in ROS 2. "replay:FILE" for a recording.
        config: Robot configuration, preset or file. None for the default.
        window: Whether to open PyBullet's window. Implies `realtime`.
        realtime: Run a simulation in real time instead of as fast as possible. A number is the
            multiple of real time.

    Raises:
        ConfigError: The URL is unknown, or only the link "ros2" can drive the robot.
        MissingExtraError: The simulator isn't installed.

    Example:
        >>> from acsar_gym import Robot, open_link
        >>> with Robot(open_link("planar")) as robot:
        ...     robot.drive(0.2, 0.0)
        ...     robot.link.is_real
        False
    """
    config = RobotConfig.of(config)
    if not isinstance(url, str | os.PathLike):
        raise ConfigError(f"link = {show_value(url)}: must be a name, a device or a Link")
    url = os.fspath(url)

    backend = _find_backend(url)
    if window and not (backend and backend.has_window):
        windows = " and ".join(f"{name!r}" for name in BACKENDS if BACKENDS[name].has_window)
        raise ConfigError(f"link {url!r} has no window; only {windows} has one")
    if backend is None:
        advice = suggest_name(url[:40], LINK_NAMES)
        if os.path.lexists(url):
            advice = ": for a device, write its full path, or ./ before it"
        raise ConfigError(f"unknown link {show_value(url)}{advice}")

    # A window is of use in real time only.
    link = backend.make(url, config, window)
    if backend.is_simulated and (realtime or window):
        from acsar_gym.links.simulated import PacedLink  # noqa: PLC0415

        return PacedLink(link, float(realtime or 1.0))
    return link


def is_device(url: str | os.PathLike[str]) -> bool:
    """Return whether a URL names a robot whose wheels are real."""
    backend = _find_backend(os.fspath(url))
    return backend is not None and backend.is_real


def _find_backend(url: str) -> Backend | None:
    """The backend of a URL. None if it is unknown."""
    for name, backend in BACKENDS.items():
        if url == name or (name.endswith(":") and url.startswith(name)):
            return backend

    # Links below /dev/serial/by-id are devices as well.
    try:
        is_device_file = Path(url).is_char_device()  # or a symbolic link to one
    except (OSError, ValueError):
        is_device_file = False
    return BACKENDS["serial"] if _DEVICE.match(url) or is_device_file else None
