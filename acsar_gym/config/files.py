"""Read robots from YAML, or from the ros2_control block of a URDF, and write them as YAML."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import ParseError

import defusedxml.ElementTree
from defusedxml.common import DefusedXmlException

from acsar_gym import reading
from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError, show_value, suggest_name
from acsar_gym.resources import ASSETS

MAX_ROBOT_BYTES = 2_000_000
"""Largest accepted file [bytes]; the largest URDFs, of humanoids, have half of this."""
MAX_URDF_PARAMS = 1_000
"""Most parameters of a hardware block; each is compared with the names of all fields."""
DRIVER_DEFAULTS = {"baud_rate": "9600", "control_rate": "20"}
"""Of the robot's own driver, if the URDF has no baud_rate [bit/s]; with a rate that fits [Hz]."""
GEOMETRY_FIELDS = (
    "wheel_radius",
    "wheel_separation",
    "wheelbase",
    "wheel_separation_multiplier",
    "left_wheel_radius_multiplier",
    "right_wheel_radius_multiplier",
)
"""Fields that are always written."""
ROBOT_FILE_HEAD = (
    "# A robot for acsar_gym: its geometry, and what differs from the defaults. SI units.\n"
)


def find_preset(name: str) -> Path:
    """Return the file of a preset; ConfigError suggests a similar name."""
    known = {path.stem: path for path in (ASSETS / "robots").glob("*.yaml")}
    if not isinstance(name, str) or name not in known:
        near = suggest_name(str(name)[:40] if isinstance(name, str) else "", known)
        raise ConfigError(f"unknown robot preset {show_value(name)}{near}")
    return known[name]


def read_fields(path: Path, params: Sequence[str]) -> dict[str, Any]:
    """Read the fields of a robot, without validating them.

    Args:
        path: a .yaml, .yml or .urdf file.
        params: parameter names that a URDF may use.

    Returns:
        Field names and values; those of a URDF are strings.

    Raises:
        ConfigError: the file can't be read. The message doesn't name the file.
    """
    if path.suffix not in (".yaml", ".yml", ".urdf"):
        raise ConfigError("a robot is read from .yaml, .yml or .urdf (expand .xacro first)")
    text = reading.decode_text(reading.read_content(path, MAX_ROBOT_BYTES))
    if path.suffix == ".urdf":
        return _parse_urdf(text, params)
    data = reading.parse_yaml(text)
    if data is not None and not isinstance(data, dict):
        raise ConfigError("must be a mapping of parameter names to values")
    return data or {}


def _parse_urdf(text: str, names: Sequence[str]) -> dict[str, Any]:
    """Known parameters of the ros2_control block; those of other plugins don't matter."""
    try:
        root = defusedxml.ElementTree.fromstring(text)
    except (ParseError, DefusedXmlException, ValueError) as error:
        raise ConfigError(f"not a valid URDF: {error}") from None
    blocks: list[dict[str, Any]] = []
    for hardware in root.iterfind(".//ros2_control/hardware"):
        params = hardware.findall("param")
        if len(params) > MAX_URDF_PARAMS:
            raise ConfigError(
                f"has a hardware block of {len(params):,} params: remove those not used"
            )
        given = {param.get("name", ""): (param.text or "").strip() for param in params}
        for name in (each for each in given if each not in names):
            near = difflib.get_close_matches(name, names, n=1, cutoff=0.85)
            if near:
                raise ConfigError(f"unknown param {name!r}; did you mean {near[0]!r}?")
        blocks.append({name: given[name] for name in given if name in names})
    if not blocks:
        raise ConfigError("has no <ros2_control><hardware> block to take the parameters from")
    known = max(blocks, key=len)  # a robot with an arm has several blocks
    return known if "baud_rate" in known else {**DRIVER_DEFAULTS, **known}


def check_target(path: str | Path) -> Path:
    """Return the path of a robot's file that is to be written; ConfigError for other names."""
    if not isinstance(path, str | Path) or Path(path).suffix not in (".yaml", ".yml"):
        name = str(path) if isinstance(path, Path) else path
        raise ConfigError(f"path = {show_value(name)}: a robot is written to .yaml or .yml")
    return Path(path)


def save_robot(robot: Section, path: Path, remarks: Mapping[str, str] | None = None) -> None:
    """Write a robot's geometry and what differs from the defaults; ConfigError if it can't be.

    Args:
        robot: to write.
        path: of the file.
        remarks: comments to write above fields, by their names.
    """
    geometry = {name: getattr(robot, name) for name in GEOMETRY_FIELDS}
    text = reading.format_yaml(geometry | find_differences(robot, type(robot)()))
    for name, remark in (remarks or {}).items():
        lines = "".join(f"# {line}\n" for line in remark.splitlines())
        text = re.sub(f"(?m)^(?={name}:)", lines, text)
    reading.write_atomically(path, (ROBOT_FILE_HEAD + text).encode())


def find_differences(section: Section, usual: Section) -> dict[str, Any]:
    """Return the fields of a section that differ from those of another, as plain YAML values."""
    plain = section.model_dump(mode="json")
    found: dict[str, Any] = {}
    for name, default in usual:
        value = getattr(section, name)
        if value != default:
            nested = isinstance(value, Section)
            found[name] = (
                find_differences(value, default or type(value)()) if nested else plain[name]
            )
    return found
