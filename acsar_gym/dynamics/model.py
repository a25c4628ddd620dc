"""Motor and tyre model of a skid-steer robot on a flat floor, as pure scalar functions.

The planar state is (vx, vy [m/s], yaw rate [rad/s]) in the body frame; wheels are in the order
front_right, front_left, rear_left, rear_right. Tyres are isotropic Coulomb friction under equal
loads, smoothed below a small slip speed. That law is stiff, so it is solved implicitly: backward
Euler with secant friction, a symmetric 3 x 3 system per fixed-point round. In a steady turn the
exact solution turns 1 + (wheelbase / wheel_separation)^2 times slower than the differential-drive
formula says.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import BITS_PER_BYTE, LINE_BYTES, RobotConfig
from acsar_gym.jit import COMPILED, jit, leading
from acsar_gym.protocol import Speeds

GRAVITY = 9.81
"""[m/s^2]"""
ROUNDS = 3
"""Fixed-point rounds for the secant friction."""

Velocity = tuple[float, float, float]
"""vx, vy [m/s] and yaw rate [rad/s]."""


class Physics(NamedTuple):
    """The numbers of one robot that its physics needs; SI units, wheels a to d in wheel order.

    Any of them may vary from episode to episode; see `randomization`.
    """

    radius: float
    half_wheelbase: float
    half_track: float
    mass: float
    yaw_inertia: float
    grip: float
    """Greatest friction force of one tyre [N]."""
    slip_speed: float
    max_speed: float
    deadband: float
    blend_a: float
    """Share of the distance to its set point that a wheel's speed covers in a loop of the board."""
    blend_b: float
    blend_c: float
    blend_d: float
    gain_a: float
    """A wheel's speed for its set point."""
    gain_b: float
    gain_c: float
    gain_d: float
    latency_loops: float
    """Delay of commands and of feedback beyond the wire's own, in loops of the board."""
    feedback_loops: float
    """Loops of the board from one feedback line to the next."""


SIZE = len(Physics._fields)
Numbers = NDArray[np.float64] | Sequence[float]


@jit
def physics_of(numbers: Numbers) -> Physics:
    """The numbers with their names."""
    return Physics(*leading(numbers, SIZE))


@jit
def physics_at(rows: NDArray[np.float64], i: int) -> Physics:
    """Physics of robot i of many: column i of an array that has a row for each number.

    The index is unsigned so that no negative one has to be looked for: loops over robots vectorise.
    """
    k = np.uintp(i)
    return Physics(
        rows[0, k],
        rows[1, k],
        rows[2, k],
        rows[3, k],
        rows[4, k],
        rows[5, k],
        rows[6, k],
        rows[7, k],
        rows[8, k],
        rows[9, k],
        rows[10, k],
        rows[11, k],
        rows[12, k],
        rows[13, k],
        rows[14, k],
        rows[15, k],
        rows[16, k],
        rows[17, k],
        rows[18, k],
    )


def numbers_of(own: Physics) -> Numbers:
    """What `robot_step` takes: an array is quick to hand to compiled code, a tuple without it."""
    return np.array(own, np.float64) if COMPILED else tuple(own)


def substep(config: RobotConfig) -> float:
    """The firmware's loop period, in which physics advances [s]."""
    return 1.0 / config.firmware.loop_rate


def wire_loops(config: RobotConfig) -> int:
    """Loops of the firmware that a line takes from its being sent until it is used."""
    line = (LINE_BYTES + config.trailing_comma) * BITS_PER_BYTE / config.baud_rate
    return math.ceil((line + config.firmware.processing_time) / substep(config) - 1e-6)


def physics(config: RobotConfig) -> Physics:
    """The physics of a robot as it is configured."""
    body, motor = config.body, config.motor
    dt, lag = substep(config), motor.time_constant
    blend = 1.0 - math.exp(-dt / lag) if lag > 0.0 else 1.0
    return Physics(
        radius=config.wheel_radius,
        half_wheelbase=config.wheelbase / 2.0,
        half_track=config.wheel_separation / 2.0,
        mass=body.mass,
        yaw_inertia=body.mass * (body.length**2 + body.width**2) / 12.0,
        grip=body.friction * body.mass * GRAVITY / 4.0,
        slip_speed=body.slip_speed,
        max_speed=motor.max_speed,
        deadband=motor.deadband,
        blend_a=blend,
        blend_b=blend,
        blend_c=blend,
        blend_d=blend,
        gain_a=1.0,
        gain_b=1.0,
        gain_c=1.0,
        gain_d=1.0,
        latency_loops=0.0,
        feedback_loops=config.firmware.loop_rate / config.feedback_rate,
    )


@jit
def wheel_speed(speed: float, set_point: float, gain: float, blend: float, own: Physics) -> float:
    """A wheel's speed [rad/s] one substep later: gain, deadband, saturation, first-order lag."""
    set_point *= gain
    if abs(set_point) < own.deadband:
        set_point = 0.0
    set_point = min(max(set_point, -own.max_speed), own.max_speed)
    speed += blend * (set_point - speed)
    return 0.0 if set_point == 0.0 and abs(speed) < 1e-3 else speed


@jit
def towards(value: float, target: float, step: float) -> float:
    """The value moved to the target by at most one step."""
    return min(max(target, value - step), value + step)


@jit
def ramped(set_points: Speeds, targets: Speeds, step: float) -> Speeds:
    """Four set points [rad/s], each moved to its target by at most one step."""
    return (
        towards(set_points[0], targets[0], step),
        towards(set_points[1], targets[1], step),
        towards(set_points[2], targets[2], step),
        towards(set_points[3], targets[3], step),
    )


@jit
def tyre_step(
    vx: float,
    vy: float,
    yaw_rate: float,
    wheels: Speeds,
    own: Physics,
    dt: float,
) -> Velocity:
    """The body's velocity one substep later, under the forces of four tyres. Body frame.

    Solves m (v' - v) / dt = sum F_i(v') with F_i = -D_i slip_i(v') and D_i = grip / |slip_i|, in
    which slip_i is the velocity of contact patch i over the ground.
    """
    a, b = own.half_wheelbase, own.half_track
    inertia, yaw_inertia = own.mass / dt, own.yaw_inertia / dt
    rim_a, rim_b = wheels[0] * own.radius, wheels[1] * own.radius
    rim_c, rim_d = wheels[2] * own.radius, wheels[3] * own.radius
    nx, ny, nw = vx, vy, yaw_rate
    floor = own.slip_speed * own.slip_speed
    for _ in range(ROUNDS):
        right, left = nx + nw * b, nx - nw * b
        front, rear = ny + nw * a, ny - nw * a
        d_a = own.grip / math.sqrt(max((right - rim_a) ** 2 + front**2, floor))
        d_b = own.grip / math.sqrt(max((left - rim_b) ** 2 + front**2, floor))
        d_c = own.grip / math.sqrt(max((left - rim_c) ** 2 + rear**2, floor))
        d_d = own.grip / math.sqrt(max((right - rim_d) ** 2 + rear**2, floor))
        total = d_a + d_b + d_c + d_d
        # Symmetric system [[k, 0, p], [0, k, q], [p, q, s]] (nx, ny, nw) = (fx, fy, fw).
        k = inertia + total
        p = b * (d_a + d_d - d_b - d_c)
        q = a * (d_a + d_b - d_c - d_d)
        s = yaw_inertia + (a * a + b * b) * total
        fx = inertia * vx + d_a * rim_a + d_b * rim_b + d_c * rim_c + d_d * rim_d
        fy = inertia * vy
        fw = yaw_inertia * yaw_rate + b * (d_a * rim_a + d_d * rim_d - d_b * rim_b - d_c * rim_c)
        free = 1.0 / k
        nw = (fw - (p * fx + q * fy) * free) / (s - (p * p + q * q) * free)
        nx = (fx - p * nw) * free
        ny = (fy - q * nw) * free
    return nx, ny, nw


@jit
def robot_step(
    cos: float,
    sin: float,
    velocity: Velocity,
    wheels: Speeds,
    angles: Speeds,
    set_points: Speeds,
    numbers: Numbers,
    dt: float,
) -> tuple[Velocity, Speeds, Speeds]:
    """Motors, then tyres, over one substep, for a robot whose heading has this cosine and sine.

    `velocity` is (vx, vy [m/s], yaw rate [rad/s]) in the world frame, before and after. Returns it
    with the new wheel speeds [rad/s] and the angles turned by the wheels [rad]. `numbers` are those
    of its `Physics`, see `numbers_of`.
    """
    own = physics_of(numbers)
    a = wheel_speed(wheels[0], set_points[0], own.gain_a, own.blend_a, own)
    b = wheel_speed(wheels[1], set_points[1], own.gain_b, own.blend_b, own)
    c = wheel_speed(wheels[2], set_points[2], own.gain_c, own.blend_c, own)
    d = wheel_speed(wheels[3], set_points[3], own.gain_d, own.blend_d, own)
    vx, vy, rate = velocity
    forward, left, rate = tyre_step(
        cos * vx + sin * vy, cos * vy - sin * vx, rate, (a, b, c, d), own, dt
    )
    return (
        (cos * forward - sin * left, sin * forward + cos * left, rate),
        (a, b, c, d),
        (angles[0] + a * dt, angles[1] + b * dt, angles[2] + c * dt, angles[3] + d * dt),
    )


def closed_form_yaw_rate(speeds: Speeds, config: RobotConfig) -> float:
    """Yaw rate [rad/s] of a steady turn with constant wheel speeds, neglecting inertia."""
    right, left = (speeds[0] + speeds[3]) / 2.0, (speeds[1] + speeds[2]) / 2.0
    plain = (right - left) * config.wheel_radius / config.wheel_separation
    return plain / (1.0 + (config.wheelbase / config.wheel_separation) ** 2)
