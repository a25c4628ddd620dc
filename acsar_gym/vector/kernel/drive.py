"""One env step of many planar robots, tick by tick: commands, board, motors, tyres and odometry.

Without limits, geofence, faults or late commands all commands of a step are the same, and
`command_once` and `ramp_to_newest` are fastest. Otherwise (`setup.guarded`) every tick's command is
kept in a ring until the board uses it.

Lines that are lost or late are the same as in `links.fault_injection`: a hash of the episode's key
and the line's number decides which. Lines keep their order: none overtakes a late one. They are
numbered from the reset on, including the ticks in which a reset waits for the wheels to stand;
commands from 0, feedback from 1.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from acsar_gym import kinematics, odometry
from acsar_gym.jit import jit, subroutine
from acsar_gym.links.faults import (
    COMMAND_LINE,
    DROPPED_LINE,
    FEEDBACK_LINE,
    LATE_LINE,
    TIME_TOLERANCE,
    WHOLE_EPISODE,
    line_hash,
)
from acsar_gym.physics.model import move_towards, round_printed, tyre_step, wheel_speed, whole_loops
from acsar_gym.physics.trigonometry import sincos
from acsar_gym.protocol import MAX_SPEED, Speeds
from acsar_gym.safety.rules import (
    SafetyMemory,
    compute_wheels,
    explain_sent,
    is_silent,
    limit_twist,
)
from acsar_gym.vector.kernel.layout import (
    AGE,
    ANGLE,
    ANGULAR,
    BLEND,
    BOARD_FREE,
    COMMAND_DELAY,
    COMMAND_LOOPS,
    COMMAND_RELEASE,
    DELAY_LOOPS,
    FAULT,
    FEEDBACK_LOOPS,
    FEEDBACK_RELEASE,
    GRIP,
    HALF_TRACK,
    HALF_WHEELBASE,
    HEARD,
    HEARD_LOOP,
    HEARD_TICK,
    KAPPA,
    KEY,
    LAST_ANGULAR,
    LAST_COMMAND,
    LAST_LINE,
    LAST_LINEAR,
    LATCHED,
    LATENCY_LOOPS,
    LEFT_RADIUS,
    LINEAR,
    LOOPS,
    MASS,
    MOTOR_DEADBAND,
    MOTOR_GAIN,
    NEW_ANGULAR,
    NEW_LEFT,
    NEW_LINEAR,
    NEW_RIGHT,
    ODOM_THETA,
    ODOM_X,
    ODOM_Y,
    OLD_LEFT,
    OLD_RIGHT,
    PAST_ANGULAR,
    PAST_LINEAR,
    POINT,
    RATE,
    READ,
    REASON,
    RIGHT_RADIUS,
    SCAN_TICK,
    SENT_ANGULAR,
    SENT_LINEAR,
    SILENT,
    SLIP_SPEED,
    THETA,
    TURN,
    VX,
    VY,
    WHEEL,
    YAW_INERTIA,
    Floats,
    LineFaults,
    Setup,
    Tables,
    X,
    Y,
    row,
)
from acsar_gym.vector.kernel.lidars import check_contacts, take_scans
from acsar_gym.vector.pcg import uniform
from acsar_gym.worlds.geometry import Surroundings

forward = jit(kinematics.compute_twist)
integrate = jit(odometry.integrate_twist)
SILENCE = 1.0
"""The code of BoardSilentError in info's `fault`, see `envs.told.fault_code`."""


@jit
def round_as_sent(speed: float) -> float:
    """A wheel speed [rad/s] after encoding and decoding: two decimals, saturated."""
    rounded: float = np.rint(speed * 100.0) / 100.0
    return min(max(rounded, -MAX_SPEED), MAX_SPEED)


@jit
def store_actions(state: Floats, actions: Floats, first: int, last: int) -> None:
    """Store the actions of this step, clipped to [-1, 1]."""
    for i in range(first, last):
        state[LAST_LINEAR, i] = min(max(actions[i, 0], -1.0), 1.0)
        state[LAST_ANGULAR, i] = min(max(actions[i, 1], -1.0), 1.0)


@jit
def command_once(state: Floats, first: int, last: int, setup: Setup) -> None:
    """Compute the wheel targets of this step's command line. Only without limits or faults."""
    old_right, old_left = row(state, OLD_RIGHT, first, last), row(state, OLD_LEFT, first, last)
    new_right, new_left = row(state, NEW_RIGHT, first, last), row(state, NEW_LEFT, first, last)
    heard, delay = row(state, HEARD, first, last), row(state, COMMAND_LOOPS, first, last)
    asks, turns = row(state, LAST_LINEAR, first, last), row(state, LAST_ANGULAR, first, last)
    sent, bent = row(state, SENT_LINEAR, first, last), row(state, SENT_ANGULAR, first, last)
    reasons = row(state, REASON, first, last)
    for i in range(last - first):
        linear, angular = asks[i] * setup.max_linear, turns[i] * setup.max_angular
        right, left = compute_wheels(linear, angular, setup.rules)
        sent[i], bent[i], reasons[i] = explain_sent(linear, angular, right, left, 0.0, setup.rules)
        old_right[i] = new_right[i]
        old_left[i] = new_left[i]
        new_right[i] = min(max(round_as_sent(right), -setup.top), setup.top)
        new_left[i] = min(max(round_as_sent(left), -setup.top), setup.top)
        heard[i] = delay[i]


@jit
def limit_twists(state: Floats, first: int, last: int, setup: Setup) -> None:
    """Compute the twist that every robot is sent in this tick."""
    asks, turns = row(state, LAST_LINEAR, first, last), row(state, LAST_ANGULAR, first, last)
    new, past = row(state, NEW_LINEAR, first, last), row(state, PAST_LINEAR, first, last)
    bent, past_bent = row(state, NEW_ANGULAR, first, last), row(state, PAST_ANGULAR, first, last)
    latched, reasons = row(state, LATCHED, first, last), row(state, REASON, first, last)
    xs, ys = row(state, ODOM_X, first, last), row(state, ODOM_Y, first, last)
    ages, rules = row(state, AGE, first, last), setup.rules
    for i in range(last - first):
        linear, angular = asks[i] * setup.max_linear, turns[i] * setup.max_angular
        before = SafetyMemory(latched[i], 0.0, new[i], bent[i], past[i], past_bent[i], 0.0, 0.0)
        after = limit_twist(linear, angular, xs[i], ys[i], ages[i], before, rules)
        latched[i] = after.latched
        reasons[i] = after.reason
        new[i] = after.linear
        bent[i] = after.angular
        past[i] = after.past_linear
        past_bent[i] = after.past_angular


@jit
def store_commands(
    state: Floats, commands: Floats, first: int, last: int, slot: int, setup: Setup
) -> None:
    """Store this tick's command lines: wheel speeds right and left [rad/s]."""
    new, bent = row(state, NEW_LINEAR, first, last), row(state, NEW_ANGULAR, first, last)
    rights, lefts = commands[slot, 0, first:last], commands[slot, 1, first:last]
    for i in range(last - first):
        right, left = compute_wheels(new[i], bent[i], setup.rules)
        rights[i] = min(max(round_as_sent(right), -setup.top), setup.top)
        lefts[i] = min(max(round_as_sent(left), -setup.top), setup.top)


@jit
def explain_commands(state: Floats, first: int, last: int, setup: Setup) -> None:
    """Store the twist of the newest command line, and the reason why it isn't the one asked for."""
    for i in range(first, last):
        linear = state[LAST_LINEAR, i] * setup.max_linear
        angular = state[LAST_ANGULAR, i] * setup.max_angular
        right, left = compute_wheels(state[NEW_LINEAR, i], state[NEW_ANGULAR, i], setup.rules)
        ahead, turn, why = explain_sent(linear, angular, right, left, state[REASON, i], setup.rules)
        state[SENT_LINEAR, i] = ahead
        state[SENT_ANGULAR, i] = turn
        state[REASON, i] = why


@jit
def command_tick(tables: Tables, first: int, last: int, line: int, setup: Setup) -> None:
    """Make the command lines of one tick, and pass them on to the boards."""
    limit_twists(tables.state, first, last, setup)
    store_commands(tables.state, tables.commands, first, last, line, setup)
    if setup.faults.possible:
        dispatch_commands(tables, first, last, line, setup)


@jit
def release_time(
    key: float, whose: int, number: float, arrived: float, before: float, faults: LineFaults
) -> float:
    """Time at which the wire passes a line on [s]; NaN where the line is lost.

    Args:
        key: of the episode; negative where it has no faults.
        whose: COMMANDS or FEEDBACK.
        number: of the line.
        arrived: when it would arrive without faults [s].
        before: when the line before it was passed on [s].
        faults: of the batch.
    """
    suffers = faults.feedback if whose == FEEDBACK_LINE else faults.commands
    if key < 0.0 or not suffers:
        return arrived
    if faults.dropped > 0.0 and line_hash(key, whose, number, DROPPED_LINE) < faults.dropped:
        return np.nan
    late = faults.late > 0.0 and line_hash(key, whose, number, LATE_LINE) < faults.late
    return max(before, arrived + faults.lateness if late else arrived)


@jit
def send_command(state: Floats, i: int, tick: float, setup: Setup) -> tuple[float, float]:
    """Write robot i's command of this tick, and pass on what the wire lets through by now.

    Returns:
        Number of the newest line that is passed on, -1 for none, and the firmware loop in which
        the board has read all of them, one byte after the other.
    """
    now, newest, count = tick * setup.period, -1.0, 0.0
    while state[LAST_COMMAND, i] < tick:
        line = state[LAST_COMMAND, i] + 1.0
        written, before = line * setup.period, state[COMMAND_RELEASE, i]
        when = release_time(state[KEY, i], COMMAND_LINE, line, written, before, setup.faults)
        if when > now + TIME_TOLERANCE:
            break
        state[LAST_COMMAND, i] = line
        if not math.isnan(when):
            state[COMMAND_RELEASE, i] = when
            newest, count = line, count + 1.0
    if count == 0.0:
        return newest, np.inf
    faults = setup.faults
    state[BOARD_FREE, i] = max(state[BOARD_FREE, i], now) + count * faults.line_time
    read = state[BOARD_FREE, i] + faults.processing_time + state[COMMAND_DELAY, i]
    return newest, whole_loops(read, setup.dt) + state[LATENCY_LOOPS, i]


@jit
def dispatch_commands(tables: Tables, first: int, last: int, slot: int, setup: Setup) -> None:
    """Store in the ring's slot which commands the wire passes on to the boards in this tick."""
    state, commands, arrivals = tables.state, tables.commands, tables.arrivals
    slots = commands.shape[0]
    for i in range(first, last):
        tick = state[LOOPS, i] / setup.loops
        newest, loop_of = send_command(state, i, tick, setup)
        arrivals[slot, 0, i] = loop_of
        if newest >= 0.0:
            place = (slot - int(tick - newest) + slots) % slots
            arrivals[slot, 1, i] = commands[place, 0, i]
            arrivals[slot, 2, i] = commands[place, 1, i]


@jit
def ramp_to_newest(state: Floats, first: int, last: int, now: float, setup: Setup) -> None:
    """Move set points towards the newest targets that the board knows by loop `now`."""
    a, b = row(state, POINT, first, last), row(state, POINT + 1, first, last)
    c, d = row(state, POINT + 2, first, last), row(state, POINT + 3, first, last)
    old_right, old_left = row(state, OLD_RIGHT, first, last), row(state, OLD_LEFT, first, last)
    new_right, new_left = row(state, NEW_RIGHT, first, last), row(state, NEW_LEFT, first, last)
    heard, steps = row(state, HEARD, first, last), setup.ramps
    for i in range(last - first):
        new = now >= heard[i]
        right = new_right[i] if new else old_right[i]
        left = new_left[i] if new else old_left[i]
        a[i] = move_towards(a[i], right, steps[0])
        b[i] = move_towards(b[i], left, steps[1])
        c[i] = move_towards(c[i], left, steps[2])
        d[i] = move_towards(d[i], right, steps[3])


@jit
def find_command(delay: float, slot: int, slots: int, turn: int, loops: int) -> int:
    """Slot of the newest command that a board knows by a firmware loop of a tick.

    Args:
        delay: from writing a command to its use [firmware loops].
        slot: of this tick's command.
        slots: of the ring.
        turn: number of the firmware loop within the tick.
        loops: firmware loops in a tick.
    """
    place = slot + int(np.floor((turn - delay) / loops))
    return place + slots if place < 0 else place


@jit
def follow_commands(
    state: Floats, commands: Floats, first: int, last: int, slot: int, turn: int, setup: Setup
) -> None:
    """Move set points towards the newest command that each board knows by this loop."""
    slots, delays = commands.shape[0], row(state, COMMAND_LOOPS, first, last)
    differ = 0
    for i in range(last - first):
        differ += delays[i] != delays[0]
    place = find_command(delays[0], slot, slots, turn, setup.loops)
    rights, lefts = commands[place, 0, first:last], commands[place, 1, first:last]
    if differ:
        rights, lefts = row(state, NEW_RIGHT, first, last), row(state, NEW_LEFT, first, last)
        for i in range(last - first):
            place = find_command(delays[i], slot, slots, turn, setup.loops)
            rights[i], lefts[i] = commands[place, 0, first + i], commands[place, 1, first + i]
    move_set_points(state, rights, lefts, first, last, setup.ramps)


@jit
def obey_commands(
    tables: Tables, first: int, last: int, slot: int, turn: int, setup: Setup
) -> None:
    """Let boards obey the commands that have arrived by this loop.

    A board that gets no command for longer than its time-out stops its motors.
    """
    state, arrivals, slots = tables.state, tables.arrivals, tables.arrivals.shape[0]
    for i in range(first, last):
        tick, now = state[LOOPS, i] / setup.loops, state[LOOPS, i] + turn
        while state[HEARD_TICK, i] < tick:
            place = (slot - int(tick - state[HEARD_TICK, i] - 1.0) + slots) % slots
            if arrivals[place, 0, i] < np.inf:
                if arrivals[place, 0, i] > now:
                    break
                state[NEW_RIGHT, i] = arrivals[place, 1, i]
                state[NEW_LEFT, i] = arrivals[place, 2, i]
                state[HEARD_LOOP, i] = now
            state[HEARD_TICK, i] += 1.0
        if (now - state[HEARD_LOOP, i]) * setup.dt > setup.faults.command_timeout + TIME_TOLERANCE:
            state[NEW_RIGHT, i] = state[NEW_LEFT, i] = 0.0
    rights, lefts = row(state, NEW_RIGHT, first, last), row(state, NEW_LEFT, first, last)
    move_set_points(state, rights, lefts, first, last, setup.ramps)


@jit
def move_set_points(
    state: Floats, rights: Floats, lefts: Floats, first: int, last: int, steps: Speeds
) -> None:
    """Move set points towards these targets of the right and the left wheels [rad/s]."""
    a, b = row(state, POINT, first, last), row(state, POINT + 1, first, last)
    c, d = row(state, POINT + 2, first, last), row(state, POINT + 3, first, last)
    for i in range(last - first):
        right, left = rights[i], lefts[i]
        a[i] = move_towards(a[i], right, steps[0])
        b[i] = move_towards(b[i], left, steps[1])
        c[i] = move_towards(c[i], left, steps[2])
        d[i] = move_towards(d[i], right, steps[3])


@jit
def turn_motors(
    state: Floats, counts: Floats, first: int, last: int, slot: int, setup: Setup
) -> None:
    """Advance wheel speeds and angles by one loop, and store the encoder counts."""
    for k in range(4):
        speeds, angles = row(state, WHEEL + k, first, last), row(state, ANGLE + k, first, last)
        points, gains = row(state, POINT + k, first, last), row(state, MOTOR_GAIN + k, first, last)
        blends, deadbands = (
            row(state, BLEND + k, first, last),
            row(state, MOTOR_DEADBAND + k, first, last),
        )
        seen = counts[slot, k, first:last]
        for i in range(last - first):
            speed = wheel_speed(speeds[i], points[i], gains[i], blends[i], deadbands[i], setup.top)
            angle = angles[i] + speed * setup.dt
            speeds[i] = speed
            angles[i] = angle
            seen[i] = np.floor(angle * setup.counts_per_radian)


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
def move_bodies(state: Floats, first: int, last: int, setup: Setup) -> None:
    """Advance velocity and pose by one loop: tyre forces, then semi-implicit Euler."""
    if setup.isotropic:  # compiled twice, because the constant saves a tenth of the time
        slide_bodies(state, first, last, True, setup.dt)
    else:
        slide_bodies(state, first, last, False, setup.dt)


@jit
def slide_bodies(state: Floats, first: int, last: int, isotropic: bool, dt: float) -> None:
    """Advance velocity and pose by one loop, with tyres that are isotropic or not."""
    xs, ys, thetas = (
        row(state, X, first, last),
        row(state, Y, first, last),
        row(state, THETA, first, last),
    )
    vxs, vys, rates = (
        row(state, VX, first, last),
        row(state, VY, first, last),
        row(state, RATE, first, last),
    )
    a, b = row(state, WHEEL, first, last), row(state, WHEEL + 1, first, last)
    c, d = row(state, WHEEL + 2, first, last), row(state, WHEEL + 3, first, last)
    left_radii, right_radii = (
        row(state, LEFT_RADIUS, first, last),
        row(state, RIGHT_RADIUS, first, last),
    )
    lengths, widths = row(state, HALF_WHEELBASE, first, last), row(state, HALF_TRACK, first, last)
    masses, inertias = row(state, MASS, first, last), row(state, YAW_INERTIA, first, last)
    grips, slips = row(state, GRIP, first, last), row(state, SLIP_SPEED, first, last)
    kappas = row(state, KAPPA, first, last)
    for i in range(last - first):
        sin, cos = sincos(thetas[i])
        vx, vy = vxs[i], vys[i]
        own = Chassis(
            left_radii[i],
            right_radii[i],
            lengths[i],
            widths[i],
            masses[i],
            inertias[i],
            grips[i],
            slips[i],
        )
        kappa, speeds = 1.0 if isotropic else kappas[i], (a[i], b[i], c[i], d[i])
        ahead, left, rate = tyre_step(
            cos * vx + sin * vy, cos * vy - sin * vx, rates[i], speeds, own, kappa, dt
        )
        vx, vy = cos * ahead - sin * left, sin * ahead + cos * left
        vxs[i] = vx
        vys[i] = vy
        rates[i] = rate
        xs[i] += vx * dt
        ys[i] += vy * dt
        thetas[i] += rate * dt


@jit
def newest_line(loops: float, delay: float, every: float) -> float:
    """Number of the newest feedback line that has arrived by a firmware loop.

    Args:
        loops: firmware loops since the reset.
        delay: from making a line to its use [firmware loops].
        every: line n is made n * `every` firmware loops after the reset.
    """
    line: float = np.floor((loops - delay) / every + 1e-9)
    return line


@jit
def read_encoders(state: Floats, counts: Floats, i: int, slot: int, ago: int, setup: Setup) -> None:
    """Set robot i's wheel speeds from what its encoders had counted `ago` firmware loops ago."""
    slots = counts.shape[0]
    new = slot - ago
    new += slots if new < 0 else 0
    old = new - setup.window
    old += slots if old < 0 else 0
    for k in range(4):
        speed = (counts[new, k, i] - counts[old, k, i]) * setup.speed_per_count
        if setup.quantum > 0.0:
            speed = round_printed(speed, setup.quantum)
        state[READ + k, i] = round_as_sent(speed)


@jit
def read_feedback(
    state: Floats, counts: Floats, first: int, last: int, slot: int, setup: Setup
) -> None:
    """Read the newest feedback line that has arrived by the end of a tick, if it is new."""
    loops, ages = row(state, LOOPS, first, last), row(state, AGE, first, last)
    lines, every = row(state, LAST_LINE, first, last), row(state, FEEDBACK_LOOPS, first, last)
    delays = row(state, DELAY_LOOPS, first, last)
    for i in range(last - first):
        now = loops[i] + setup.loops
        loops[i] = now
        line = newest_line(now, delays[i], every[i])
        if line > lines[i]:
            lines[i] = line
            ages[i] = 0.0
            made = np.ceil(line * every[i] - 1e-9)
            read_encoders(state, counts, first + i, slot, int(now - made), setup)
        else:
            ages[i] += setup.period


@jit
def receive_line(state: Floats, i: int, setup: Setup) -> float:
    """Number of the newest feedback line that reaches robot i by the end of its tick; 0 for none.

    LOOPS must include the loops of this tick.
    """
    loops, every, delay = state[LOOPS, i], state[FEEDBACK_LOOPS, i], state[DELAY_LOOPS, i]
    now, found = loops * setup.dt, 0.0
    newest = np.floor((loops - delay) / every + 1e-9)
    while state[LAST_LINE, i] < newest:
        line = state[LAST_LINE, i] + 1.0
        made = np.ceil(line * every - 1e-9)
        arrived = np.ceil((made + delay) / setup.loops) * setup.period
        before = state[FEEDBACK_RELEASE, i]
        when = release_time(state[KEY, i], FEEDBACK_LINE, line - 1.0, arrived, before, setup.faults)
        if when > now + TIME_TOLERANCE:
            break
        state[LAST_LINE, i] = line
        if not math.isnan(when):
            state[FEEDBACK_RELEASE, i] = when
            found = line
    return found


@jit
def receive_feedback(
    state: Floats, counts: Floats, first: int, last: int, slot: int, setup: Setup
) -> None:
    """Read feedback lines as `read_feedback` does, where lines can be lost or late."""
    for i in range(first, last):
        state[LOOPS, i] += setup.loops
        line = receive_line(state, i, setup)
        state[AGE, i] = 0.0 if line > 0.0 else state[AGE, i] + setup.period
        if line > 0.0:
            made = np.ceil(line * state[FEEDBACK_LOOPS, i] - 1e-9)
            read_encoders(state, counts, i, slot, int(state[LOOPS, i] - made), setup)


@jit
def update_odometry(state: Floats, first: int, last: int, setup: Setup) -> None:
    """Update odometry with equations (1)-(10) on the newest wheel speeds."""
    a, b = row(state, READ, first, last), row(state, READ + 1, first, last)
    c, d = row(state, READ + 2, first, last), row(state, READ + 3, first, last)
    xs, ys = row(state, ODOM_X, first, last), row(state, ODOM_Y, first, last)
    thetas = row(state, ODOM_THETA, first, last)
    linears, angulars = row(state, LINEAR, first, last), row(state, ANGULAR, first, last)
    left, right, dt = setup.left_radius, setup.right_radius, setup.period
    for i in range(last - first):
        linear, angular = forward(a[i], b[i], c[i], d[i], left, right, setup.separation)
        sin, cos = sincos(thetas[i])
        x, y, theta = integrate(xs[i], ys[i], thetas[i], cos, sin, linear, angular, dt)
        xs[i] = x
        ys[i] = y
        thetas[i] = theta - TURN * np.floor(theta / TURN + 0.5)
        linears[i] = linear
        angulars[i] = angular


@jit
def turn_wheels(
    tables: Tables, first: int, last: int, tick: int, slot: int, line: int, setup: Setup
) -> None:
    """Run the firmware loops of one tick; encoder counts go to slots from `slot` on."""
    state, counts = tables.state, tables.counts
    for turn in range(setup.loops):
        if setup.faults.possible:
            obey_commands(tables, first, last, line, turn, setup)
        elif setup.guarded:
            follow_commands(state, tables.commands, first, last, line, turn, setup)
        else:
            ramp_to_newest(state, first, last, tick * setup.loops + turn, setup)
        turn_motors(state, counts, first, last, (slot + turn) % counts.shape[0], setup)
        move_bodies(state, first, last, setup)


@subroutine
def drive_robots(tables: Tables, first: int, last: int, setup: Setup, around: Surroundings) -> None:
    """Run the ticks of an env step that `tables.ring` says, with all that happens in them."""
    state, counts, slots = tables.state, tables.counts, tables.counts.shape[0]
    begin, lines_kept = tables.ring[2], max(tables.commands.shape[0], 1)
    slot = (tables.ring[0] + begin * setup.loops) % slots
    line = (tables.ring[1] + begin) % lines_kept
    crowded = around.circles.shape[1] + around.segments.shape[1] > 0
    for tick in range(begin, tables.ring[3]):
        line = (line + 1) % lines_kept
        if setup.guarded:
            command_tick(tables, first, last, line, setup)
        turn_wheels(tables, first, last, tick, slot + 1, line, setup)
        slot = (slot + setup.loops) % slots
        if crowded:
            check_contacts(state, first, last, around)
        if setup.faults.possible:
            receive_feedback(state, counts, first, last, slot, setup)
            mark_silent(tables, first, last, setup)
        else:
            read_feedback(state, counts, first, last, slot, setup)
        update_odometry(state, first, last, setup)
        if setup.lidar_rate > 0.0:
            take_scans(tables, tables.idle, False, first, last, tick, setup, around)
    if setup.guarded:
        explain_commands(state, first, last, setup)


@jit
def keep_before_step(tables: Tables, first: int, last: int, setup: Setup) -> None:
    """Mark robots that don't drive in this step, and keep the state before the step.

    `restore_silent` restores it for robots whose board falls silent during the step.
    """
    for i in range(first, last):
        tables.idle[i] = tables.over[i]
    if setup.falls_silent:
        for number in range(COMMAND_LOOPS):
            for i in range(first, last):
                tables.kept[number, i] = tables.state[number, i]
        for i in range(first, last):
            tables.idle[i] |= tables.state[SILENT, i] > 0.0
            for k in range(tables.ranges.shape[1]):
                tables.kept_rays[i, k] = tables.observations[i, setup.numbers + k]


@jit
def mark_silent(tables: Tables, first: int, last: int, setup: Setup) -> None:
    """Mark robots as idle whose feedback is too old; see `rules.silent`."""
    for i in range(first, last):
        if is_silent(tables.state[AGE, i], setup.rules):
            tables.idle[i] = True


@jit
def restore_silent(tables: Tables, first: int, last: int, setup: Setup) -> None:
    """Restore the state before the step for robots that fell silent, and set their fault."""
    state = tables.state
    for i in range(first, last):
        if tables.idle[i] and not tables.over[i]:
            for number in range(COMMAND_LOOPS):
                state[number, i] = tables.kept[number, i]
            state[SCAN_TICK, i] += setup.ticks  # so that the scan's age stays, too
            state[FAULT, i] = SILENCE
            for k in range(tables.ranges.shape[1]):
                tables.observations[i, setup.numbers + k] = tables.kept_rays[i, k]


@jit
def draw_fault_key(tables: Tables, i: int, setup: Setup) -> None:
    """Draw the key of robot i's episode; negative where the episode has no faults."""
    key = uniform(tables.random, i)
    ill = line_hash(key, WHOLE_EPISODE, 0.0, 0) < setup.faults.episodes
    tables.state[KEY, i] = key if ill else -1.0


@jit
def settle_with_faults(state: Floats, i: int, setup: Setup) -> None:
    """Run robot i's reset with faults: it waits for two fresh readings, as `Robot.reset`.

    Where the single env would raise BoardSilentError, SILENT is set.
    """
    ticks, fresh, age = 0.0, 0, 0.0
    state[LAST_COMMAND, i] = -1.0
    while fresh < 2:
        send_command(state, i, ticks, setup)
        ticks += 1.0
        state[LOOPS, i] = ticks * setup.loops
        found = receive_line(state, i, setup) > 0.0
        age = 0.0 if found else age + setup.period
        fresh += found
        if is_silent(age, setup.rules) or (fresh < 2 and ticks >= setup.faults.patience):
            state[SILENT, i] = 1.0
            break
    state[HEARD_TICK, i] = ticks - 1.0
    state[HEARD_LOOP, i] = -1e18
