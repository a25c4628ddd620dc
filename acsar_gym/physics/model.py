"""Motor and tyre model of a skid-steer robot on a flat floor, as pure scalar functions.

The planar state is (vx, vy [m/s], yaw rate [rad/s]) in the body frame. Wheels are in the order
front_right, front_left, rear_left, rear_right. Tyres have Coulomb friction under equal loads,
smoothed below a small slip speed: a contact patch that slips with (s_x, s_y) over the ground gets
F = -grip (s_x, kappa s_y) / sqrt(s_x^2 + kappa s_y^2). With kappa = (mu_lateral /
mu_longitudinal)^2 this is a friction ellipse whose force dissipates most for its size. Kappa 1 is
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

Velocity = tuple[float, float, float]
"""vx, vy [m/s] and yaw rate [rad/s], or three axes [m/s, rad/s]."""
Quaternion = tuple[float, float, float, float]
"""Orientation (x, y, z, w)."""
Motion = tuple[Velocity, Quaternion, Velocity, Velocity]
"""Position [m], orientation, velocity [m/s] and spin [rad/s], in the frame of the world."""


def loop_period(config: RobotConfig) -> float:
    """Return the period of the firmware loop, which is also the step of the physics [s]."""
    return 1.0 / config.firmware.loop_rate


@jit
def whole_loops(time: float, dt: float) -> float:
    """Return the firmware loops until something is used that is available after a time [s]."""
    # Without the slack, rounding would add a loop to times that are whole loops.
    loops: float = np.ceil(time / dt - 1e-6)
    return loops


def wire_loops(config: RobotConfig, command_delay: float = 0.0) -> int:
    """Return the firmware loops from sending a line until it is used, without extra latency."""
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


@loop
def read_encoders(
    first: Speeds, last: Speeds, per_radian: float, per_count: float, quantum: float
) -> Speeds:
    """Measure the speeds of four wheels [rad/s] from their angles around a window of time [rad].

    Args:
        first: Angles at the start of the window.
        last: Angles at its end.
        per_radian: Counts of an encoder per radian.
        per_count: Speed for a count in the window [rad/s].
        quantum: Speeds are multiples of this [rad/s], or 0 for speeds as measured.
    """
    speeds = np.empty(4)
    for wheel in range(4):
        # An encoder counts whole steps: the difference of two angles would be too exact.
        counts = math.floor(last[wheel] * per_radian) - math.floor(first[wheel] * per_radian)
        speeds[wheel] = counts * per_count
        if quantum > 0.0:
            speeds[wheel] = round_printed(speeds[wheel], quantum)
    return speeds[0], speeds[1], speeds[2], speeds[3]


def turn_factor(config: RobotConfig) -> float:
    """Return the factor by which a robot turns slower than the differential-drive formula."""
    return config.body.turn_factor or 1.0 + (config.wheelbase / config.wheel_separation) ** 2


def compute_physics(config: RobotConfig) -> Physics:
    """Return the physics of a robot from its configuration, nothing randomized.

    Args:
        config: Robot configuration.
    """
    body = config.body
    dt = loop_period(config)
    left_radius, right_radius = config.wheel_radii
    factor = body.turn_factor
    # Both as ratios of the same two lengths, in which the model's equations are written.
    across = config.wheel_separation / config.wheelbase
    motors: dict[str, float] = {}
    # A lag becomes the share of the way to the set point in a firmware loop.
    for number, wheel in enumerate("abcd"):
        motor = config.motor.of_wheel(number)
        lag = motor.time_constant
        motors[f"deadband_{wheel}"] = motor.deadband
        motors[f"blend_{wheel}"] = 1.0 - math.exp(-dt / lag) if lag > 0.0 else 1.0
        motors[f"gain_{wheel}"] = motor.gain

    return Physics(
        left_radius=left_radius,
        right_radius=right_radius,
        half_wheelbase=config.wheelbase / 2.0,
        half_track=config.wheel_separation / 2.0,
        mass=body.mass,
        # That of a box with evenly spread mass, about the vertical axis [kg m^2].
        yaw_inertia=body.mass * (body.length**2 + body.width**2) / 12.0,
        # Each tyre carries a quarter of the weight [N].
        grip=body.friction * body.mass * GRAVITY / 4.0,
        # Isotropic friction makes the robot turn slower by 1 + (wheelbase / separation)^2. Another
        # measured turn factor is explained by tyres with less or more grip to the side.
        kappa=1.0 if factor is None else (factor - 1.0) * across**2,
        slip_speed=body.slip_speed,
        max_speed=config.motor.max_speed,
        **motors,
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

    # A motor saturates after its gain, so a strong motor reaches its top speed earlier.
    set_point = min(max(set_point, -top), top)
    speed += blend * (set_point - speed)
    # A first-order lag never reaches 0: below 1 mrad/s a stopping wheel is at rest.
    return 0.0 if set_point == 0.0 and abs(speed) < 1e-3 else speed


@jit
def turn_wheels(wheels: Speeds, set_points: Speeds, physics: Any) -> Speeds:
    """Compute the speeds of four wheels one substep later [rad/s]."""
    top = physics.max_speed

    return (
        wheel_speed(
            wheels[0],
            set_points[0],
            physics.gain_a,
            blend=physics.blend_a,
            deadband=physics.deadband_a,
            top=top,
        ),
        wheel_speed(
            wheels[1],
            set_points[1],
            physics.gain_b,
            blend=physics.blend_b,
            deadband=physics.deadband_b,
            top=top,
        ),
        wheel_speed(
            wheels[2],
            set_points[2],
            physics.gain_c,
            blend=physics.blend_c,
            deadband=physics.deadband_c,
            top=top,
        ),
        wheel_speed(
            wheels[3],
            set_points[3],
            physics.gain_d,
            blend=physics.blend_d,
            deadband=physics.deadband_d,
            top=top,
        ),
    )


@jit
def tyre_step(
    vx: float, vy: float, yaw_rate: float, wheels: Speeds, physics: Any, kappa: float, dt: float
) -> Velocity:
    """Compute the velocity (body frame) one substep later, under the forces of four tyres.

    Solves m (v' - v) / dt = sum F_i(v') with F_i = -D_i (s_x, kappa s_y), D_i = grip /
    sqrt(s_x^2 + kappa s_y^2), in which (s_x, s_y)(v') is the velocity of contact patch i over the
    ground. `wheels` are in [rad/s], `physics` has fields of a `Physics`. `kappa` is that of the
    physics, or the constant 1, with which compiled code is faster.
    """
    a = physics.half_wheelbase
    b = physics.half_track
    # By the time step: the solution is that of an implicit Euler step.
    inertia = physics.mass / dt
    yaw_inertia = physics.yaw_inertia / dt
    grip = physics.grip
    # Below the slip speed friction is viscous, which avoids a division by 0 at rest.
    floor = physics.slip_speed * physics.slip_speed
    # Speeds of the wheels' surfaces: a and d are on the right.
    rim_a = wheels[0] * physics.right_radius
    rim_b = wheels[1] * physics.left_radius
    rim_c = wheels[2] * physics.left_radius
    rim_d = wheels[3] * physics.right_radius

    # The unknown velocity starts at the present velocity.
    nx = vx
    ny = vy
    nw = yaw_rate
    for _ in range(FRICTION_ROUNDS):
        # Secant friction of each tyre at the velocity of the last round.
        right_speed = nx + nw * b
        left_speed = nx - nw * b
        front = ny + nw * a
        rear = ny - nw * a
        d_a = grip / math.sqrt(max((right_speed - rim_a) ** 2 + kappa * front**2, floor))
        d_b = grip / math.sqrt(max((left_speed - rim_b) ** 2 + kappa * front**2, floor))
        d_c = grip / math.sqrt(max((left_speed - rim_c) ** 2 + kappa * rear**2, floor))
        d_d = grip / math.sqrt(max((right_speed - rim_d) ** 2 + kappa * rear**2, floor))
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

        # The system is an arrow matrix: eliminate nx and ny, solve for nw, substitute back.
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
        cos: Cosine of the heading.
        sin: Sine of the heading.
        velocity: Velocities vx, vy [m/s] in the world frame, yaw rate [rad/s].
        wheels: Speeds of the four wheels [rad/s].
        angles: Angles turned by the four wheels [rad].
        set_points: Set points of the firmware [rad/s].
        physics: Physics of the robot, a record of `Physics`.
        dt: Substep [s].

    Returns:
        The new velocity, wheel speeds and wheel angles.
    """
    robot = physics[0]
    a, b, c, d = turn_wheels(wheels, set_points, robot)

    vx, vy, rate = velocity
    # Tyres push along the axes of the body, but velocities are in the world frame.
    forward, sideways, rate = tyre_step(
        cos * vx + sin * vy,
        cos * vy - sin * vx,
        rate,
        wheels=(a, b, c, d),
        physics=robot,
        kappa=robot.kappa,
        dt=dt,
    )
    return (
        (cos * forward - sin * sideways, sin * forward + cos * sideways, rate),
        (a, b, c, d),
        (angles[0] + a * dt, angles[1] + b * dt, angles[2] + c * dt, angles[3] + d * dt),
    )


@jit
def heading_of(orientation: Quaternion) -> tuple[float, float]:
    """Return cosine and sine of the heading of a robot on a floor."""
    qx, qy, qz, qw = orientation
    # The body's x axis, seen from above. On a flat floor its length is nearly 1.
    return 1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qw * qz + qx * qy)


@loop
def push_robot(
    orientation: Quaternion,
    velocity: Velocity,
    spin: Velocity,
    wheels: Speeds,
    angles: Speeds,
    set_points: Speeds,
    physics: Any,
    dt: float,
) -> tuple[Velocity, Velocity, Speeds, Speeds]:
    """`robot_step` for an engine that moves the chassis itself, by a force [N] and a torque [Nm].

    Orientation, velocity [m/s], spin [rad/s], force and torque are in the world frame.
    """
    cos, sin = heading_of(orientation)
    vx, vy, _ = velocity
    rate = spin[2]
    (new_vx, new_vy, new_rate), wheels, angles = robot_step(
        cos,
        sin,
        (vx, vy, rate),
        wheels=wheels,
        angles=angles,
        set_points=set_points,
        physics=physics,
        dt=dt,
    )

    push = physics[0].mass / dt
    twist = physics[0].yaw_inertia / dt

    # The force that changes the velocity as the tyres would, in this substep.
    force = (push * (new_vx - vx), push * (new_vy - vy), 0.0)
    return force, (0.0, 0.0, twist * (new_rate - rate)), wheels, angles


@loop
def motor_power(cos: float, sin: float, velocity: Velocity, wheels: Speeds, physics: Any) -> float:
    """Compute the power that the motors give to the ground at this moment [W].

    P = sum over wheels of max(0, F_i r_i w_i), in which r_i w_i is the speed of the wheel's
    surface and F_i = -D_i s_x the force of its tyre along the rolling direction, with D_i and the
    slip (s_x, s_y) of this file. A wheel that is pushed by the ground brakes, and its motor
    recovers nothing. Losses inside the motors are not known.
    """
    robot = physics[0]
    vx, vy, rate = velocity
    ahead = cos * vx + sin * vy
    aside = cos * vy - sin * vx
    power = 0.0
    for wheel in range(4):
        on_right = wheel in (0, 3)
        in_front = wheel < 2
        rim = wheels[wheel] * (robot.right_radius if on_right else robot.left_radius)

        # The contact patch moves with the body, and the rim moves against it.
        slip = ahead + (rate if on_right else -rate) * robot.half_track - rim
        across = aside + (rate if in_front else -rate) * robot.half_wheelbase
        size = max(math.sqrt(slip * slip + robot.kappa * across * across), robot.slip_speed)
        power += max(0.0, -robot.grip * slip / size * rim)
    return power
