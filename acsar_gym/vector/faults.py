"""The faults that a batch can simulate: lines that are lost or late."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from acsar_gym.config import LINE_BYTES, RobotConfig
from acsar_gym.dynamics.timing import line_time
from acsar_gym.errors import ConfigError
from acsar_gym.links.faults import Faults
from acsar_gym.links.faulty_wire import BUFFER
from acsar_gym.vector.kernel.layout import LineFaults
from acsar_gym.wire import STANDSTILL_TIMEOUT

KNOWN = ("dropped_lines", "late_lines", "lateness", "episodes", "direction")


def checked(faults: Mapping[str, Any] | Faults | None, config: RobotConfig) -> Faults:
    """Check the faults of a batch.

    Args:
        faults: as users pass `faults=`; see `Faults.of`.
        config: of the robots.

    Raises:
        ConfigError: for a fault that a batch can't simulate, or a value out of range.
    """
    asked, sound = Faults.of(faults), Faults()
    for field in fields(asked):
        if field.name not in KNOWN and getattr(asked, field.name) != getattr(sound, field.name):
            raise ConfigError(
                f"faults: {field.name}: a batch knows {', '.join(KNOWN)}; for others make_vec with "
                "vectorization_mode='sync'"
            )
    most = BUFFER / (max(config.control_rate, config.feedback_rate) * (LINE_BYTES + 1))
    if asked.late_lines > 0.0 and asked.lateness > most:
        raise ConfigError(
            f"faults: lateness = {asked.lateness:g}: must be at most {most:.3g} s in a batch, so "
            "that no lines are lost behind a late one"
        )
    return asked


def line_faults(faults: Faults, config: RobotConfig) -> LineFaults:
    """Convert faults to the numbers that compiled loops need."""
    firmware = config.firmware
    return LineFaults(
        possible=faults.possible,
        episodes=float(faults.episodes),
        feedback=faults.direction != "commands",
        commands=faults.direction != "feedback",
        dropped=float(faults.dropped_lines),
        late=float(faults.late_lines),
        lateness=float(faults.lateness),
        patience=math.ceil(STANDSTILL_TIMEOUT / config.period),
        line_time=line_time(config),
        processing_time=firmware.processing_time,
        command_timeout=firmware.command_timeout or math.inf,
    )
