"""The header of a recording: what is needed to read, repeat and align it.

| key | content |
|---|---|
| `format` | number of this format |
| `config`, `config_sha256` | the robot, and the hash of its whole config |
| `versions` | of acsar_gym, python, numpy |
| `process` | id of the process that records, which listens for an emergency stop on hardware |
| `created` | `wall` clock [ns since 1970] and `monotonic` clock [ns] at the same moment; |
| | /time_reference repeats the wall clock every second |
| `about` | what the program says about it: `env` (id, kwargs), `task`, `observation` (names of |
| | its numbers), `policy` (file, sha256), |
| | `link`, `command`. /acsar/episode tells seed, goal and start of each episode |
"""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Mapping
from importlib import metadata
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.config.fingerprint import config_sha256

FORMAT = 1
NAME = "acsar_gym"
"""Name of the metadata record that holds the header."""
END = "acsar_gym_end"
"""Name of the metadata record at the end of a complete recording."""


def version() -> str:
    """Return the version of this package."""
    try:
        return metadata.version("acsar_gym")
    except metadata.PackageNotFoundError:  # used from its folder, not installed
        return "unknown"


def plain(told: Any) -> Any:
    """Return what JSON can hold of something: NaN and infinity become null, objects their text."""
    return json.loads(json.dumps(told, default=str), parse_constant=lambda name: None)


def header(config: RobotConfig, about: Mapping[str, Any]) -> dict[str, Any]:
    """Make the header of a recording that begins now.

    Args:
        config: of the robot.
        about: what the program says about it, ready for JSON.
    """
    return {
        "format": FORMAT,
        "config": config.model_dump(mode="json"),
        "config_sha256": config_sha256(config),
        "versions": {
            "acsar_gym": version(),
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
        "process": os.getpid(),
        "created": {"wall": time.time_ns(), "monotonic": time.monotonic_ns()},
        "about": plain(dict(about)),
    }
