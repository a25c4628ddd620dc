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
    if is_device(source):
        return _driven(source)
    return Path(source.removeprefix("replay:"))


def _driven(device: str) -> Path:
    """Return the file that the driver of a device records to."""
    real = os.path.realpath(device)
    known = estop.drivers()
    for driver in known:
        if driver.device and os.path.realpath(driver.device) == real:
            break
    else:
        silent = [str(driver.process) for driver in known if not driver.device]
        if silent:
            raise LinkError(
                f"{shortened(device)}: process {', '.join(silent)} drives a robot, but doesn't "
                "answer",
                "name the file that it records to",
            )
        raise LinkError(
            f"{shortened(device)}: no program of yours on this computer drives it", RECORD
        )
    if not driver.recording:
        raise LinkError(
            f"{shortened(device)}: process {driver.process} drives it without a recording", RECORD
        )
    return Path(driver.recording)
