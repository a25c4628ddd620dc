"""Finds the recording that `acsar-gym view` is asked for."""

from __future__ import annotations

import os
from pathlib import Path

from acsar_gym.errors import ConfigError, LinkError, shortened
from acsar_gym.links.factory import is_device
from acsar_gym.safety import estop

RECORD = "start it with --record FILE"


def recording_of(source: str) -> Path:
    """Return the recording that is meant.

    Args:
        source: a recording, or the device of a robot that a program on this computer drives.

    Raises:
        LinkError: nobody drives that robot, or doesn't record it.
        ConfigError: it is a simulated link, which only its recording shows.
    """
    if source in ("bullet", "planar"):
        raise ConfigError(
            f"{source} is simulated by the program that drives it: {RECORD}, and view that file"
        )
    if source == "serial":
        raise ConfigError("serial: name the device, which 'acsar-gym estop --list' tells")
    path = Path(source.removeprefix("replay:"))
    is_file = path.suffix == ".mcap" or path.is_file() or path.is_dir()
    return _driven(source) if is_device(source) and not is_file else path


def _driven(device: str) -> Path:
    """Return the file that the driver of a device records to."""
    real = os.path.realpath(device)
    known = estop.drivers()
    found = [one for one in known if one.device and os.path.realpath(one.device) == real]
    silent = [str(one.process) for one in known if not one.device]
    where = shortened(device)
    if found and found[0].recording:
        return Path(found[0].recording)
    if found:
        raise LinkError(
            f"{where}: process {found[0].process} drives it without a recording", RECORD
        )
    if silent:
        raise LinkError(
            f"{where}: process {silent[0]} drives a robot, but doesn't answer",
            "name the file that it records to",
        )
    raise LinkError(f"{where}: no program of yours on this computer drives it", RECORD)
