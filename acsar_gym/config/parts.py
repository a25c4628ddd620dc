"""A robot that several files describe together: a URDF, a controller's parameters, nav2's."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from acsar_gym.errors import ConfigError

MANY_ROBOTS = "a fleet is for a batch of robots (make_vec); give one robot here"
HINTS = {
    "wheel_base": "write wheel_separation for the distance between left and right wheels, or "
    "wheelbase for that between the axles",
    "wheel_diameter": "write wheel_radius, half of it",
    "wheel_track": "write wheel_separation",
    "track_width": "write wheel_separation",
    "robot_radius": "write footprint, the corners around it",
}
"""What to write instead of fields of other programs; in some, wheel_base is the track."""
GEOMETRY_FIELDS = (
    "wheel_radius",
    "wheel_separation",
    "wheelbase",
    "wheel_separation_multiplier",
    "left_wheel_radius_multiplier",
    "right_wheel_radius_multiplier",
)
"""Fields that mean in files of others what they mean here, and are always written."""
ONLY_FOUR = "only robots with four driven wheels that skid are simulated and driven"
MEASURES = GEOMETRY_FIELDS[:3]
"""What must be known of a robot that isn't this package's own."""
MULTIPLIER = "wheel_separation_multiplier"
"""With equal wheel loads 1 + (wheelbase / wheel_separation)^2; see `RobotConfig`."""


@dataclass
class RobotPart:
    """What one file says of a robot.

    Attributes:
        fields: of `RobotConfig`, not validated.
        guesses: fields that follow from others; any file that says them counts more.
        missing: why the file doesn't say one of `MEASURES`; without an entry, the default counts.
        centre: x and y of the middle between the wheels in the base frame of a URDF [m].
        skids: whether wheelbase and separation say how the wheels skid in a turn, where no file has
            a multiplier.
        driven: the wheels' joints that a controller drives.
        drive_problem: why those alone aren't of a robot that can be driven; or empty.
        sides: the joints "left" and "right", where each stands for the wheels of a side; they count
            where no file names four.
        is_controller: whether it is of a robot in ROS 2, which drives without a known wheelbase.
        base_footprint: corners in that base frame [m], where the file says no wheels' places.
    """

    fields: dict[str, Any] = field(default_factory=dict)
    guesses: dict[str, Any] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    centre: tuple[float, float] | None = None
    skids: bool = False
    driven: list[str] = field(default_factory=list)
    drive_problem: str = ""
    sides: dict[str, str] = field(default_factory=dict)
    is_controller: bool = False
    base_footprint: list[tuple[float, float]] = field(default_factory=list)


def merge_parts(parts: Sequence[RobotPart]) -> dict[str, Any]:
    """Return the fields of a robot; ConfigError where no file says one of `MEASURES`."""
    fields: dict[str, Any] = {}
    for part in (*(RobotPart(part.guesses) for part in parts), *parts):
        fields = _update(fields, part.fields)
    reasons = {
        name: reason
        for part in parts
        for name, reason in part.missing.items()
        if name not in fields
    }
    sides = next((part.sides for part in parts if part.sides), {})
    if sides and "wheel_joints" not in fields:
        fields = _update({"ros2": {"joints": sides}}, fields)
    if [*reasons] == ["wheelbase"] and any(part.is_controller for part in parts):
        # a square: nothing but a simulation needs it, and there is none of this robot
        unknown = {"wheelbase": fields["wheel_separation"], "ros2": {"only": True}}
        fields, reasons = _update(unknown, fields), {}
    if reasons:
        why = "; ".join(dict.fromkeys(reasons.values()))
        names = [*reasons]
        listing = " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
        raise ConfigError(f"doesn't say {listing}: {why}")
    if any(part.skids for part in parts) and MULTIPLIER not in fields:
        with contextlib.suppress(TypeError, ValueError, ZeroDivisionError):
            ratio = float(fields["wheelbase"]) / float(fields["wheel_separation"])
            fields[MULTIPLIER] = round(1.0 + ratio**2, 4)
    return fields


def _update(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Return fields with others on top; sections are merged."""
    both = {
        name: _update(old[name], value)
        for name, value in new.items()
        if isinstance(value, Mapping) and isinstance(old.get(name), Mapping)
    }
    return {**old, **new, **both}
