"""Robots in ROS parameter files: controllers of ros2_controllers, footprints of nav2.

Parameters may be nested or written with dots, and stand under a node's name, in namespaces, or
under wildcards. Names are those of Humble and of Jazzy, and of ROS 1, whose files have no
`ros__parameters`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from typing import Any

from acsar_gym import reading
from acsar_gym.config.footprint import make_circle
from acsar_gym.config.parts import GEOMETRY_FIELDS, MEASURES, ONLY_FOUR, RobotPart
from acsar_gym.config.wheel_names import CORNERS, find_corner
from acsar_gym.errors import ConfigError, show_value, suggest_name

MARK = "ros__parameters"  # key of a node's parameters in ROS 2
OTHER_NAMES = {"odom_frame_id": "odom_frame", "base_frame_id": "base_frame"}
AXES = (("linear.x", "linear_limits", "max_linear"), ("angular.z", "angular_limits", "max_angular"))
LIMITS = {
    "acceleration": (
        "max_acceleration",
        "min_acceleration",
        "max_deceleration",
        "max_acceleration_reverse",
        "max_deceleration_reverse",
    ),
    "jerk": ("max_jerk", "min_jerk"),
}
"""Limits by the flag that switches them on: has_acceleration_limits, has_jerk_limits."""
USUAL_RATES = (10, 20, 40, 50, 100, 200)
"""Rates of a controller manager at which a robot can tick [Hz]; others don't fit its steps."""
SKIDS = 1.02  # a wheel_separation_multiplier above this tells how the wheels skid
_OTHER_DRIVES = {
    "mecanum or omni wheels": re.compile(r"mecanum|omni_wheel"),
    "a steered axle": re.compile(r"ackermann|bicycle|tricycle|steering"),
}
_DIFF_DRIVE = re.compile(r"diff_drive_controller")
_VELOCITY_GROUP = re.compile(r"velocity_controllers/JointGroupVelocityController")
TWO_WHEELS_BASE = 0.02
"""Wheelbase of a robot with two driven wheels, the least: so it turns as the formula says [m]."""


def is_parameter_file(data: Any) -> bool:
    """Whether a parsed YAML document is a file of ROS parameters."""
    return bool(_find_nodes(data))


def read_parameters(data: Any, name: str = "") -> RobotPart:
    """Read a robot's fields from a parsed file of ROS parameters.

    `name` is the controller's, where there are several. ConfigError says what a file is that has
    nothing of a robot with four driven wheels.
    """
    nodes = _find_nodes(data)
    wild = [node for node in nodes if node.endswith("*")]
    shared = {key: value for node in wild for key, value in nodes[node].items()}
    types = _controller_types(nodes)
    drives = [node for node in nodes if _is_diff_drive(nodes[node], types.get(_last(node), ""))]
    drives = [node for node in drives if node not in wild] or drives
    groups = [node for node in nodes if _VELOCITY_GROUP.search(types.get(_last(node), ""))]
    chosen = drives or groups
    if name:
        matching = [node for node in nodes if name in (node, _last(node), node.strip("/"))]
        if not matching:
            controllers = [_last(node) for node in [*drives, *groups] or nodes]
            raise ConfigError(
                f"has no controller {show_value(name)}{suggest_name(name, controllers)}"
            )
        chosen = matching
        groups += [node for node in matching if "joints" in nodes[node]]
    if len(chosen) > 1:
        names = [_last(node) for node in chosen]
        raise ConfigError(
            f"has {len(chosen)} controllers of a differential drive ({', '.join(names[:5])}): say "
            f"which one, such as FILE:{names[0]}"
        )
    part = RobotPart(base_footprint=_find_footprint(nodes))
    if not (chosen or part.base_footprint):
        raise ConfigError(_explain_others(nodes, types))
    part.missing = dict.fromkeys(
        MEASURES,
        "a velocity controller doesn't know it; give the robot, too: ROBOT,FILE"
        if chosen
        else "nav2 knows the footprint alone; give the robot, too: ROBOT,FILE",
    )
    is_group = bool(chosen) and chosen[0] in groups
    base = drives if is_group and len(drives) == 1 else [] if is_group else chosen
    if base:
        _read_controller({**shared, **nodes[base[0]]}, part)
    if is_group:
        _read_group(chosen[0], nodes[chosen[0]], part)
    if chosen:
        part.is_controller = True
        _read_manager(nodes, part)
    return part


def _read_group(node: str, params: Mapping[str, Any], part: RobotPart) -> None:
    """Read a controller that takes the speeds of single wheels."""
    joints = params.get("joints")
    if not (
        isinstance(joints, list)
        and len(joints) in (2, 4)
        and all(isinstance(joint, str) for joint in joints)
    ):
        raise ConfigError(
            f"{_last(node)}.joints = {show_value(joints)}: must be a list of 2 or 4 names"
        )
    part.fields["ros2"] = {
        "command": "wheel_speeds",
        "command_joints": joints,
        "command_topic": f"{_last(node)}/commands",
    }
    if not part.driven:
        part.driven = joints
        corners = {find_corner(joint): joint for joint in joints}
        if corners.keys() == {*CORNERS}:
            part.guesses["wheel_joints"] = [corners[corner] for corner in CORNERS]
        elif corners.keys() == {"l", "r"}:
            _set_sides(corners["l"], corners["r"], part)


def _set_sides(left: str, right: str, part: RobotPart) -> None:
    """Set the joints of a robot with one driven wheel on each side."""
    part.sides = {"left": left, "right": right}
    part.missing.pop("wheelbase", None)
    part.guesses["wheelbase"] = TWO_WHEELS_BASE


def _find_nodes(data: Any) -> dict[str, dict[str, Any]]:
    """Parameters of all nodes, with dotted names; nothing in files of other kinds."""
    if not isinstance(data, Mapping):
        return {}
    nodes = dict(_walk(data, ""))
    if not nodes:  # of ROS 1
        nodes = {
            node: dict(_flatten(value))
            for node, value in data.items()
            if isinstance(value, Mapping) and "/" in str(value.get("type", ""))
        }
    return nodes


def _walk(data: Mapping[str, Any], path: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield nodes and their parameters."""
    for key, value in data.items():
        if key == MARK and isinstance(value, Mapping):
            yield path, dict(_flatten(value))
        elif isinstance(value, Mapping):
            yield from _walk(value, f"{path}/{key.strip('/')}")


def _flatten(params: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield parameters with dotted names."""
    for key, value in params.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _last(node: str) -> str:
    return node.rpartition("/")[2]


def _controller_types(nodes: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Types of controllers by their names, as the controller manager or ROS 1 says them."""
    types = {}
    for node, params in nodes.items():
        for key, value in params.items():
            name, _, attribute = key.rpartition(".")
            if attribute == "type" and isinstance(value, str):
                types[name or _last(node)] = value
    return types


def _is_diff_drive(params: Mapping[str, Any], kind: str) -> bool:
    """Whether parameters are those of a differential drive's controller."""
    if kind:
        return bool(_DIFF_DRIVE.search(kind))
    return "wheel_separation" in params or "left_wheel_names" in params


def _read_controller(params: Mapping[str, Any], part: RobotPart) -> None:
    """Read the parameters of one controller."""
    fields = part.fields
    for name in GEOMETRY_FIELDS:  # a controller doesn't have them all
        if (value := params.get(name)) is not None and not _is_unset(value):
            fields[name] = value
    for name, field in OTHER_NAMES.items():
        if isinstance(value := params.get(name), str) and value:
            fields[field] = value
    if isinstance(stamped := params.get("use_stamped_vel"), bool):
        fields["ros2"] = {"command": "twist_stamped" if stamped else "twist"}
    timeout = params.get("cmd_vel_timeout")
    if timeout is not None and not _is_unset(timeout):
        fields["firmware"] = {"command_timeout": timeout}
    for axis, limits, largest in AXES:
        _read_limits(params, axis, limits, largest, fields)
    part.missing = {
        name: "its controller takes it from the URDF; give that, too: URDF,FILE"
        for name in ("wheel_radius", "wheel_separation")
        if name not in fields
    }
    wheelbase = _guess_wheelbase(fields)
    if wheelbase:
        part.guesses["wheelbase"] = wheelbase
    else:
        part.missing["wheelbase"] = (
            "a controller doesn't know it, and its multiplier doesn't tell; give the URDF, too: "
            "URDF,FILE"
        )
    _read_names(params, part)


def _guess_wheelbase(fields: Mapping[str, Any]) -> float | None:
    """The wheelbase [m] at which wheels skid as the multiplier says; None where it says nothing."""
    separation = fields.get("wheel_separation")
    multiplier = fields.get("wheel_separation_multiplier")
    if not (isinstance(separation, float | int) and isinstance(multiplier, float | int)):
        return None
    if not (separation > 0.0 and multiplier > SKIDS):
        return None
    return round(separation * math.sqrt(multiplier - 1.0), 6)


def _is_unset(value: Any) -> bool:
    """Whether a value is one of ROS's words for nothing: 0.0 or .nan."""
    return isinstance(value, float | int) and (value == 0.0 or math.isnan(value))


def _read_limits(
    params: Mapping[str, Any], axis: str, limits: str, largest: str, fields: dict[str, Any]
) -> None:
    """Read the limits of an axis; those that are switched off or unset are none."""
    axis_limits: dict[str, Any] = {}
    for kind, names in LIMITS.items():
        on = params.get(f"{axis}.has_{kind}_limits", True)
        for name in names:
            value = params.get(f"{axis}.{name}")
            if value is not None:
                axis_limits[name] = value if on and not _is_unset(value) else None
    if params.get(f"{axis}.has_velocity_limits", True):
        most, least = (params.get(f"{axis}.{end}_velocity") for end in ("max", "min"))
        if most is not None and not _is_unset(most):
            fields[largest] = most
        if least is not None and not _is_unset(least) and least != (most and -most):
            axis_limits["min_velocity"] = least
    if axis_limits:
        fields[limits] = axis_limits


def _read_names(params: Mapping[str, Any], part: RobotPart) -> None:
    """Read the names of the wheels' joints; ConfigError for what isn't names."""
    sides = []
    for side in ("right", "left"):
        names = params.get(f"{side}_wheel_names", params.get(f"{side}_wheel", []))
        names = [names] if isinstance(names, str) else names
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ConfigError(f"{side}_wheel_names = {show_value(names)}: must be a list of names")
        sides.append(names)
    right, left = sides
    part.driven = [*left, *right]
    if len(right) == len(left) == 2:
        (front_right, rear_right), (front_left, rear_left) = map(_order_wheels, sides)
        part.guesses["wheel_joints"] = [front_right, front_left, rear_left, rear_right]
    elif len(right) == len(left) == 1 and params.get("wheels_per_side", 1) in (0, 1):
        _set_sides(left[0], right[0], part)
    elif len(right) == len(left) == 1:
        part.sides = {"left": left[0], "right": right[0]}
        part.fields.setdefault("ros2", {})["only"] = False
    elif part.driven:
        names = ", ".join(part.driven[:6])
        part.drive_problem = (
            f"is the controller of a robot with {len(part.driven)} wheels ({names}): {ONLY_FOUR}"
        )


def _order_wheels(names: list[str]) -> tuple[str, str]:
    """The front wheel, then the rear one, by their names; else as they are listed."""
    first, second = names
    swapped = find_corner(first)[:1] == "b" and find_corner(second)[:1] == "f"
    return (second, first) if swapped else (first, second)


def _read_manager(nodes: Mapping[str, Mapping[str, Any]], part: RobotPart) -> None:
    """Take the controller manager's rate: of ticks, if a robot can tick at it, or of feedback."""
    for node, params in nodes.items():
        rate = params.get("update_rate")
        if _last(node) == "controller_manager" and isinstance(rate, float | int):
            if rate in USUAL_RATES:
                part.guesses["control_rate"] = rate
            elif USUAL_RATES[0] <= rate <= USUAL_RATES[-1]:
                part.guesses["firmware"] = {"feedback_rate": rate}


def _find_footprint(nodes: Mapping[str, Mapping[str, Any]]) -> list[tuple[float, float]]:
    """The footprint of nav2's costmaps, the local one's first; empty where there is none."""
    for node in sorted(nodes, key=lambda node: "local" not in node):
        given, radius = (nodes[node].get(name) for name in ("footprint", "robot_radius"))
        if isinstance(given, str) and given.strip() not in ("", "[]"):
            return _parse_footprint(given)
        if isinstance(radius, float | int) and not _is_unset(radius):
            return list(make_circle(radius))
    return []


def _parse_footprint(text: str) -> list[tuple[float, float]]:
    """Parse nav2's string of corners; ConfigError for others."""
    try:
        return [(float(x), float(y)) for x, y in reading.parse_json(text)]
    except (ConfigError, TypeError, ValueError) as error:
        raise ConfigError(
            f"footprint = {show_value(text)}: must be like '[[0.2, 0.1], [-0.2, 0.1], [0.0, -0.2]]'"
        ) from error


def _explain_others(nodes: Mapping[str, Mapping[str, Any]], types: Mapping[str, str]) -> str:
    """Say what a file is that has nothing to read."""
    words = " ".join(
        (*types.values(), *nodes, *(key for params in nodes.values() for key in params))
    )
    for drive, pattern in _OTHER_DRIVES.items():
        if pattern.search(words):
            return f"is a ROS parameter file of a robot with {drive}: {ONLY_FOUR}"
    names = ", ".join(dict.fromkeys(_last(node)[:40] for node in [*nodes][:4]))
    return (
        f"is a ROS parameter file ({names}{', ...' if len(nodes) > 4 else ''}) without a "
        "diff_drive_controller, footprint or robot_radius: it says nothing of a robot"
    )
