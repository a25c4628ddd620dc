"""What a task is told, and what info says: one list of fields each, from which all are made.

The single environment and a batch name a robot's numbers alike, such as "odom_x": in a batch they
are the fields of `vector.kernel.layout.Robots`, in the single environment the keys of a mapping. A
field of `State` names the numbers that it is made of; a field that names none is handed over.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple, get_type_hints

import numpy as np
from numpy.typing import NDArray

Observation = NDArray[np.float32]
Floats = NDArray[np.float64]
Pose = tuple[float, float, float]
Goal = tuple[float, float]
Twist = tuple[float, float]
WheelSpeeds = tuple[float, float, float, float]
Info = dict[str, float]

NO_RANGES: Floats = np.zeros(0)
NO_PATH: Floats = np.zeros((0, 3))
NOTHING_SENSED: Observation = np.zeros(0, np.float32)


class State(NamedTuple):
    """What a task knows after every step. On a real robot all of it is known except `contact`.

    Poses and points are in the odometry frame, in which the robot starts at the origin.
    """

    pose: Annotated[Pose, "odom_x", "odom_y", "odom_theta"] = (0.0, 0.0, 0.0)
    """Pose by odometry: x [m], y [m], theta [rad]."""
    twist: Annotated[Twist, "linear", "angular"] = (0.0, 0.0)
    """Velocity by odometry: linear [m/s], angular [rad/s]."""
    wheel_speeds: Annotated[WheelSpeeds, "read_speed"] = (0.0, 0.0, 0.0, 0.0)
    """Wheel speeds by the encoders, in the order of the wheels a to d [rad/s]."""
    action: Annotated[Twist, "action_linear", "action_angular"] = (0.0, 0.0)
    """The last action (linear, angular), in [-1, 1]; zeros at a reset."""
    sent: Annotated[Twist, "sent_linear", "sent_angular"] = (0.0, 0.0)
    """The velocity command of the last tick, after all limits: linear [m/s], angular [rad/s]."""
    reason: Annotated[int, "reason"] = 0
    """Why `sent` differs from the action: a `safety.layer.Reason`; 0 where it doesn't."""
    ranges: Floats = NO_RANGES
    """(rays,): the LiDAR's newest scan [m]; empty where the task uses none."""
    edges: Floats = NO_RANGES
    """(rays,): distance from the LiDAR to the edge of the footprint along each ray [m]."""
    sensed: Observation = NOTHING_SENSED
    """(numbers,): what all sensors add to the observation, scaled as it is there."""
    time: float = 0.0
    """Time since the reset, a whole number of env steps [s]."""
    feedback_age: Annotated[float, "age"] = 0.0
    """Time since the last feedback line of the board [s]."""
    contact: Annotated[bool, "contact"] = False
    """Whether a simulated robot has touched an obstacle; always False on hardware."""
    goal: Annotated[Goal, "goal_x", "goal_y"] = (1.0, 0.0)
    """The goal: x, y [m]."""
    path: Floats = NO_PATH
    """(samples, 3): x [m], y [m] and direction [rad] every 0.05 m along the path to follow;
    empty unless the task sets `follows`."""
    length: float = math.nan
    """Length of the world's own path from start to goal [m]; NaN where there is none."""
    max_twist: Annotated[Twist, "max_linear", "max_angular"] = (1.0, 1.0)
    """The velocity of a full action: linear [m/s], angular [rad/s]."""
    period: float = 0.1
    """Duration of an env step [s]."""


INFO = {
    "is_success": "success",
    "odom_x": "odom_x",
    "odom_y": "odom_y",
    "odom_theta": "odom_theta",
    "feedback_age": "age",
    "sent_linear": "sent_linear",
    "sent_angular": "sent_angular",
    "sent_reason": "reason",
    "true_x": "x",
    "true_y": "y",
    "true_theta": "true_theta",
    "true_contact": "contact",
    "true_goal_distance": "goal_distance",
    "odometry_error": "odom_error",
}
"""Keys of info that every task has, and their numbers."""
CROWD_INFO = {
    "closest_person": "closest_person",
    "time_to_collision": "time_to_collision",
    "intrusions": "intrusions",
    "person_contact": "person_contact",
}
"""Keys of info that tasks have in worlds that move, and their numbers; see `worlds.crowd`."""
OPTIONAL_INFO = ("world", "scan_age", "scan_stale", "fault", "fault_reason")
"""Keys of info that some envs have; in a batch their numbers have the same names."""

_HINTS = get_type_hints(State, include_extras=True)
_SOURCES = {name: getattr(_HINTS[name], "__metadata__", ()) for name in State._fields}
STATE_NUMBERS = tuple(source for sources in _SOURCES.values() for source in sources)
"""The numbers of a robot that a State is made of; "read_speed" is four of them."""
HANDED_OVER = tuple(name for name, sources in _SOURCES.items() if not sources)
"""The fields of a State that aren't made of numbers, in the order in which makers take them."""


def write_maker(read: Callable[[str], str]) -> Callable[..., State]:
    """Write the function that makes a State; numba can compile it.

    Args:
        read: returns the expression, over `numbers` and `i`, that reads a number by its name.

    Returns:
        A function of `numbers`, `i`, and then of what `HANDED_OVER` names.
    """
    values = []
    for name, sources in _SOURCES.items():
        value, kind = ", ".join(map(read, sources)), getattr(_HINTS[name], "__origin__", None)
        if not sources:
            value = name
        elif kind is int:
            value = f"int({value})"
        elif kind is bool:
            value = f"{value} > 0.0"
        elif kind is not float:
            value = f"({value},)"
        values.append(value)
    lines = [
        f"def make_state(numbers, i, {', '.join(HANDED_OVER)}):",
        f"    return State({', '.join(values)})",
    ]
    made: dict[str, Any] = {"__name__": __name__, "State": State}
    exec("\n".join(lines), made)  # noqa: S102 - our own
    maker: Callable[..., State] = made["make_state"]
    return maker
