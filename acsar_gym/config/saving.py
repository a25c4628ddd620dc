"""Writes the fields of a robot that differ from the defaults as YAML."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError, shown
from acsar_gym.reading import bounded, structured

GEOMETRY = (
    "wheel_radius",
    "wheel_separation",
    "wheelbase",
    "wheel_separation_multiplier",
    "left_wheel_radius_multiplier",
    "right_wheel_radius_multiplier",
)
"""Fields that are always written."""
HEAD = "# A robot for acsar_gym: its geometry, and what differs from the defaults. SI units.\n"


def target(path: str | Path) -> Path:
    """Return the path of a robot's file that is to be written; ConfigError for other names."""
    if not isinstance(path, str | Path) or Path(path).suffix not in (".yaml", ".yml"):
        name = str(path) if isinstance(path, Path) else path
        raise ConfigError(f"path = {shown(name)}: a robot is written to .yaml or .yml")
    return Path(path)


def save(robot: Section, path: Path, remarks: Mapping[str, str] | None = None) -> None:
    """Write a robot's geometry and what differs from the defaults; ConfigError if it can't be.

    Args:
        robot: to write.
        path: of the file.
        remarks: comments to write above fields, by their names.
    """
    fields = {name: getattr(robot, name) for name in GEOMETRY} | differing(robot, type(robot)())
    text = structured.to_yaml(fields)
    for name, remark in (remarks or {}).items():
        lines = "".join(f"# {line}\n" for line in remark.splitlines())
        text = re.sub(f"(?m)^(?={name}:)", lines, text)
    bounded.write_atomically(path, (HEAD + text).encode())


def differing(section: Section, usual: Section) -> dict[str, Any]:
    """Return the fields of a section that differ from those of another, as plain YAML values."""
    found: dict[str, Any] = {}
    for name in type(section).model_fields:
        value, default = getattr(section, name), getattr(usual, name)
        if value == default:
            continue
        if isinstance(value, Section):
            found[name] = differing(value, default if default is not None else type(value)())
        else:
            found[name] = _plain(value)
    return found


def _plain(value: Any) -> Any:
    """Convert a value to lists, mappings and scalars."""
    if isinstance(value, Section):
        return _plain(value.model_dump())
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    return value
