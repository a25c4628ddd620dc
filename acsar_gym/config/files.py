"""Read robots from YAML, URDF and ROS parameter files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from acsar_gym import reading
from acsar_gym.config import ros_parameters, urdf_robot
from acsar_gym.config.parts import MANY_ROBOTS, RobotPart, merge_parts
from acsar_gym.config.urdf import UNEXPANDED
from acsar_gym.errors import AcsarError, ConfigError, show_value, suggest_name
from acsar_gym.resources import ASSETS

MAX_ROBOT_BYTES = 2_000_000
"""Largest accepted file [bytes]; the largest URDFs, of humanoids, have half of this."""
YAML_SUFFIXES = (".yaml", ".yml")
_NAMED_CONTROLLER = re.compile(r"(.+\.ya?ml):([^:]+)", re.DOTALL)
"""A file and the name of a controller in it."""


def find_preset(name: str) -> Path:
    """Return the file of a preset; ConfigError suggests a similar name."""
    presets = {path.stem: path for path in (ASSETS / "robots").glob("*.yaml")}
    if not isinstance(name, str) or name not in presets:
        near = suggest_name(str(name)[:40] if isinstance(name, str) else "", presets)
        raise ConfigError(f"unknown robot preset {show_value(name)}{near}")
    return presets[name]


def split_controller(name: str) -> tuple[Path, str]:
    """Return a file and the controller in it: "controllers.yaml:base_drive"; "" for none."""
    match = _NAMED_CONTROLLER.fullmatch(name)
    return (Path(match[1]), match[2]) if match else (Path(name), "")


def group_parts(names: Sequence[str]) -> list[list[str]]:
    """Group a list of robots: a ROS parameter file belongs to the name before it."""
    groups: list[list[str]] = []
    for name in names:
        if groups and _is_parameter_file(name):
            groups[-1].append(name)
        else:
            groups.append([name])
    return groups


def _is_parameter_file(name: str) -> bool:
    """Whether a name is that of a ROS parameter file; what can't be read is none."""
    path, _ = split_controller(name)
    if path.suffix not in YAML_SUFFIXES:
        return False
    try:
        return ros_parameters.is_parameter_file(reading.parse_yaml(read_text(path)))
    except AcsarError:
        return False


def read_text(path: Path) -> str:
    """Read a robot's file; ConfigError if it can't be. The message doesn't name it."""
    return reading.decode_text(reading.read_content(path, MAX_ROBOT_BYTES))


def read_fields(sources: Sequence[str | Path], params: Sequence[str]) -> dict[str, Any]:
    """Read the fields of a robot from the files that describe it, without validating them.

    A later file counts more. ConfigError, which begins with the file, where one can't be read, or
    where they don't say how large the robot is. `params` are the names that a URDF may use.
    """
    parts = [RobotPart() for _ in sources]
    driven: Sequence[str] = ()
    for number in sorted(range(len(sources)), key=lambda number: _is_urdf(sources[number])):
        try:
            parts[number] = _read_part(sources[number], params, driven)
        except ConfigError as error:
            raise ConfigError(f"{Path(sources[number])}: {error}") from error
        driven = parts[number].driven or driven
    for source, part in zip(sources, parts, strict=True):
        if part.drive_problem and not any(map(_is_urdf, sources)):
            raise ConfigError(f"{Path(source)}: {part.drive_problem}")
    (x, y) = next((part.centre for part in parts if part.centre), (0.0, 0.0))
    for part in parts:
        if part.centre is None and part.base_footprint:
            part.fields["footprint"] = [(a - x, b - y) for a, b in part.base_footprint]
    try:
        return merge_parts(parts)
    except ConfigError as error:
        raise ConfigError(f"{','.join(map(str, sources))}: {error}") from error


def find_parts(robot: str) -> list[str | Path]:
    """Return the files of one robot: a preset or file, and ROS parameter files behind commas.

    ConfigError where there is no such preset or file, or it names several robots.
    """
    names = [robot] if Path(robot).exists() else robot.split(",")
    if len(group_parts(names)) > 1:
        for name in names:
            if Path(name).suffix and not split_controller(name)[0].exists():
                raise ConfigError(f"{name}: there is no such file")
        raise ConfigError(f"robot = {show_value(robot)}: {MANY_ROBOTS}")
    return [name if Path(name).suffix or "/" in name else find_preset(name) for name in names]


def _is_urdf(source: str | Path) -> bool:
    return Path(source).suffix == ".urdf"


def _read_part(source: str | Path, params: Sequence[str], driven: Sequence[str]) -> RobotPart:
    """Read one of the files that describe a robot."""
    path, controller = split_controller(str(source))
    if path.suffix == ".xacro":
        raise ConfigError(UNEXPANDED)
    if path.suffix not in (*YAML_SUFFIXES, ".urdf"):
        raise ConfigError("a robot is read from .yaml, .yml or .urdf (expand .xacro first)")
    text = read_text(path)
    if path.suffix == ".urdf":
        return urdf_robot.read_urdf(text, params, driven)
    data = reading.parse_yaml(text)
    if ros_parameters.is_parameter_file(data):
        return ros_parameters.read_parameters(data, controller)
    if controller:
        raise ConfigError("isn't a file of ROS parameters, so it has no controllers")
    return RobotPart(read_own_fields(text))


def read_own_fields(text: str) -> dict[str, Any]:
    """Parse this package's own robot files; ConfigError for other YAML."""
    data = reading.parse_yaml(text)
    if ros_parameters.is_parameter_file(data):
        raise ConfigError("is a file of ROS parameters")
    if data is not None and not isinstance(data, dict):
        raise ConfigError("must be a mapping of parameter names to values")
    return data or {}
