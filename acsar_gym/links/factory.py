"""Makes links from URLs. Links are imported late: hardware doesn't need pybullet."""

from __future__ import annotations

import os
import re
from functools import partial
from pathlib import Path

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, show_value, suggest_name
from acsar_gym.links.base import Link
from acsar_gym.links.simulated import PacedLink
from acsar_gym.physics.body import Body

LINK_NAMES = (
    "bullet",
    "planar",
    "serial",
    "replay:FILE",
    "/dev/ttyUSB0",
    "COM3",
    "usb:SERIAL_NUMBER",
)
_DEVICE = re.compile(r"(/|\./|COM\d+$|usb:.|(socket|rfc2217)://)", re.IGNORECASE)


def open_link(
    url: str | os.PathLike[str],
    config: RobotConfig | str | Path | None = None,
    *,
    window: bool = False,
    realtime: bool = False,
) -> Link:
    """Return a link, closed; it connects only in `open()` or `Robot.activate()`.

    Args:
        url: "bullet" or "planar" for a simulation; "/dev/ttyUSB0", "COM3", "usb:A50285BI" (USB
            serial number of an adapter) or "socket://host:port" for a serial device; "serial"
            for the device that the config names; "replay:FILE" for a recording.
        config: configuration, preset or file of the robot; None for the default.
        window: open PyBullet's window; implies `realtime`.
        realtime: run a simulation in real time instead of as fast as possible.

    Raises:
        ConfigError: for any other URL.
    """
    config = RobotConfig.of(config)
    if not isinstance(url, str | os.PathLike):
        raise ConfigError(f"link = {show_value(url)}: must be a name, a device or a Link")
    url = os.fspath(url)
    if window and url != "bullet":
        raise ConfigError(f"link {url!r} has no window; only 'bullet' has one")
    if url in ("bullet", "planar"):
        link = _simulated(url, config, window)
        return PacedLink(link) if realtime or window else link
    if url.startswith("replay:"):
        from acsar_gym.links.replay import ReplayLink  # noqa: PLC0415

        return ReplayLink(Path(url.removeprefix("replay:")))
    if is_device(url):
        from acsar_gym.links.serial import SerialLink  # noqa: PLC0415

        return SerialLink(_device(url, config), config)
    raise _unknown(url)


def _unknown(url: str) -> ConfigError:
    """Return the error for a URL that names no link."""
    near = suggest_name(url[:40], LINK_NAMES)
    if os.path.lexists(url):
        near = ": for a device, write its full path, or ./ before it"
    return ConfigError(f"unknown link {show_value(url)}{near}")


def is_device(url: str | os.PathLike[str]) -> bool:
    """Return whether a URL names a serial device, whose wheels are real."""
    url = os.fspath(url)
    if url in ("bullet", "planar"):
        return False
    return url == "serial" or _DEVICE.match(url) is not None or _exists(url)


def _exists(url: str) -> bool:
    """Whether a URL is the path of a device, such as a symbolic link to one."""
    try:
        return Path(url).is_char_device()
    except (OSError, ValueError):
        return False


def _simulated(name: str, config: RobotConfig, window: bool) -> Link:
    """Make the link of a simulated robot."""
    from acsar_gym.links.simulated import SimulatedLink  # noqa: PLC0415

    return SimulatedLink(config, partial(_body, name, config, window))


def _body(name: str, config: RobotConfig, window: bool) -> Body:
    """Make the physics of a simulated robot."""
    if name == "planar":
        from acsar_gym.physics.planar import PlanarBody  # noqa: PLC0415

        return PlanarBody(config)
    from acsar_gym.physics.bullet import BulletBody  # noqa: PLC0415

    return BulletBody(config, window=window)


def _device(url: str, config: RobotConfig) -> str:
    """Return the device that a URL or the config names."""
    if url != "serial":
        return url
    if config.serial_port is None:
        raise ConfigError(
            "serial_port is missing: set it in the robot's config, or name the device"
        )
    return config.serial_port
