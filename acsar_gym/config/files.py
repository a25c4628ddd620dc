"""Reads robot parameters from YAML, or from the ros2_control block of a URDF."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError

import defusedxml.ElementTree
from defusedxml.common import DefusedXmlException

from acsar_gym.errors import ConfigError, shown, suggestion
from acsar_gym.reading import bounded, structured
from acsar_gym.resources import ASSETS

MOST_BYTES = 2_000_000
"""Largest accepted file [bytes]; the largest URDFs, of humanoids, have half of this."""
MOST_PARAMS = 1_000
"""Most parameters of a hardware block; each is compared with the names of all fields."""
DRIVER_BAUD_RATE = "9600"
"""Default of the robot's own driver if the URDF has no baud_rate [bit/s]."""
DRIVER_CONTROL_RATE = "20"
"""Default control rate for that baud rate [Hz]."""


def preset(name: str) -> Path:
    """Return the file of a preset; ConfigError suggests a similar name."""
    known = {path.stem: path for path in (ASSETS / "robots").glob("*.yaml")}
    if not isinstance(name, str) or name not in known:
        near = suggestion(str(name)[:40] if isinstance(name, str) else "", known)
        raise ConfigError(f"unknown robot preset {shown(name)}{near}")
    return known[name]


def fields(path: Path, params: Sequence[str]) -> dict[str, Any]:
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
    text = structured.decoded(bounded.content(path, MOST_BYTES))
    return _from_urdf(text, params) if path.suffix == ".urdf" else _from_yaml(text)


def _from_yaml(text: str) -> dict[str, Any]:
    """Parse a YAML mapping."""
    data = structured.from_yaml(text)
    data = {} if data is None else data
    if not isinstance(data, dict):
        raise ConfigError("must be a mapping of parameter names to values")
    return data


def _from_urdf(text: str, names: Sequence[str]) -> dict[str, Any]:
    """Parse the ros2_control block of a URDF."""
    try:
        root = defusedxml.ElementTree.fromstring(text)
    except (ParseError, DefusedXmlException, ValueError) as error:
        raise ConfigError(f"not a valid URDF: {error}") from None
    # A robot with an arm has several blocks; use the one with most known parameters.
    blocks = [_params(hardware, names) for hardware in root.iterfind(".//ros2_control/hardware")]
    if not blocks:
        raise ConfigError("has no <ros2_control><hardware> block to take the parameters from")
    known: dict[str, Any] = max(blocks, key=len)
    if "baud_rate" in known:
        return known
    return {"baud_rate": DRIVER_BAUD_RATE, "control_rate": DRIVER_CONTROL_RATE, **known}


def _params(hardware: Element, names: Sequence[str]) -> dict[str, Any]:
    """Return the known parameters of a hardware block."""
    params = hardware.findall("param")
    if len(params) > MOST_PARAMS:
        raise ConfigError(f"has a hardware block of {len(params):,} params: remove those not used")
    found = (_param(param, names) for param in params)
    return {name: value for name, value in found if name is not None}


def _param(element: Element, names: Sequence[str]) -> tuple[str | None, str]:
    """Return name and value; the name is None for parameters of other plugins."""
    name = element.get("name", "")
    value = (element.text or "").strip()
    if name in names:
        return name, value
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.85)
    if near:
        raise ConfigError(f"unknown param {name!r}; did you mean {near[0]!r}?")
    return None, value
