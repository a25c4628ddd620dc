"""Motor and tyre model of a skid-steer robot on a flat floor, as pure scalar functions.

The planar state is (vx, vy [m/s], yaw rate [rad/s]) in the body frame; wheels are in the order
front_right, front_left, rear_left, rear_right. Tyres have Coulomb friction under equal loads,
smoothed below a small slip speed: a contact patch that slips with (s_x, s_y) over the ground gets
F = -grip (s_x, kappa s_y) / sqrt(s_x^2 + kappa s_y^2). With kappa = (mu_lateral /
mu_longitudinal)^2 this is a friction ellipse whose force dissipates most for its size; kappa = 1 is
isotropic friction. That law is stiff, so it is solved implicitly: backward Euler with secant
friction, a symmetric 3 x 3 system per fixed-point round. In a steady turn the exact solution turns
1 + kappa (wheelbase / wheel_separation)^2 times slower than the differential-drive formula says.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.config.physics import Physics
from acsar_gym.jit import jit, loop
from acsar_gym.protocol import Speeds

GRAVITY = 9.81
"""Acceleration of gravity [m/s^2]."""
FRICTION_ROUNDS = 3
"""Fixed-point iterations for the secant friction."""

Velocity = tuple[float, float, float]  # vx, vy [m/s] and yaw rate [rad/s]


def loop_period(config: RobotConfig) -> float:
    """Period of the firmware loop, which is also the step of the physics [s]."""
    return 1.0 / config.firmware.loop_rate


@jit
def whole_loops(time: float, dt: float) -> float:
    """Firmware loops until something is used that is there after `time` [s]."""
    loops: float = np.ceil(time / dt - 1e-6)
    return loops


def wire_loops(config: RobotConfig, command_delay: float = 0.0) -> int:
    """Firmware loops from sending a line until it is used, without extra latency."""
    return int(whole_loops(config.wire_time + command_delay, loop_period(config)))


@jit
def move_towards(value: float, target: float, step: float) -> float:
    """Move a value towards a target by at most `step`."""
    return min(max(target, value - step), value + step)


@loop
def ramp_set_points(set_points: Speeds, targets: Speeds, steps: Speeds) -> Speeds:
    """Move four set points [rad/s] towards their targets by at most their `steps`."""
    return (
        move_towards(set_points[0], targets[0], steps[0]),
        move_towards(set_points[1], targets[1], steps[1]),
        move_towards(set_points[2], targets[2], steps[2]),
        move_towards(set_points[3], targets[3], steps[3]),
    )


@loop
def round_printed(speed: float, quantum: float) -> float:
    """Round a measured speed [rad/s] to a multiple of the quantum.

    The last factor makes multiples that lie halfway between two numbers of two decimals round
    alike as text and in compiled code.
    """
    multiple: float = np.rint(speed / quantum) * quantum
    return multiple * (1.0 + 1e-12)


def turn_factor(config: RobotConfig) -> float:
    """Factor by which the robot turns slower than the differential-drive formula says."""
    return config.body.turn_factor or 1.0 + (config.wheelbase / config.wheel_separation) ** 2


def compute_physics(config: RobotConfig) -> Physics:
    """Return the physics of a robot from its configuration, nothing randomized.

    Args:
        config: of the robot.
    """
    body, dt = config.body, loop_period(config)
    motors = [config.motor.of_wheel(wheel) for wheel in range(4)]
    lags = [motor.time_constant for motor in motors]
    blends = [1.0 - math.exp(-dt / lag) if lag > 0.0 else 1.0 for lag in lags]
    left, right = config.wheel_radii
    factor, across = body.turn_factor, config.wheel_separation / config.wheelbase
    return Physics(
        left_radius=left,
        right_radius=right,
        half_wheelbase=config.wheelbase / 2.0,
        half_track=config.wheel_separation / 2.0,
        mass=body.mass,
        yaw_inertia=body.mass * (body.length**2 + body.width**2) / 12.0,
        grip=body.friction * body.mass * GRAVITY / 4.0,
        kappa=1.0 if factor is None else (factor - 1.0) * across**2,
        slip_speed=body.slip_speed,
        max_speed=config.motor.max_speed,
        **{f"deadband_{w}": motor.deadband for w, motor in zip("abcd", motors, strict=True)},
        **{f"blend_{w}": blend for w, blend in zip("abcd", blends, strict=True)},
        **{f"gain_{w}": motor.gain for w, motor in zip("abcd", motors, strict=True)},
        latency_loops=0.0,
        command_delay=config.firmware.command_delay,
        feedback_loops=config.firmware.loop_rate / config.feedback_rate,
        scan_rate=config.lidar.rate,
        range_noise=config.lidar.noise,
        range_bias=config.lidar.bias,
        range_dropouts=config.lidar.dropouts,
        range_outliers=config.lidar.outliers,
    )


@jit
def wheel_speed(
    speed: float, set_point: float, gain: float, blend: float, deadband: float, top: float
) -> float:
    """Compute a wheel's speed one substep later: gain, deadband, saturation, first-order lag."""
    set_point *= gain
    if abs(set_point) < deadband:
        set_point = 0.0
    set_point = min(max(set_point, -top), top)
    speed += blend * (set_point - speed)
    return 0.0 if set_point == 0.0 and abs(speed) < 1e-3 else speed


@jit
def tyre_step(
    vx: float, vy: float, yaw_rate: float, wheels: Speeds, own: Any, kappa: float, dt: float
) -> Velocity:
    """Velocity (body frame) one substep later, under the forces of four tyres; wheels in [rad/s].

    Solves m (v' - v) / dt = sum F_i(v') with F_i = -D_i (s_x, kappa s_y), D_i = grip /
    sqrt(s_x^2 + kappa s_y^2), in which (s_x, s_y)(v') is the velocity of contact patch i over the
    ground. `own` has fields of a `Physics`. `kappa` is its own, or the constant 1, with which
    compiled code is faster.
    """
    a, b = own.half_wheelbase, own.half_track
    inertia, yaw_inertia = own.mass / dt, own.yaw_inertia / dt
    rim_a, rim_b = wheels[0] * own.right_radius, wheels[1] * own.left_radius
    rim_c, rim_d = wheels[2] * own.left_radius, wheels[3] * own.right_radius
    nx, ny, nw = vx, vy, yaw_rate
    floor = own.slip_speed * own.slip_speed
    for _ in range(FRICTION_ROUNDS):
        right, left = nx + nw * b, nx - nw * b
        front, rear = ny + nw * a, ny - nw * a
        d_a = own.grip / math.sqrt(max((right - rim_a) ** 2 + kappa * front**2, floor))
        d_b = own.grip / math.sqrt(max((left - rim_b) ** 2 + kappa * front**2, floor))
        d_c = own.grip / math.sqrt(max((left - rim_c) ** 2 + kappa * rear**2, floor))
        d_d = own.grip / math.sqrt(max((right - rim_d) ** 2 + kappa * rear**2, floor))
        total = d_a + d_b + d_c + d_d
        # Symmetric system [[k, 0, p], [0, k / y, q], [p, q, s]] (nx, ny, nw) = (fx, fy, fw).
        k = inertia + total
        y = 1.0 if kappa == 1.0 else k / (inertia + kappa * total)
        p = b * (d_a + d_d - d_b - d_c)
        q = kappa * a * (d_a + d_b - d_c - d_d)
        s = yaw_inertia + (kappa * a * a + b * b) * total
        fx = inertia * vx + d_a * rim_a + d_b * rim_b + d_c * rim_c + d_d * rim_d
        fy = inertia * vy
        fw = yaw_inertia * yaw_rate + b * (d_a * rim_a + d_d * rim_d - d_b * rim_b - d_c * rim_c)
        free = 1.0 / k
        nw = (fw - (p * fx + y * q * fy) * free) / (s - (p * p + y * q * q) * free)
        nx = (fx - p * nw) * free
        ny = (fy - q * nw) * free * y
    return nx, ny, nw


@loop
def robot_step(
    cos: float,
    sin: float,
    velocity: Velocity,
    wheels: Speeds,
    angles: Speeds,
    set_points: Speeds,
    physics: Any,
    dt: float,
) -> tuple[Velocity, Speeds, Speeds]:
    """Advance motors, then tyres, by one substep.

    Args:
        cos: of the heading.
        sin: of the heading.
        velocity: vx, vy [m/s] in the world frame, yaw rate [rad/s].
        wheels: speeds of the four wheels [rad/s].
        angles: turned by the four wheels [rad].
        set_points: of the firmware [rad/s].
        physics: of the robot, a record of `Physics`.
        dt: substep [s].

    Returns:
        The new velocity, wheel speeds and wheel angles.
    """
    own = physics[0]
    top = own.max_speed
    a = wheel_speed(wheels[0], set_points[0], own.gain_a, own.blend_a, own.deadband_a, top)
    b = wheel_speed(wheels[1], set_points[1], own.gain_b, own.blend_b, own.deadband_b, top)
    c = wheel_speed(wheels[2], set_points[2], own.gain_c, own.blend_c, own.deadband_c, top)
    d = wheel_speed(wheels[3], set_points[3], own.gain_d, own.blend_d, own.deadband_d, top)
    vx, vy, rate = velocity
    forward, left, rate = tyre_step(
        cos * vx + sin * vy, cos * vy - sin * vx, rate, (a, b, c, d), own, own.kappa, dt
    )
    return (
        (cos * forward - sin * left, sin * forward + cos * left, rate),
        (a, b, c, d),
        (angles[0] + a * dt, angles[1] + b * dt, angles[2] + c * dt, angles[3] + d * dt),
    )


@loop
def push_robot(
    orientation: tuple[float, float, float, float],
    velocity: Velocity,
    spin: Velocity,
    wheels: Speeds,
    angles: Speeds,
    set_points: Speeds,
    physics: Any,
    dt: float,
) -> tuple[Velocity, Velocity, Speeds, Speeds]:
    """`robot_step` for an engine that moves the chassis itself, by a force [N] and a torque [Nm].

    Orientation (x, y, z, w), velocity [m/s], spin [rad/s], force and torque are in the world frame.
    """
    qx, qy, qz, qw = orientation
    cos, sin = 1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qw * qz + qx * qy)
    vx, vy, rate = velocity[0], velocity[1], spin[2]
    (new_vx, new_vy, new_rate), wheels, angles = robot_step(
        cos, sin, (vx, vy, rate), wheels, angles, set_points, physics, dt
    )
    push, twist = physics[0].mass / dt, physics[0].yaw_inertia / dt
    force = push * (new_vx - vx), push * (new_vy - vy), 0.0
    return force, (0.0, 0.0, twist * (new_rate - rate)), wheels, angles


def closed_form_yaw_rate(speeds: Speeds, config: RobotConfig) -> float:
    """Yaw rate [rad/s] of a steady turn with constant wheel speeds [rad/s], neglecting inertia."""
    right, left = (speeds[0] + speeds[3]) / 2.0, (speeds[1] + speeds[2]) / 2.0
    left_radius, right_radius = config.wheel_radii
    plain = (right * right_radius - left * left_radius) / config.wheel_separation
    return plain / turn_factor(config)


# Mechanical power of a robot's motors, by the tyre forces of this file.


@loop
def motor_power(cos: float, sin: float, velocity: Velocity, wheels: Speeds, physics: Any) -> float:
    """Compute the power that the motors give to the ground at this moment [W].

    P = sum over wheels of max(0, F_i r_i w_i), in which r_i w_i is the speed of the wheel's
    surface and F_i = -D_i s_x the force of its tyre along the rolling direction, with D_i and the
    slip (s_x, s_y) of this file. A wheel that is pushed by the ground brakes; its motor
    recovers nothing. Losses inside the motors are not known.
    """
    own = physics[0]
    vx, vy, rate = velocity
    ahead, aside = cos * vx + sin * vy, cos * vy - sin * vx
    power = 0.0
    for k in range(4):
        on_right, in_front = k in (0, 3), k < 2
        rim = wheels[k] * (own.right_radius if on_right else own.left_radius)
        slip = ahead + (rate if on_right else -rate) * own.half_track - rim
        across = aside + (rate if in_front else -rate) * own.half_wheelbase
        size = max(math.sqrt(slip * slip + own.kappa * across * across), own.slip_speed)
        power += max(0.0, -own.grip * slip / size * rim)
    return power
