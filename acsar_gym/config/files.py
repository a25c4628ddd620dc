"""Find and read the file of a robot: YAML, the driver's URDF, or a controller's parameters."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

from acsar_gym import reading
from acsar_gym.config import importers
from acsar_gym.config.sections import MANY_ROBOTS, SIX_NUMBERS
from acsar_gym.errors import ConfigError, show_value, suggest_name
from acsar_gym.resources import ASSETS

MAX_ROBOT_BYTES = 2_000_000
"""Largest accepted file [bytes], far more than any robot's file has."""
YAML_SUFFIXES = (".yaml", ".yml")


def find_preset(name: str) -> Path:
    """Return the file of a preset. ConfigError suggests a similar name."""
    presets = {path.stem: path for path in (ASSETS / "robots").glob("*.yaml")}
    text = name if isinstance(name, str) else ""
    if text not in presets:
        near = suggest_name(text[:40], presets)
        raise ConfigError(f"unknown robot preset {show_value(name)}{near}")
    return presets[text]


def find_file(robot: str) -> Path:
    """Return the file of a robot.

    Args:
        robot: A file with a suffix or in a folder, or the name of a preset.

    Raises:
        ConfigError: There is no such preset, or the text names several robots.
    """
    # Names with commas are fleets, but a file may have any name.
    if "," in robot and not Path(robot).exists():
        raise ConfigError(f"robot = {show_value(robot)}: {MANY_ROBOTS}")
    return Path(robot) if Path(robot).suffix or "/" in robot else find_preset(robot)


def read_text(path: Path) -> str:
    """Read a robot's file. The message of a ConfigError doesn't contain the path."""
    return reading.decode_text(reading.read_content(path, MAX_ROBOT_BYTES))


def read_fields(path: Path, names: Collection[str]) -> dict[str, Any]:
    """Read the fields of a robot without validating them.

    Args:
        path: The file.
        names: Names of all fields.

    Raises:
        ConfigError: The file can't be read or has another format. The message doesn't contain the
            path.
    """
    if path.suffix == ".urdf":
        return importers.read_urdf(read_text(path), names)
    if path.suffix not in YAML_SUFFIXES:
        raise ConfigError(f"isn't .yaml, .yml or .urdf: {SIX_NUMBERS}")

    # A file of ROS is recognized by its content, since it is YAML as well.
    text = read_text(path)
    nodes = importers.find_parameters(reading.parse_yaml(text))
    return importers.read_controller(nodes) if nodes else read_own_fields(text, names)


def read_own_fields(text: str, names: Collection[str]) -> dict[str, Any]:
    """Parse a robot's YAML file of this package. Raises ConfigError for other YAML."""
    data = reading.parse_yaml(text)
    if data is not None and not isinstance(data, dict):
        raise ConfigError("must be a mapping of parameter names to values")
    if data and not data.keys() & set(names):
        name, value = next(iter(data.items()))
        # A single value is a misspelt field, whose own error suggests the right name.
        if len(data) > 1 or isinstance(value, dict):
            raise ConfigError(f"{name[:40]!r} is no field of a robot: {SIX_NUMBERS}")
    return data or {}
