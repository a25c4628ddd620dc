"""One env step of many planar robots, tick by tick: commands, board, motors, tyres and odometry.

Every tick's command is kept in a ring until the board uses it, see `layout.Tables.commands`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from acsar_gym import kinematics, odometry
from acsar_gym.jit import jit, loop
from acsar_gym.physics.model import (
    motor_power,
    move_towards,
    round_printed,
    tyre_step,
    wheel_speed,
)
from acsar_gym.protocol import MAX_SPEED
from acsar_gym.safety.rules import SafetyMemory, compute_wheels, explain_sent, limit_twist
from acsar_gym.trigonometry import sincos
from acsar_gym.vector.kernel.crowds import advance_movers, mark_movers, survey_movers
from acsar_gym.vector.kernel.layout import (
    BLOCK_ROBOTS,
    LEFT,
    RIGHT,
    TURN,
    Crowds,
    Floats,
    Records,
    Robots,
    Scans,
    Setup,
    Tables,
    robots_of_block,
    rules_of,
)
from acsar_gym.vector.kernel.lidars import check_contacts, mark_trails

forward = jit(kinematics.compute_twist)
integrate = jit(odometry.integrate_twist)


@jit
def round_as_sent(speed: float) -> float:
    """A wheel speed [rad/s] after encoding and decoding: two decimals, saturated."""
    rounded: float = np.rint(speed * 100.0) / 100.0
    return min(max(rounded, -MAX_SPEED), MAX_SPEED)


@jit
def limit_twists(robots: Robots, count: int, setup: Setup) -> None:
    """Compute the twist that every robot is sent in this tick."""
    period = setup.period  # loads don't vectorize
    for i in range(count):
        memory = SafetyMemory(
            latched=robots.latched[i],
            reason=0.0,
            linear=robots.new_linear[i],
            angular=robots.new_angular[i],
            past_linear=robots.past_linear[i],
            past_angular=robots.past_angular[i],
            sent_linear=0.0,
            sent_angular=0.0,
        )

        new = limit_twist(
            robots.action_linear[i] * robots.max_linear[i],
            robots.action_angular[i] * robots.max_angular[i],
            robots.odom_x[i],
            y=robots.odom_y[i],
            age=robots.feedback_age[i],
            memory=memory,
            rules=rules_of(robots, i, period),
        )

        robots.latched[i] = new.latched
        robots.sent_reason[i] = new.reason
        robots.new_linear[i] = new.linear
        robots.new_angular[i] = new.angular
        robots.past_linear[i] = new.past_linear
        robots.past_angular[i] = new.past_angular


@jit
def store_commands(robots: Robots, commands: Floats, count: int, slot: int, setup: Setup) -> None:
    """Store the command lines of the newest twists: wheel speeds right and left [rad/s]."""
    period = setup.period
    for i in range(count):
        top = robots.physics.max_speed[i]
        rules = rules_of(robots, i, period)
        right, left = compute_wheels(robots.new_linear[i], robots.new_angular[i], rules)
        commands[slot, RIGHT, i] = min(max(round_as_sent(right), -top), top)
        commands[slot, LEFT, i] = min(max(round_as_sent(left), -top), top)


@jit
def explain_commands(robots: Robots, count: int, setup: Setup) -> None:
    """Store the twist of the newest command line, and why it differs from the action's."""
    period = setup.period
    for i in range(count):
        rules = rules_of(robots, i, period)
        right, left = compute_wheels(robots.new_linear[i], robots.new_angular[i], rules)
        linear, angular, reason = explain_sent(
            robots.action_linear[i] * robots.max_linear[i],
            robots.action_angular[i] * robots.max_angular[i],
            right,
            left=left,
            reason=robots.sent_reason[i],
            rules=rules,
        )

        robots.sent_linear[i] = linear
        robots.sent_angular[i] = angular
        robots.sent_reason[i] = reason


@jit
def find_command(delay: float, slot: int, slots: int, turn: int, loops: int) -> int:
    """Slot of the newest command that has effect in firmware loop `turn` of a tick.

    It takes effect `delay` firmware loops after it was written. `slot` has this tick's command.
    """
    place = slot + int(np.floor((turn - delay) / loops))
    return place + slots if place < 0 else place


@jit
def follow_commands(
    robots: Robots, commands: Floats, count: int, slot: int, turn: int, loops: int
) -> None:
    """Let boards take over the newest command that each knows by this loop."""
    slots = commands.shape[0]
    delays = robots.command_loops
    differ = 0
    for i in range(count):
        differ += delays[i] != delays[0]

    place = find_command(delays[0], slot, slots, turn=turn, loops=loops)
    for i in range(count):
        robots.target_right[i] = commands[place, RIGHT, i]
        robots.target_left[i] = commands[place, LEFT, i]
    if differ > 0:
        for i in range(count):
            place = find_command(delays[i], slot, slots, turn=turn, loops=loops)
            robots.target_right[i] = commands[place, RIGHT, i]
            robots.target_left[i] = commands[place, LEFT, i]


@jit
def move_set_points(robots: Robots, count: int) -> None:
    """Move the set points of all wheels towards the boards' targets."""
    points = robots.set_point
    ramp = robots.ramp
    for i in range(count):
        right = robots.target_right[i]
        left = robots.target_left[i]
        points[0, i] = move_towards(points[0, i], right, ramp[0, i])
        points[1, i] = move_towards(points[1, i], left, ramp[1, i])
        points[2, i] = move_towards(points[2, i], left, ramp[2, i])
        points[3, i] = move_towards(points[3, i], right, ramp[3, i])


@jit
def turn_motors(robots: Robots, counts: Floats, count: int, slot: int, setup: Setup) -> None:
    """Advance wheel speeds and angles by one loop, and store the encoder counts."""
    physics = robots.physics
    dt = setup.dt
    for k in range(4):
        for i in range(count):
            speed = wheel_speed(
                robots.wheel_speed[k, i],
                robots.set_point[k, i],
                physics.gain[k, i],
                blend=physics.blend[k, i],
                deadband=physics.deadband[k, i],
                top=physics.max_speed[i],
            )

            angle = robots.wheel_angle[k, i] + speed * dt
            robots.wheel_speed[k, i] = speed
            robots.wheel_angle[k, i] = angle
            counts[slot, k, i] = np.floor(angle * robots.counts_per_radian[i])


class Chassis(NamedTuple):
    """The numbers of a `Physics` that tyres need."""

    left_radius: float
    right_radius: float
    half_wheelbase: float
    half_track: float
    mass: float
    yaw_inertia: float
    grip: float
    slip_speed: float
    kappa: float


@jit
def chassis_of(robots: Robots, i: int) -> Chassis:
    """The chassis of robot i."""
    physics = robots.physics
    return Chassis(
        left_radius=physics.left_radius[i],
        right_radius=physics.right_radius[i],
        half_wheelbase=physics.half_wheelbase[i],
        half_track=physics.half_track[i],
        mass=physics.mass[i],
        yaw_inertia=physics.yaw_inertia[i],
        grip=physics.grip[i],
        slip_speed=physics.slip_speed[i],
        kappa=physics.kappa[i],
    )


@jit
def move_bodies(robots: Robots, count: int, setup: Setup) -> None:
    """Advance velocity and pose by one loop: tyre forces, then semi-implicit Euler."""
    if setup.isotropic:  # compiled twice, because the constant saves a tenth of the time
        slide_bodies(robots, count, True, setup.dt)
    else:
        slide_bodies(robots, count, False, setup.dt)


@jit
def slide_bodies(robots: Robots, count: int, isotropic: bool, dt: float) -> None:
    """Advance velocity and pose by one loop, with tyres that are isotropic or not."""
    wheels = robots.wheel_speed
    for i in range(count):
        sin, cos = sincos(robots.theta[i])
        vx = robots.vx[i]
        vy = robots.vy[i]
        chassis = chassis_of(robots, i)
        ahead, aside, rate = tyre_step(
            cos * vx + sin * vy,
            cos * vy - sin * vx,
            robots.rate[i],
            wheels=(wheels[0, i], wheels[1, i], wheels[2, i], wheels[3, i]),
            physics=chassis,
            kappa=1.0 if isotropic else chassis.kappa,
            dt=dt,
        )

        # Semi-implicit: the pose follows from the new velocity.
        vx = cos * ahead - sin * aside
        vy = sin * ahead + cos * aside
        robots.vx[i] = vx
        robots.vy[i] = vy
        robots.rate[i] = rate
        robots.true_x[i] += vx * dt
        robots.true_y[i] += vy * dt
        robots.theta[i] += rate * dt


@jit
def add_work(robots: Robots, count: int, period: float) -> None:
    """Add the work of a tick, as `links.simulated.SimulatedLink`."""
    wheels = robots.wheel_speed
    for i in range(count):
        sin, cos = sincos(robots.theta[i])
        power = motor_power(
            cos,
            sin,
            (robots.vx[i], robots.vy[i], robots.rate[i]),
            wheels=(wheels[0, i], wheels[1, i], wheels[2, i], wheels[3, i]),
            physics=(chassis_of(robots, i),),
        )
        robots.work[i] += power * period


@jit
def read_encoders(robots: Robots, counts: Floats, i: int, slot: int, ago: int, window: int) -> None:
    """Set robot i's wheel speeds from what its encoders had counted `ago` firmware loops ago."""
    slots = counts.shape[0]
    quantum = robots.quantum[i]
    new = slot - ago
    new += slots if new < 0 else 0
    old = new - window
    old += slots if old < 0 else 0
    for k in range(4):
        speed = (counts[new, k, i] - counts[old, k, i]) * robots.speed_per_count[i]
        if quantum > 0.0:
            speed = round_printed(speed, quantum)
        robots.read_speed[k, i] = round_as_sent(speed)


@jit
def newest_line(loops: float, delay: float, every: float) -> float:
    """Number of the newest feedback line that has arrived by a firmware loop.

    Line n is made n * `every` firmware loops after the reset, and used `delay` later.
    """
    line: float = np.floor((loops - delay) / every + 1e-9)
    return line


@jit
def read_feedback(robots: Robots, counts: Floats, count: int, slot: int, setup: Setup) -> None:
    """Read the newest feedback line that has arrived by the end of a tick, if it is new."""
    every = robots.physics.feedback_loops
    period = setup.period
    turns = setup.loops
    window = setup.window
    for i in range(count):
        robots.loops[i] += turns

        line = newest_line(robots.loops[i], robots.feedback_delay[i], every[i])
        if line > robots.last_line[i] and line > 0.0:
            robots.last_line[i] = line
            robots.feedback_age[i] = 0.0
            made = np.ceil(line * every[i] - 1e-9)
            ago = int(robots.loops[i] - made)
            read_encoders(robots, counts, i, slot=slot, ago=ago, window=window)
        else:
            robots.feedback_age[i] += period


@jit
def update_odometry(robots: Robots, count: int, setup: Setup) -> None:
    """Update odometry with equations (1)-(10) on the newest wheel speeds."""
    speeds = robots.read_speed
    rules = robots.rules
    dt = setup.period
    for i in range(count):
        wheels = (speeds[0, i], speeds[1, i], speeds[2, i], speeds[3, i])
        geometry = (rules.left_radius[i], rules.right_radius[i], rules.separation[i])
        linear, angular = forward(*wheels, *geometry)

        pose = (robots.odom_x[i], robots.odom_y[i], robots.odom_theta[i])
        sin, cos = sincos(robots.odom_theta[i])
        x, y, theta = integrate(*pose, cos, sin, linear, angular, dt)
        robots.odom_x[i] = x
        robots.odom_y[i] = y
        robots.odom_theta[i] = theta - TURN * np.floor(theta / TURN + 0.5)
        robots.linear[i] = linear
        robots.angular[i] = angular


@loop
def step(  # noqa: C901, PLR0912 - every part that takes all tables compiles for longer
    tables: Tables,
    scans: Scans | None,
    crowds: Crowds | None,
    first: int,
    last: int,
    setups: Records,
) -> None:
    """Run physics and driver of these blocks over the ticks of an env step.

    `episode.reset` of the robots in `tables.begins` comes after this, then `lidars.read_scans` and
    the task's loop. `tables.cursor` moves on when all blocks have done the step.
    """
    setup = setups[0]
    cursor = tables.cursor[0]
    for block in range(first, last):
        robots = tables.blocks[block]
        counts = tables.counts[block]
        commands = tables.commands[block]
        start = block * BLOCK_ROBOTS
        count = robots_of_block(block, len(tables.begins))
        slot = cursor.counts
        line = cursor.commands

        # The actions of this step.
        for i in range(count):
            robots.action_linear[i] = min(max(tables.actions[start + i, 0], -1.0), 1.0)
            robots.action_angular[i] = min(max(tables.actions[start + i, 1], -1.0), 1.0)

        for tick in range(setup.ticks):
            # The driver writes a command line.
            line = (line + 1) % commands.shape[0]
            limit_twists(robots, count, setup)
            store_commands(robots, commands, count, slot=line, setup=setup)

            # Boards and bodies, in loops of the firmware.
            for turn in range(setup.loops):
                slot = (slot + 1) % counts.shape[0]
                follow_commands(robots, commands, count, slot=line, turn=turn, loops=setup.loops)
                move_set_points(robots, count)
                turn_motors(robots, counts, count, slot=slot, setup=setup)
                move_bodies(robots, count, setup)

            # People and contacts.
            if crowds is not None and scans is not None:
                for i in range(count):
                    now = int(robots.loops[i] / setup.loops) + 1
                    if now >= robots.crowd_look[i]:
                        advance_movers(
                            robots, i, start + i, tick=now, crowds=crowds, scans=scans, setup=setup
                        )
            if scans is not None:
                check_contacts(robots, count, scans.around)
            if setup.metered:
                add_work(robots, count, setup.period)

            # The driver reads feedback, which odometry integrates.
            read_feedback(robots, counts, count, slot=slot, setup=setup)
            update_odometry(robots, count, setup)

            # Where the robot and people are, for the LiDAR's next revolution.
            if scans is not None:
                for i in range(count if setup.sees else 0):
                    now = int(robots.steps[i]) * setup.ticks + tick + 1
                    mark_trails(robots, i, scans.trails, robot=start + i, tick=now, setup=setup)
                    if crowds is not None and crowds.motions.reacting[int(robots.world[i])]:
                        mark_movers(crowds, start + i, now % scans.trails.shape[2])

        # The end of the step.
        explain_commands(robots, count, setup)
        for i in range(count):
            if crowds is not None and scans is not None:
                survey_movers(robots, i, start + i, crowds=crowds, scans=scans, setup=setup)
            robots.steps[i] += 1.0
