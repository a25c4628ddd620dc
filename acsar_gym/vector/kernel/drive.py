"""One env step of many planar robots, tick by tick: commands, board, motors, tyres and odometry.

Without limits, geofence, faults or late commands all commands of a step are the same, and
`command_once` and `hear_newest` are fastest. Otherwise every tick's command is kept in a ring until
the board uses it, see `layout.Commands`.

Lines that are lost or late are the same as in `links.faults`: a hash of the episode's key
and the line's number decides which. Lines keep their order: none overtakes a late one. They are
numbered from the reset on, including the ticks in which a reset waits for the wheels to stand;
commands from 0, feedback from 1.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from acsar_gym import kinematics, odometry
from acsar_gym.jit import jit, loop
from acsar_gym.links.faults import (
    COMMAND_LINE,
    DROPPED_LINE,
    FEEDBACK_LINE,
    LATE_LINE,
    TIME_TOLERANCE,
    line_hash,
)
from acsar_gym.physics.model import (
    motor_power,
    move_towards,
    round_printed,
    tyre_step,
    wheel_speed,
    whole_loops,
)
from acsar_gym.protocol import MAX_SPEED
from acsar_gym.safety.rules import (
    SafetyMemory,
    compute_wheels,
    explain_sent,
    is_silent,
    limit_twist,
)
from acsar_gym.trigonometry import sincos
from acsar_gym.vector.kernel.crowds import advance_movers, mark_movers, survey_movers
from acsar_gym.vector.kernel.layout import (
    BLOCK_ROBOTS,
    EPISODE_ROWS,
    TURN,
    Commands,
    Crowds,
    Floats,
    LineFaults,
    Lines,
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
SILENCE = 1.0  # the code of BoardSilentError in info's `fault`, see `FAULT_CODES`


@jit
def round_as_sent(speed: float) -> float:
    """A wheel speed [rad/s] after encoding and decoding: two decimals, saturated."""
    rounded: float = np.rint(speed * 100.0) / 100.0
    return min(max(rounded, -MAX_SPEED), MAX_SPEED)


@jit
def command_once(robots: Robots, count: int, setup: Setup) -> None:
    """Compute the wheel targets of this step's command line. Only without limits or faults."""
    period = setup.period  # loads don't vectorize
    for i in range(count):
        rules, top = rules_of(robots, i, period), robots.physics.max_speed[i]
        linear = robots.action_linear[i] * robots.max_linear[i]
        angular = robots.action_angular[i] * robots.max_angular[i]
        right, left = compute_wheels(linear, angular, rules)
        sent = explain_sent(linear, angular, right, left, 0.0, rules)
        robots.sent_linear[i], robots.sent_angular[i], robots.reason[i] = sent
        robots.new_right[i] = min(max(round_as_sent(right), -top), top)
        robots.new_left[i] = min(max(round_as_sent(left), -top), top)
        robots.heard[i] = robots.command_loops[i]


@jit
def limit_twists(robots: Robots, count: int, setup: Setup) -> None:
    """Compute the twist that every robot is sent in this tick."""
    period = setup.period
    for i in range(count):
        rules = rules_of(robots, i, period)
        linear = robots.action_linear[i] * robots.max_linear[i]
        angular = robots.action_angular[i] * robots.max_angular[i]
        newest, past = robots.new_linear[i], robots.past_linear[i]
        newest_turn, past_turn = robots.new_angular[i], robots.past_angular[i]
        before = SafetyMemory(
            robots.latched[i], 0.0, newest, newest_turn, past, past_turn, 0.0, 0.0
        )
        x, y, age = robots.odom_x[i], robots.odom_y[i], robots.age[i]
        after = limit_twist(linear, angular, x, y, age, before, rules)
        robots.latched[i], robots.reason[i] = after.latched, after.reason
        robots.new_linear[i], robots.new_angular[i] = after.linear, after.angular
        robots.past_linear[i], robots.past_angular[i] = after.past_linear, after.past_angular


@jit
def store_commands(robots: Robots, commands: Floats, count: int, slot: int, setup: Setup) -> None:
    """Compute and store this tick's command lines: wheel speeds right and left [rad/s]."""
    limit_twists(robots, count, setup)
    period = setup.period
    for i in range(count):
        rules, top = rules_of(robots, i, period), robots.physics.max_speed[i]
        right, left = compute_wheels(robots.new_linear[i], robots.new_angular[i], rules)
        commands[slot, 0, i] = min(max(round_as_sent(right), -top), top)
        commands[slot, 1, i] = min(max(round_as_sent(left), -top), top)


@jit
def explain_commands(robots: Robots, count: int, setup: Setup) -> None:
    """Store the twist of the newest command line, and the reason why it isn't the one asked for."""
    period = setup.period
    for i in range(count):
        rules = rules_of(robots, i, period)
        linear = robots.action_linear[i] * robots.max_linear[i]
        angular = robots.action_angular[i] * robots.max_angular[i]
        right, left = compute_wheels(robots.new_linear[i], robots.new_angular[i], rules)
        sent = explain_sent(linear, angular, right, left, robots.reason[i], rules)
        robots.sent_linear[i], robots.sent_angular[i], robots.reason[i] = sent


@jit
def release_time(
    key: float, whose: int, number: float, arrived: float, before: float, faults: LineFaults
) -> float:
    """Time at which the wire passes a line on [s]; NaN where the line is lost."""
    suffers = faults.feedback if whose == FEEDBACK_LINE else faults.commands
    if key < 0.0 or not suffers:
        return arrived
    if faults.dropped > 0.0 and line_hash(key, whose, number, DROPPED_LINE) < faults.dropped:
        return np.nan
    late = faults.late > 0.0 and line_hash(key, whose, number, LATE_LINE) < faults.late
    return max(before, arrived + faults.lateness if late else arrived)


@jit
def send_command(robots: Robots, i: int, tick: float, setup: Setup) -> tuple[float, float]:
    """Write robot i's command of this tick, and pass on what the wire lets through by now.

    Returns:
        Number of the newest line that is passed on, -1 for none, and the firmware loop in which
        the board has read all of them, one byte after the other.
    """
    now, newest, count = tick * setup.period, -1.0, 0.0
    while robots.last_command[i] < tick:
        line = robots.last_command[i] + 1.0
        written, before = line * setup.period, robots.command_release[i]
        when = release_time(robots.key[i], COMMAND_LINE, line, written, before, setup.faults)
        if when > now + TIME_TOLERANCE:
            break
        robots.last_command[i] = line
        if not math.isnan(when):
            robots.command_release[i] = when
            newest, count = line, count + 1.0
    if count == 0.0:
        return newest, np.inf
    faults = setup.faults
    robots.board_free[i] = max(robots.board_free[i], now) + count * faults.line_time
    read = robots.board_free[i] + faults.processing_time + robots.physics.command_delay[i]
    return newest, whole_loops(read, setup.dt) + robots.physics.latency_loops[i]


@jit
def dispatch_commands(
    robots: Robots,
    commands: Floats,
    arrivals: Floats,
    count: int,
    slot: int,
    setup: Setup,
) -> None:
    """Store in the ring's slot which commands the wire passes on to the boards in this tick."""
    slots = commands.shape[0]
    for i in range(count):
        tick = robots.loops[i] / setup.loops
        newest, loop_of = send_command(robots, i, tick, setup)
        arrivals[slot, 0, i] = loop_of
        if newest >= 0.0:
            place = (slot - int(tick - newest) + slots) % slots
            arrivals[slot, 1, i] = commands[place, 0, i]
            arrivals[slot, 2, i] = commands[place, 1, i]


@jit
def hear_newest(robots: Robots, count: int, now: float) -> None:
    """Let boards take over the step's command if they know it by firmware loop `now`."""
    for i in range(count):
        new = now >= robots.heard[i]
        robots.target_right[i] = robots.new_right[i] if new else robots.target_right[i]
        robots.target_left[i] = robots.new_left[i] if new else robots.target_left[i]


@jit
def find_command(delay: float, slot: int, slots: int, turn: int, loops: int) -> int:
    """Slot of the newest command that has effect in firmware loop `turn` of a tick.

    It takes effect `delay` firmware loops after it was written; `slot` has this tick's command.
    """
    place = slot + int(np.floor((turn - delay) / loops))
    return place + slots if place < 0 else place


@jit
def follow_commands(
    robots: Robots, commands: Floats, count: int, slot: int, turn: int, loops: int
) -> None:
    """Let boards take over the newest command that each knows by this loop."""
    slots, delays = commands.shape[0], robots.command_loops
    differ = 0
    for i in range(count):
        differ += delays[i] != delays[0]
    place = find_command(delays[0], slot, slots, turn, loops)
    for i in range(count):
        robots.target_right[i], robots.target_left[i] = commands[place, 0, i], commands[place, 1, i]
    if differ > 0:
        for i in range(count):
            place = find_command(delays[i], slot, slots, turn, loops)
            robots.target_right[i] = commands[place, 0, i]
            robots.target_left[i] = commands[place, 1, i]


@jit
def obey_commands(
    robots: Robots, arrivals: Floats, count: int, slot: int, turn: int, setup: Setup
) -> None:
    """Let boards obey the commands that have arrived by this loop.

    A board that gets no command for longer than its time-out stops its motors.
    """
    slots = arrivals.shape[0]
    for i in range(count):
        tick, now = robots.loops[i] / setup.loops, robots.loops[i] + turn
        while robots.heard_tick[i] < tick:
            place = (slot - int(tick - robots.heard_tick[i] - 1.0) + slots) % slots
            if arrivals[place, 0, i] < np.inf:
                if arrivals[place, 0, i] > now:
                    break
                robots.target_right[i] = arrivals[place, 1, i]
                robots.target_left[i] = arrivals[place, 2, i]
                robots.heard_loop[i] = now
            robots.heard_tick[i] += 1.0
        waits = (now - robots.heard_loop[i]) * setup.dt
        if waits > setup.faults.command_timeout + TIME_TOLERANCE:
            robots.target_right[i] = robots.target_left[i] = 0.0


@jit
def move_set_points(robots: Robots, count: int) -> None:
    """Move the set points of all wheels towards the boards' targets."""
    points, ramp = robots.set_point, robots.ramp
    for i in range(count):
        right, left = robots.target_right[i], robots.target_left[i]
        points[0, i] = move_towards(points[0, i], right, ramp[0, i])
        points[1, i] = move_towards(points[1, i], left, ramp[1, i])
        points[2, i] = move_towards(points[2, i], left, ramp[2, i])
        points[3, i] = move_towards(points[3, i], right, ramp[3, i])


@jit
def turn_motors(robots: Robots, counts: Floats, count: int, slot: int, setup: Setup) -> None:
    """Advance wheel speeds and angles by one loop, and store the encoder counts."""
    physics, dt = robots.physics, setup.dt
    for k in range(4):
        for i in range(count):
            before, wanted = robots.wheel_speed[k, i], robots.set_point[k, i]
            gain, blend, deadband = physics.gain[k, i], physics.blend[k, i], physics.deadband[k, i]
            speed = wheel_speed(before, wanted, gain, blend, deadband, physics.max_speed[i])
            angle = robots.wheel_angle[k, i] + speed * dt
            robots.wheel_speed[k, i] = speed
            robots.wheel_angle[k, i] = angle
            counts[slot, k, i] = np.floor(angle * robots.counts_per_radian[i])


class Chassis(NamedTuple):
    """The numbers of a `Physics` that `tyre_step` needs."""

    left_radius: float
    right_radius: float
    half_wheelbase: float
    half_track: float
    mass: float
    yaw_inertia: float
    grip: float
    slip_speed: float


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
    physics, wheels = robots.physics, robots.wheel_speed
    for i in range(count):
        sin, cos = sincos(robots.theta[i])
        vx, vy, rate = robots.vx[i], robots.vy[i], robots.rate[i]
        speeds = wheels[0, i], wheels[1, i], wheels[2, i], wheels[3, i]
        chassis = Chassis(
            physics.left_radius[i],
            physics.right_radius[i],
            physics.half_wheelbase[i],
            physics.half_track[i],
            physics.mass[i],
            physics.yaw_inertia[i],
            physics.grip[i],
            physics.slip_speed[i],
        )
        kappa = 1.0 if isotropic else physics.kappa[i]
        ahead, left, rate = tyre_step(
            cos * vx + sin * vy, cos * vy - sin * vx, rate, speeds, chassis, kappa, dt
        )
        vx, vy = cos * ahead - sin * left, sin * ahead + cos * left
        robots.vx[i], robots.vy[i], robots.rate[i] = vx, vy, rate
        robots.x[i] += vx * dt
        robots.y[i] += vy * dt
        robots.theta[i] += rate * dt


class Tyres(NamedTuple):
    """The numbers of a `Physics` that `motor_power` needs."""

    left_radius: float
    right_radius: float
    half_wheelbase: float
    half_track: float
    grip: float
    slip_speed: float
    kappa: float


@jit
def add_work(robots: Robots, count: int, period: float) -> None:
    """Add the work of a tick, as `links.simulated.SimulatedLink`."""
    own, wheels = robots.physics, robots.wheel_speed
    for i in range(count):
        sin, cos = sincos(robots.theta[i])
        tyres = Tyres(
            own.left_radius[i],
            own.right_radius[i],
            own.half_wheelbase[i],
            own.half_track[i],
            own.grip[i],
            own.slip_speed[i],
            own.kappa[i],
        )
        velocity = robots.vx[i], robots.vy[i], robots.rate[i]
        speeds = wheels[0, i], wheels[1, i], wheels[2, i], wheels[3, i]
        robots.work[i] += motor_power(cos, sin, velocity, speeds, (tyres,)) * period


@jit
def read_encoders(robots: Robots, counts: Floats, i: int, slot: int, ago: int, window: int) -> None:
    """Set robot i's wheel speeds from what its encoders had counted `ago` firmware loops ago."""
    slots, quantum = counts.shape[0], robots.quantum[i]
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
    """Number of the newest feedback line that has arrived by a firmware loop, without faults.

    Line n is made n * `every` firmware loops after the reset, and used `delay` later.
    """
    line: float = np.floor((loops - delay) / every + 1e-9)
    return line


@jit
def receive_line(robots: Robots, i: int, setup: Setup) -> float:
    """Number of the newest feedback line that reaches robot i by the end of its tick; 0 for none.

    `loops` must include the loops of this tick.
    """
    loops, every = robots.loops[i], robots.physics.feedback_loops[i]
    delay = robots.feedback_delay[i]
    now, received, newest = loops * setup.dt, 0.0, newest_line(loops, delay, every)
    while robots.last_line[i] < newest:
        line = robots.last_line[i] + 1.0
        made = np.ceil(line * every - 1e-9)
        arrived = np.ceil((made + delay) / setup.loops) * setup.period
        before = robots.feedback_release[i]
        when = release_time(robots.key[i], FEEDBACK_LINE, line - 1.0, arrived, before, setup.faults)
        if when > now + TIME_TOLERANCE:
            break
        robots.last_line[i] = line
        if not math.isnan(when):
            robots.feedback_release[i] = when
            received = line
    return received


@jit
def read_feedback(
    robots: Robots, counts: Floats, lines: Lines | None, count: int, slot: int, setup: Setup
) -> None:
    """Read the newest feedback line that has arrived by the end of a tick, if it is new."""
    every, delays = robots.physics.feedback_loops, robots.feedback_delay
    period, turns, window = setup.period, setup.loops, setup.window
    for i in range(count):
        robots.loops[i] += turns
        if lines is not None:
            line = receive_line(robots, i, setup)
        else:
            line = newest_line(robots.loops[i], delays[i], every[i])
            line = line if line > robots.last_line[i] else 0.0
        if line > 0.0:
            robots.last_line[i] = max(robots.last_line[i], line)
            robots.age[i] = 0.0
            made = np.ceil(line * every[i] - 1e-9)
            read_encoders(robots, counts, i, slot, int(robots.loops[i] - made), window)
        else:
            robots.age[i] += period


@jit
def update_odometry(robots: Robots, count: int, setup: Setup) -> None:
    """Update odometry with equations (1)-(10) on the newest wheel speeds."""
    read, dt, rules = robots.read_speed, setup.period, robots.rules
    for i in range(count):
        linear, angular = forward(
            read[0, i],
            read[1, i],
            read[2, i],
            read[3, i],
            rules.left_radius[i],
            rules.right_radius[i],
            rules.separation[i],
        )
        x, y, theta = robots.odom_x[i], robots.odom_y[i], robots.odom_theta[i]
        sin, cos = sincos(theta)
        x, y, theta = integrate(x, y, theta, cos, sin, linear, angular, dt)
        robots.odom_x[i], robots.odom_y[i] = x, y
        robots.odom_theta[i] = theta - TURN * np.floor(theta / TURN + 0.5)
        robots.linear[i], robots.angular[i] = linear, angular


@loop
def step(  # noqa: C901, PLR0912, PLR0915 - every part that takes all tables compiles for longer
    tables: Tables,
    commands: Commands | None,
    lines: Lines | None,
    scans: Scans | None,
    crowds: Crowds | None,
    first: int,
    last: int,
    setups: Records,
) -> None:
    """Run physics and driver of these blocks over the ticks that `tables.ring` says.

    The step ends with its last tick. `episode.reset` of the robots in `tables.over` comes after
    this, then `lidars.read_scans` and the task's loop. Robots whose board falls silent during a
    step end it as they were before it, but for their fault.
    """
    setup, start, stop = setups[0], tables.ring[2], tables.ring[3]
    slots, line = tables.counts.shape[1], 0
    for block in range(first, last):
        robots, counts, begin = tables.blocks[block], tables.counts[block], block * BLOCK_ROBOTS
        count = robots_of_block(block, len(tables.over))
        if start == 0:
            for i in range(count):
                robots.action_linear[i] = min(max(tables.actions[begin + i, 0], -1.0), 1.0)
                robots.action_angular[i] = min(max(tables.actions[begin + i, 1], -1.0), 1.0)
                tables.idle[begin + i] = tables.over[begin + i]
            if commands is None:
                command_once(robots, count, setup)
            if lines is not None:
                for i in range(count):
                    tables.idle[begin + i] |= robots.silent[i] > 0.0
                    for row in range(lines.kept.shape[1]):
                        lines.kept[block, row, i] = tables.numbers[block, row, i]
        slot = (tables.ring[0] + start * setup.loops) % slots
        if commands is not None:
            line = (tables.ring[1] + start) % commands.shape[1]
            sent = commands[block]
        if lines is not None:
            arrivals = lines.arrivals[block]
        for tick in range(start, stop):
            if commands is not None:
                line = (line + 1) % commands.shape[1]
                store_commands(robots, sent, count, line, setup)
                if lines is not None:
                    dispatch_commands(robots, sent, arrivals, count, line, setup)
            for turn in range(setup.loops):
                if lines is not None:
                    obey_commands(robots, arrivals, count, line, turn, setup)
                elif commands is not None:
                    follow_commands(robots, sent, count, line, turn, setup.loops)
                else:
                    hear_newest(robots, count, tick * setup.loops + turn)
                move_set_points(robots, count)
                turn_motors(robots, counts, count, (slot + 1 + turn) % slots, setup)
                move_bodies(robots, count, setup)
            slot = (slot + setup.loops) % slots
            if crowds is not None and scans is not None:
                for i in range(count):
                    after = int(robots.loops[i] / setup.loops) + 1
                    if after >= robots.crowd_look[i]:
                        advance_movers(robots, i, begin + i, after, crowds, scans, setup)
            if scans is not None:
                check_contacts(robots, count, scans.around)
            if setup.metered:
                add_work(robots, count, setup.period)
            read_feedback(robots, counts, lines, count, slot, setup)
            if lines is not None:
                for i in range(count):
                    silent = is_silent(robots.age[i], rules_of(robots, i, setup.period))
                    tables.idle[begin + i] |= silent
            update_odometry(robots, count, setup)
            if scans is not None:
                for i in range(count if setup.sees else 0):
                    now = robots.steps[i] * setup.ticks + tick + 1.0
                    mark_trails(robots, i, scans.trails, begin + i, now, setup)
                    if crowds is not None and crowds.motions.reacting[int(robots.world[i])]:
                        mark_movers(crowds, begin + i, int(now) % scans.trails.shape[2])
        if commands is not None:
            explain_commands(robots, count, setup)
        if stop < setup.ticks:
            continue
        for i in range(count):
            if crowds is not None and scans is not None:
                survey_movers(robots, i, begin + i, crowds, scans, setup)
            if lines is not None:
                is_cut = tables.idle[begin + i] and not tables.over[begin + i]
                if is_cut and lines.kept.shape[1] > 0:
                    for row in range(EPISODE_ROWS):
                        tables.numbers[block, row, i] = lines.kept[block, row, i]
                    robots.fault[i] = SILENCE
            robots.steps[i] += 1.0


@jit
def settle_with_faults(robots: Robots, i: int, setup: Setup) -> None:
    """Run robot i's reset with faults: it waits for two fresh readings, as `Robot.reset`.

    Where the single env would raise BoardSilentError, `silent` is set.
    """
    ticks, fresh, age = 0.0, 0, 0.0
    rules = rules_of(robots, i, setup.period)
    robots.last_command[i], robots.last_line[i] = -1.0, 0.0
    while fresh < 2:
        send_command(robots, i, ticks, setup)
        ticks += 1.0
        robots.loops[i] = ticks * setup.loops
        is_fresh = receive_line(robots, i, setup) > 0.0
        age = 0.0 if is_fresh else age + setup.period
        fresh += is_fresh
        if is_silent(age, rules) or (fresh < 2 and ticks >= setup.faults.patience):
            robots.silent[i] = 1.0
            break
    robots.heard_tick[i] = ticks - 1.0
    robots.heard_loop[i] = -1e18
