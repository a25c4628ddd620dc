"""Hashes that tell whether two robots have the same configuration, or the same calibration."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from acsar_gym.config.robot import RobotConfig


def config_sha256(config: RobotConfig) -> str:
    """Return the SHA-256 of a robot's whole config, in hexadecimal; the order of fields is free."""
    return _sha256(config.model_dump(mode="json"))


def calibration_sha256(config: RobotConfig) -> str | None:
    """Return the SHA-256 of a robot's measured intervals; None where nothing was measured."""
    measured = config.model_dump(mode="json", include={"measured"})["measured"]
    return _sha256(measured) if measured else None


def _sha256(data: Any) -> str:
    text = json.dumps(data, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
