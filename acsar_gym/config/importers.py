"""Robots from two files of ROS: the ACSAR driver's URDF, and a flat file of controllers.

Any other robot is written down as six numbers in a YAML file. Each function returns fields of
`RobotConfig` that aren't validated yet.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any
from xml.etree.ElementTree import Element, ParseError

import defusedxml.ElementTree
from defusedxml.common import DefusedXmlException

from acsar_gym.config.sections import GEOMETRY_FIELDS, SIX_NUMBERS, WHEEL_JOINTS
from acsar_gym.errors import ConfigError

DRIVER_PLUGIN = "ACSARInterface"
"""Class of the robot's own driver, whose parameters have the names of `RobotConfig`'s fields."""
DRIVER_DEFAULTS = {"baud_rate": "9600", "control_rate": "20"}
"""The driver's default for baud_rate [bit/s], with a rate that fits on that wire [Hz]."""
MARK = "ros__parameters"
"""Key of a node's parameters in a file of ROS 2."""
FRAMES = {"odom_frame_id": "odom_frame", "base_frame_id": "base_frame"}
AXES = {"linear.x": ("linear_limits", "max_linear"), "angular.z": ("angular_limits", "max_angular")}
"""Axes of a controller's limits, with the fields for the limits and for the top speed."""
SIMULATION_FIELDS = {
    "motor",
    "encoder",
    "firmware",
    "body",
    "measured",
    "motor_fit",
    "motor_fit_logs",
}
"""Fields that aren't parameters of the robot's own driver."""
FLAGS = {"velocity": "velocity", "acceleration": "celeration", "jerk": "jerk"}
"""Kinds in the names of flags, such as has_jerk_limits, and in the names of the limits."""
SKIDS = 1.02
"""Any wheel_separation_multiplier above this describes wheels that skid."""


# The driver's URDF


def read_urdf(text: str, names: Collection[str]) -> dict[str, Any]:
    """Read the parameters in the <ros2_control> block of the robot's own driver.

    Args:
        text: The URDF, expanded from xacro.
        names: Names of all fields.

    Raises:
        ConfigError: The URDF is malformed, is of another robot, or has a misspelt parameter.
    """
    try:
        root: Element = defusedxml.ElementTree.fromstring(text)
    except (ParseError, DefusedXmlException, ValueError) as error:
        raise ConfigError(f"not a valid URDF: {error}") from error

    # Joints in the block have params as well, which are others.
    params = {
        param.get("name", ""): (param.text or "").strip()
        for block in root.iter("ros2_control")
        if block.findtext("hardware/plugin", DRIVER_PLUGIN).strip().endswith(DRIVER_PLUGIN)
        for param in block.iterfind("hardware/param")
    }
    # Unknown parameters are the driver's own, unless they look like a misspelt field.
    parameters = [name for name in names if name not in SIMULATION_FIELDS]
    for name in params:
        near = difflib.get_close_matches(name, parameters, n=1, cutoff=0.85)
        if near and near[0] != name:
            raise ConfigError(f"unknown param {name!r}; did you mean {near[0]!r}?")

    fields = {name: params[name] for name in parameters if name in params}
    if not fields:
        raise ConfigError(
            f"has no parameters of {DRIVER_PLUGIN} in <ros2_control><hardware>: {SIX_NUMBERS}"
        )
    # The driver's own default is so slow that the rate must be lower as well.
    if "baud_rate" not in fields:
        fields = DRIVER_DEFAULTS | fields
    return _measure_wheels(root) | fields


def _measure_wheels(root: Element) -> dict[str, Any]:
    """Track and wheelbase by the origins of three wheel joints, if the URDF has them [m]."""
    origins = [root.find(f"joint[@name='{name}']/origin") for name in WHEEL_JOINTS[:3]]
    places = [origin.get("xyz", "").split() for origin in origins if origin is not None]
    # A pair across gives the separation, a pair along a side the wheelbase.
    if len(places) < 3:
        return {}
    try:
        (_, y_right, _), (x_front, y_left, _), (x_rear, _, _) = (map(float, xyz) for xyz in places)
    except ValueError as error:
        raise ConfigError("the origins of its wheel joints must be three numbers") from error
    return {"wheel_separation": round(y_left - y_right, 6), "wheelbase": round(x_front - x_rear, 6)}


# A controller's parameters


def find_parameters(data: Any) -> list[Mapping[str, Any]]:
    """Return the parameters of each ROS 2 node at the top level of a parsed YAML document."""
    nodes = data.values() if isinstance(data, Mapping) else ()
    blocks = [node.get(MARK) for node in nodes if isinstance(node, Mapping)]
    return [block for block in blocks if isinstance(block, Mapping)]


def read_controller(nodes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Read the parameters of a diff_drive_controller.

    A controller has no wheelbase. The result has the wheelbase at which wheels skid as
    `wheel_separation_multiplier` states. If it states no skidding, only ROS 2 can drive the robot.

    Args:
        nodes: Parameters of all nodes in a file.

    Raises:
        ConfigError: The file doesn't have exactly one such controller, or its parameters are
            nested, or aren't numbers.
    """
    # The geometry tells controllers apart, since their names are the user's choice.
    drives = [node for node in nodes if {*GEOMETRY_FIELDS[:2]} <= node.keys()]
    if len(drives) != 1 or any(isinstance(value, Mapping) for value in drives[0].values()):
        raise ConfigError(
            "is a ROS parameter file without exactly one diff_drive_controller that has "
            f"wheel_radius and wheel_separation, and no nested parameters: {SIX_NUMBERS}"
        )
    (params,) = drives
    fields = {name: params[name] for name in GEOMETRY_FIELDS if name in params}
    fields |= {field: params[name] for name, field in FRAMES.items() if params.get(name)}
    timeout = _read_value(params.get("cmd_vel_timeout"))
    if timeout:
        fields["firmware"] = {"command_timeout": timeout}

    for axis, (section, top_speed) in AXES.items():
        limits = _read_limits(params, axis)
        if (max_velocity := limits.pop("max_velocity", None)) is not None:
            fields[top_speed] = max_velocity
        if limits:
            fields[section] = limits

    # Joints that are missing are an error, as ROS needs them to drive.
    fields["wheel_joints"] = _read_joints(params)
    separation = fields["wheelbase"] = params["wheel_separation"]
    multiplier = params.get("wheel_separation_multiplier", 1.0)
    # 1 + (wheelbase / separation)^2 is the multiplier of four wheels that skid.
    try:
        if multiplier > SKIDS:
            fields["wheelbase"] = round(separation * math.sqrt(multiplier - 1.0), 6)
        else:
            fields["ros2"] = {"only": True}
    except (TypeError, OverflowError) as error:
        raise ConfigError("wheel_separation and its multiplier must be numbers") from error
    return fields


def _read_value(value: Any) -> Any:
    """Return the value of a parameter. NaN, which ROS writes for no value, becomes None."""
    return None if isinstance(value, float) and math.isnan(value) else value


def _read_limits(params: Mapping[str, Any], axis: str) -> dict[str, Any]:
    """Return the limits of an axis. Limits that a flag disables are None."""
    prefix = f"{axis}."
    limits = {
        name.removeprefix(prefix): _read_value(value)
        for name, value in params.items()
        if name.startswith(prefix)
    }
    # The word for accelerations is also in the names of decelerations.
    for kind, word in FLAGS.items():
        if not limits.pop(f"has_{kind}_limits", True):
            limits |= {name: None for name in limits if word in name}
    return limits


def _read_joints(params: Mapping[str, Any]) -> list[Any]:
    """Return the joints of the wheels a, b, c, d. Each side lists its front wheel first."""
    sides: list[Any] = [params.get(f"{side}_wheel_names") for side in ("right", "left")]
    if not all(isinstance(side, list) and 1 <= len(side) <= 2 for side in sides):
        raise ConfigError("left_wheel_names and right_wheel_names must be two names each, or one")
    # A side with a single joint has it twice.
    right_side, left_side = sides
    return [right_side[0], left_side[0], left_side[-1], right_side[-1]]
