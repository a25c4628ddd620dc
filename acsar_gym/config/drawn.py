"""Robots drawn at random. "drawn:17" is the same robot on every machine.

They are 0.22 to 1 m long, drive 0.3 to 2 m/s, and differ in shape, in acceleration, in the lag of
motors and board, and in the LiDAR and its place. The presets lie within these ranges. The timing of
wire and board is the default, since a batch shares it.
"""

from __future__ import annotations

import math
import re
from typing import Any
from zlib import crc32

import numpy as np

from acsar_gym.config.footprint import make_circle
from acsar_gym.errors import ConfigError, show_value

PREFIX = "drawn:"
SPLITS = {"train": range(512), "validation": range(1000, 1032), "test": range(2000, 2100)}
"""Numbers of the robots for training policies, for choosing them, and for measuring them."""
RADII = (0.16, 0.193, 0.233, 0.282, 0.341, 0.411, 0.497, 0.6)
"""Radii of the discs around footprints [m]. Robots of equal radius share their worlds."""
LARGEST_CIRCLE = 0.45
"""Robots of a larger radius are rectangles [m]."""
RAYS = 64
"""Rays of the LiDAR, which are equal for the robots of a batch."""
FIELDS_OF_VIEW = (2.0 * math.pi,) * 7 + (1.5 * math.pi,) * 2 + (math.pi,)
"""Angles that a LiDAR may see, with their frequency [rad]."""
FULL_VIEW = 6.0
"""LiDARs that see more than this angle see all around [rad]."""
WIRE_SPEED = 99.0
"""Fastest wheels [rad/s]: the wire's format ends at 99.99 rad/s."""
_NAME = re.compile(rf"{PREFIX}(?:(\d{{1,9}})(?:-(\d{{1,9}}))?|({'|'.join(SPLITS)}))")


def parse_numbers(text: str) -> range | None:
    """Return the numbers of a name such as "drawn:17", "drawn:0-63" or "drawn:train".

    Returns:
        The numbers, or None if the name isn't of drawn robots.

    Raises:
        ConfigError: The name is malformed, or contains no robot.
    """
    if not text.startswith(PREFIX):
        return None
    match = _NAME.fullmatch(text)
    if match is None:
        names = ", ".join(repr(PREFIX + name) for name in SPLITS)
        raise ConfigError(
            f"robot = {show_value(text)}: must be like 'drawn:17', 'drawn:0-63' or {names}"
        )

    first, last, split = match.groups()
    # Named splits hold robots out for validation and tests.
    if split:
        return SPLITS[split]
    numbers = range(int(first), int(last or first) + 1)
    if not numbers:
        raise ConfigError(f"robot = {show_value(text)}: holds no robot")
    return numbers


def draw_robot(number: int) -> dict[str, Any]:
    """Return the fields of a drawn robot.

    All numbers are rounded, so that the last digits of a machine's logarithm don't matter. The
    order of the draws defines the robots: don't change it.
    """
    rng = np.random.default_rng([crc32(b"drawn"), number])

    def draw(low: float, high: float) -> float:
        return round(float(rng.uniform(low, high)), 4)

    def draw_factor(low: float, high: float) -> float:
        return round(math.exp(rng.uniform(math.log(low), math.log(high))), 4)

    # Outline.
    radius = RADII[int(rng.integers(len(RADII)))]
    is_round = rng.random() < 0.35 and radius < LARGEST_CIRCLE
    aspect = draw(0.62, 1.0)
    length = width = 2.0 * radius
    if not is_round:
        length = round(2.0 * radius / math.hypot(1.0, aspect), 3)
        width = _fit_width(length, radius)

    # Wheels.
    wheel = round(length * (draw(0.08, 0.14) if is_round else draw(0.11, 0.19)), 4)
    separation = round(width * (draw(0.55, 0.68) if is_round else draw(0.8, 0.92)), 4)
    wheelbase = round(length * (draw(0.3, 0.45) if is_round else draw(0.45, 0.66)), 4)
    height = round(length * draw(0.3, 0.5), 3)
    turn_factor = draw(1.2, 2.0)

    # Top speeds, as far as the wheels allow. The rim's speed is that of a turn on the spot [m/s].
    linear = draw_factor(0.3, 2.0)
    angular = draw_factor(0.8, 4.0)
    rim = angular * separation * turn_factor / 2.0
    fastest = max(linear, rim, 0.7 * (linear + rim)) * draw(1.1, 1.6) / wheel
    fastest = round(min(fastest, WIRE_SPEED), 3)
    top = 0.9 * fastest * wheel
    linear = min(linear, round(top, 4))
    angular = min(angular, round(angular * top / rim, 4))

    # Accelerations, by the times in which limits and motors reach the top speed.
    linear_acceleration = min(linear / draw_factor(0.1, 0.8), 20.0)
    angular_acceleration = angular / draw_factor(0.12, 0.6)
    motor_acceleration = max(max(linear, rim) / draw_factor(0.12, 0.5), 1.2) / wheel

    # The LiDAR sees ahead, from the front, or all around, then half of the time from the middle.
    view = FIELDS_OF_VIEW[int(rng.integers(10))]
    ahead = draw(-0.4, 0.4)
    aside = draw(-0.15, 0.15)
    if view < FULL_VIEW:
        ahead = abs(ahead)
    elif rng.random() >= 0.5:
        ahead *= 0.0  # which keeps the sign
    return {
        "name": f"{PREFIX}{number}",
        "wheel_radius": wheel,
        "wheel_separation": separation,
        "wheelbase": wheelbase,
        "wheel_separation_multiplier": turn_factor,
        "max_linear": linear,
        "max_angular": angular,
        "max_wheel_speed": fastest,
        "linear_limits": {"max_acceleration": round(linear_acceleration, 3)},
        "angular_limits": {"max_acceleration": round(angular_acceleration, 3)},
        "footprint": make_circle(radius) if is_round else None,
        "lidar_x_offset": round(length * ahead, 3),
        "lidar_y_offset": round(width * aside * float(rng.random() < 0.3), 3),
        "lidar_z_offset": round(height + 0.1, 3),
        "motor": {
            "max_speed": fastest,
            "acceleration": round(motor_acceleration, 2),
            "time_constant": draw(0.03, 0.15),
        },
        "firmware": {"command_delay": draw(0.0, 0.04)},
        "body": {
            "length": length,
            "width": width,
            "height": height,
            "mass": round(length * width * draw_factor(30.0, 90.0), 2),
            "turn_factor": turn_factor,
        },
        "lidar": {
            "field_of_view": view,
            "max_range": round(draw(3.5, 12.0), 1),
            "rate": round(draw(5.0, 15.0), 1),
            "rays": RAYS,
        },
    }


def _fit_width(length: float, radius: float) -> float:
    """Width of a rectangle whose corners are at exactly this distance from its middle [m]."""
    half = length / 2.0
    half_width = math.sqrt(radius * radius - length * length / 4.0)
    # Rounding may miss the radius by the last bit, which worlds are made for.
    while math.hypot(half, half_width) < radius:
        half_width = math.nextafter(half_width, math.inf)
    while math.hypot(half, half_width) > radius:
        half_width = math.nextafter(half_width, 0.0)
    return 2.0 * half_width
