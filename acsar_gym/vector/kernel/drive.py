"""One env step of many planar robots, tick by tick: commands, board, motors, tyres and odometry.

Without limits, geofence, faults or late commands all commands of a step are the same, and
`command_once` and `ramp_to_newest` are fastest. Otherwise (`setup.guarded`) every tick's command is
kept in a ring until the board uses it.

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
from acsar_gym.physics.model import move_towards, round_printed, tyre_step, wheel_speed, whole_loops
from acsar_gym.trigonometry import sincos
from acsar_gym.protocol import MAX_SPEED, Speeds
from acsar_gym.safety.rules import (
    SafetyMemory,
    SafetyRules,
    compute_wheels,
    explain_sent,
    is_silent,
    limit_twist,
)
from acsar_gym.vector.kernel import layout as rows
from acsar_gym.vector.kernel.layout import (
    ROBOTS_PER_BLOCK,
    Floats,
    LineFaults,
    Records,
    Setup,
    Tables,
    row,
)
from acsar_gym.vector.kernel.lidars import check_contacts, mark_trails, read_scans
from acsar_gym.worlds.geometry import Surroundings

forward = jit(kinematics.compute_twist)
integrate = jit(odometry.integrate_twist)
FourRows = tuple[Floats, Floats, Floats, Floats]
SILENCE = 1.0
"""The code of BoardSilentError in info's `fault`, see `envs.base.fault_code`."""


@jit
def four_rows(state: Floats, number: int, first: int, last: int) -> FourRows:
    """Views of four numbers of robots first to last that follow each other, such as of wheels."""
    return (
        row(state, number, first, last),
        row(state, number + 1, first, last),
        row(state, number + 2, first, last),
        row(state, number + 3, first, last),
    )


@jit
def round_as_sent(speed: float) -> float:
    """A wheel speed [rad/s] after encoding and decoding: two decimals, saturated."""
    rounded: float = np.rint(speed * 100.0) / 100.0
    return min(max(rounded, -MAX_SPEED), MAX_SPEED)


@jit
def command_once(state: Floats, first: int, last: int, setup: Setup, rules: SafetyRules) -> None:
    """Compute the wheel targets of this step's command line. Only without limits or faults."""
    old_right, old_left, new_right, new_left = four_rows(state, rows.OLD_RIGHT, first, last)
    heard, delay = row(state, rows.HEARD, first, last), row(state, rows.COMMAND_LOOPS, first, last)
    asks = row(state, rows.LAST_LINEAR, first, last)
    turns = row(state, rows.LAST_ANGULAR, first, last)
    sent = row(state, rows.SENT_LINEAR, first, last)
    bent = row(state, rows.SENT_ANGULAR, first, last)
    reasons = row(state, rows.REASON, first, last)
    ahead, turn, top = setup.max_linear, setup.max_angular, setup.top  # loads don't vectorize
    for i in range(last - first):
        linear, angular = asks[i] * ahead, turns[i] * turn
        right, left = compute_wheels(linear, angular, rules)
        sent[i], bent[i], reasons[i] = explain_sent(linear, angular, right, left, 0.0, rules)
        old_right[i] = new_right[i]
        old_left[i] = new_left[i]
        new_right[i] = min(max(round_as_sent(right), -top), top)
        new_left[i] = min(max(round_as_sent(left), -top), top)
        heard[i] = delay[i]


@jit
def limit_twists(state: Floats, first: int, last: int, setup: Setup, rules: SafetyRules) -> None:
    """Compute the twist that every robot is sent in this tick."""
    asks = row(state, rows.LAST_LINEAR, first, last)
    turns = row(state, rows.LAST_ANGULAR, first, last)
    new, past = row(state, rows.NEW_LINEAR, first, last), row(state, rows.PAST_LINEAR, first, last)
    bent = row(state, rows.NEW_ANGULAR, first, last)
    past_bent = row(state, rows.PAST_ANGULAR, first, last)
    latched, reasons = row(state, rows.LATCHED, first, last), row(state, rows.REASON, first, last)
    xs, ys = row(state, rows.ODOM_X, first, last), row(state, rows.ODOM_Y, first, last)
    ages = row(state, rows.AGE, first, last)
    ahead, turn = setup.max_linear, setup.max_angular
    for i in range(last - first):
        linear, angular = asks[i] * ahead, turns[i] * turn
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
    state: Floats,
    commands: Floats,
    first: int,
    last: int,
    slot: int,
    setup: Setup,
    rules: SafetyRules,
) -> None:
    """Compute and store this tick's command lines: wheel speeds right and left [rad/s]."""
    limit_twists(state, first, last, setup, rules)
    new, bent = row(state, rows.NEW_LINEAR, first, last), row(state, rows.NEW_ANGULAR, first, last)
    rights, lefts = commands[slot, 0, first:last], commands[slot, 1, first:last]
    top = setup.top
    for i in range(last - first):
        right, left = compute_wheels(new[i], bent[i], rules)
        rights[i] = min(max(round_as_sent(right), -top), top)
        lefts[i] = min(max(round_as_sent(left), -top), top)


@jit
def explain_commands(
    state: Floats, first: int, last: int, setup: Setup, rules: SafetyRules
) -> None:
    """Store the twist of the newest command line, and the reason why it isn't the one asked for."""
    for i in range(first, last):
        linear = state[rows.LAST_LINEAR, i] * setup.max_linear
        angular = state[rows.LAST_ANGULAR, i] * setup.max_angular
        right, left = compute_wheels(state[rows.NEW_LINEAR, i], state[rows.NEW_ANGULAR, i], rules)
        ahead, turn, why = explain_sent(linear, angular, right, left, state[rows.REASON, i], rules)
        state[rows.SENT_LINEAR, i] = ahead
        state[rows.SENT_ANGULAR, i] = turn
        state[rows.REASON, i] = why


@jit
def release_time(
    key: float, whose: int, number: float, arrived: float, before: float, faults: LineFaults
) -> float:
    """Time at which the wire passes a line on [s]; NaN where the line is lost.

    Args:
        key: of the episode; negative where it has no faults.
        whose: COMMAND_LINE or FEEDBACK_LINE.
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
    while state[rows.LAST_COMMAND, i] < tick:
        line = state[rows.LAST_COMMAND, i] + 1.0
        written, before = line * setup.period, state[rows.COMMAND_RELEASE, i]
        when = release_time(state[rows.KEY, i], COMMAND_LINE, line, written, before, setup.faults)
        if when > now + TIME_TOLERANCE:
            break
        state[rows.LAST_COMMAND, i] = line
        if not math.isnan(when):
            state[rows.COMMAND_RELEASE, i] = when
            newest, count = line, count + 1.0
    if count == 0.0:
        return newest, np.inf
    faults = setup.faults
    state[rows.BOARD_FREE, i] = max(state[rows.BOARD_FREE, i], now) + count * faults.line_time
    read = state[rows.BOARD_FREE, i] + faults.processing_time + state[rows.COMMAND_DELAY, i]
    return newest, whole_loops(read, setup.dt) + state[rows.LATENCY_LOOPS, i]


@jit
def dispatch_commands(
    state: Floats,
    commands: Floats,
    arrivals: Floats,
    first: int,
    last: int,
    slot: int,
    setup: Setup,
) -> None:
    """Store in the ring's slot which commands the wire passes on to the boards in this tick."""
    slots = commands.shape[0]
    for i in range(first, last):
        tick = state[rows.LOOPS, i] / setup.loops
        newest, loop_of = send_command(state, i, tick, setup)
        arrivals[slot, 0, i] = loop_of
        if newest >= 0.0:
            place = (slot - int(tick - newest) + slots) % slots
            arrivals[slot, 1, i] = commands[place, 0, i]
            arrivals[slot, 2, i] = commands[place, 1, i]


@jit
def ramps_of(setup: Setup) -> Speeds:
    """How far the set points of the wheels may move in a firmware loop [rad/s]."""
    return setup.ramps.a, setup.ramps.b, setup.ramps.c, setup.ramps.d


@jit
def ramp_to_newest(state: Floats, first: int, last: int, now: float, setup: Setup) -> None:
    """Move set points towards the newest targets that the board knows by loop `now`."""
    a, b, c, d = four_rows(state, rows.POINT, first, last)
    old_right, old_left, new_right, new_left = four_rows(state, rows.OLD_RIGHT, first, last)
    heard, steps = row(state, rows.HEARD, first, last), ramps_of(setup)
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
    """Slot of the newest command that has effect in firmware loop `turn` of a tick.

    It takes effect `delay` firmware loops after it was written; `slot` has this tick's command.
    """
    place = slot + int(np.floor((turn - delay) / loops))
    return place + slots if place < 0 else place


@jit
def follow_commands(
    state: Floats, commands: Floats, first: int, last: int, slot: int, turn: int, setup: Setup
) -> None:
    """Move set points towards the newest command that each board knows by this loop."""
    slots, delays = commands.shape[0], row(state, rows.COMMAND_LOOPS, first, last)
    differ = 0
    for i in range(last - first):
        differ += delays[i] != delays[0]
    place = find_command(delays[0], slot, slots, turn, setup.loops)
    rights, lefts = commands[place, 0, first:last], commands[place, 1, first:last]
    if differ:
        rights = row(state, rows.NEW_RIGHT, first, last)
        lefts = row(state, rows.NEW_LEFT, first, last)
        for i in range(last - first):
            place = find_command(delays[i], slot, slots, turn, setup.loops)
            rights[i], lefts[i] = commands[place, 0, first + i], commands[place, 1, first + i]
    move_set_points(state, rights, lefts, first, last, ramps_of(setup))


@jit
def obey_commands(
    state: Floats, arrivals: Floats, first: int, last: int, slot: int, turn: int, setup: Setup
) -> None:
    """Let boards obey the commands that have arrived by this loop.

    A board that gets no command for longer than its time-out stops its motors.
    """
    slots = arrivals.shape[0]
    for i in range(first, last):
        tick, now = state[rows.LOOPS, i] / setup.loops, state[rows.LOOPS, i] + turn
        while state[rows.HEARD_TICK, i] < tick:
            place = (slot - int(tick - state[rows.HEARD_TICK, i] - 1.0) + slots) % slots
            if arrivals[place, 0, i] < np.inf:
                if arrivals[place, 0, i] > now:
                    break
                state[rows.NEW_RIGHT, i] = arrivals[place, 1, i]
                state[rows.NEW_LEFT, i] = arrivals[place, 2, i]
                state[rows.HEARD_LOOP, i] = now
            state[rows.HEARD_TICK, i] += 1.0
        if (
            now - state[rows.HEARD_LOOP, i]
        ) * setup.dt > setup.faults.command_timeout + TIME_TOLERANCE:
            state[rows.NEW_RIGHT, i] = state[rows.NEW_LEFT, i] = 0.0
    rights, lefts = row(state, rows.NEW_RIGHT, first, last), row(state, rows.NEW_LEFT, first, last)
    move_set_points(state, rights, lefts, first, last, ramps_of(setup))


@jit
def move_set_points(
    state: Floats, rights: Floats, lefts: Floats, first: int, last: int, steps: Speeds
) -> None:
    """Move set points towards these targets of the right and the left wheels [rad/s]."""
    a, b, c, d = four_rows(state, rows.POINT, first, last)
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
    top, dt, counts_per_radian = setup.top, setup.dt, setup.counts_per_radian
    for k in range(4):
        speeds = row(state, rows.WHEEL + k, first, last)
        angles = row(state, rows.ANGLE + k, first, last)
        points = row(state, rows.POINT + k, first, last)
        gains = row(state, rows.MOTOR_GAIN + k, first, last)
        blends = row(state, rows.BLEND + k, first, last)
        deadbands = row(state, rows.MOTOR_DEADBAND + k, first, last)
        seen = counts[slot, k, first:last]
        for i in range(last - first):
            speed = wheel_speed(speeds[i], points[i], gains[i], blends[i], deadbands[i], top)
            angle = angles[i] + speed * dt
            speeds[i] = speed
            angles[i] = angle
            seen[i] = np.floor(angle * counts_per_radian)


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
    xs = row(state, rows.X, first, last)
    ys = row(state, rows.Y, first, last)
    thetas = row(state, rows.THETA, first, last)
    vxs = row(state, rows.VX, first, last)
    vys = row(state, rows.VY, first, last)
    rates = row(state, rows.RATE, first, last)
    a, b, c, d = four_rows(state, rows.WHEEL, first, last)
    left_radii = row(state, rows.LEFT_RADIUS, first, last)
    right_radii = row(state, rows.RIGHT_RADIUS, first, last)
    lengths = row(state, rows.HALF_WHEELBASE, first, last)
    widths = row(state, rows.HALF_TRACK, first, last)
    masses, inertias = row(state, rows.MASS, first, last), row(state, rows.YAW_INERTIA, first, last)
    grips, slips = row(state, rows.GRIP, first, last), row(state, rows.SLIP_SPEED, first, last)
    kappas = row(state, rows.KAPPA, first, last)
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
def read_encoders(
    state: Floats, counts: Floats, i: int, slot: int, ago: int, encoder: tuple[int, float, float]
) -> None:
    """Set robot i's wheel speeds from what its encoders had counted `ago` firmware loops ago.

    `encoder` has the setup's window, speed_per_count and quantum.
    """
    slots, (window, speed_per_count, quantum) = counts.shape[0], encoder
    new = slot - ago
    new += slots if new < 0 else 0
    old = new - window
    old += slots if old < 0 else 0
    for k in range(4):
        speed = (counts[new, k, i] - counts[old, k, i]) * speed_per_count
        if quantum > 0.0:
            speed = round_printed(speed, quantum)
        state[rows.READ + k, i] = round_as_sent(speed)


@jit
def newest_line(loops: float, delay: float, every: float) -> float:
    """Number of the newest feedback line that has arrived by a firmware loop, without faults.

    Line n is made n * `every` firmware loops after the reset, and used `delay` later.
    """
    line: float = np.floor((loops - delay) / every + 1e-9)
    return line


@jit
def receive_line(state: Floats, i: int, setup: Setup) -> float:
    """Number of the newest feedback line that reaches robot i by the end of its tick; 0 for none.

    LOOPS must include the loops of this tick.
    """
    loops, every = state[rows.LOOPS, i], state[rows.FEEDBACK_LOOPS, i]
    delay = state[rows.DELAY_LOOPS, i]
    now, found, newest = loops * setup.dt, 0.0, newest_line(loops, delay, every)
    while state[rows.LAST_LINE, i] < newest:
        line = state[rows.LAST_LINE, i] + 1.0
        made = np.ceil(line * every - 1e-9)
        arrived = np.ceil((made + delay) / setup.loops) * setup.period
        before = state[rows.FEEDBACK_RELEASE, i]
        when = release_time(
            state[rows.KEY, i], FEEDBACK_LINE, line - 1.0, arrived, before, setup.faults
        )
        if when > now + TIME_TOLERANCE:
            break
        state[rows.LAST_LINE, i] = line
        if not math.isnan(when):
            state[rows.FEEDBACK_RELEASE, i] = when
            found = line
    return found


@jit
def read_feedback(
    state: Floats, counts: Floats, first: int, last: int, slot: int, setup: Setup
) -> None:
    """Read the newest feedback line that has arrived by the end of a tick, if it is new."""
    loops, ages = row(state, rows.LOOPS, first, last), row(state, rows.AGE, first, last)
    lines = row(state, rows.LAST_LINE, first, last)
    every = row(state, rows.FEEDBACK_LOOPS, first, last)
    delays = row(state, rows.DELAY_LOOPS, first, last)
    faulty, period, turns = setup.faults.possible, setup.period, setup.loops
    encoder = setup.window, setup.speed_per_count, setup.quantum
    for i in range(last - first):
        loops[i] += turns
        if faulty:
            line = receive_line(state, first + i, setup)
        else:
            line = newest_line(loops[i], delays[i], every[i])
            line = line if line > lines[i] else 0.0
        if line > 0.0:
            lines[i] = max(lines[i], line)
            ages[i] = 0.0
            made = np.ceil(line * every[i] - 1e-9)
            read_encoders(state, counts, first + i, slot, int(loops[i] - made), encoder)
        else:
            ages[i] += period


@jit
def update_odometry(state: Floats, first: int, last: int, setup: Setup) -> None:
    """Update odometry with equations (1)-(10) on the newest wheel speeds."""
    a, b, c, d = four_rows(state, rows.READ, first, last)
    xs, ys = row(state, rows.ODOM_X, first, last), row(state, rows.ODOM_Y, first, last)
    thetas = row(state, rows.ODOM_THETA, first, last)
    linears, angulars = row(state, rows.LINEAR, first, last), row(state, rows.ANGULAR, first, last)
    left, right, separation = setup.left_radius, setup.right_radius, setup.separation
    dt = setup.period
    for i in range(last - first):
        linear, angular = forward(a[i], b[i], c[i], d[i], left, right, separation)
        sin, cos = sincos(thetas[i])
        x, y, theta = integrate(xs[i], ys[i], thetas[i], cos, sin, linear, angular, dt)
        xs[i] = x
        ys[i] = y
        thetas[i] = theta - rows.TURN * np.floor(theta / rows.TURN + 0.5)
        linears[i] = linear
        angulars[i] = angular


@loop
def step(  # noqa: C901, PLR0912, PLR0915 - every part that takes all tables compiles for longer
    tables: Tables,
    first: int,
    last: int,
    setups: Records,
    rules: SafetyRules,
    around: Surroundings,
) -> None:
    """Run physics and driver of the robots over the ticks that `tables.ring` says.

    The step ends with its last tick. `episode.reset` of the robots in `tables.over` comes after
    this, then the task's loop. Robots whose board falls silent during a step end it as they were
    before it, but for their fault.
    """
    state, counts, commands, setup = tables.state, tables.counts, tables.commands, setups[0]
    slots, lines = counts.shape[0], max(commands.shape[0], 1)
    start, stop, numbers = tables.ring[2], tables.ring[3], setup.numbers
    crowded = around.circles.shape[1] + around.segments.shape[1] > 0
    for low in range(first, last, ROBOTS_PER_BLOCK):
        high = min(low + ROBOTS_PER_BLOCK, last)
        if start == 0:
            for i in range(low, high):
                state[rows.LAST_LINEAR, i] = min(max(tables.actions[i, 0], -1.0), 1.0)
                state[rows.LAST_ANGULAR, i] = min(max(tables.actions[i, 1], -1.0), 1.0)
                tables.idle[i] = tables.over[i]
            if not setup.guarded:
                command_once(state, low, high, setup, rules)
            if setup.falls_silent:
                for i in range(low, high):
                    tables.idle[i] |= state[rows.SILENT, i] > 0.0
                    for number in range(rows.COMMAND_LOOPS):
                        tables.kept[number, i] = state[number, i]
                    for k in range(tables.ranges.shape[1]):
                        tables.kept_rays[i, k] = tables.observations[i, numbers + k]
        slot, line = (
            (tables.ring[0] + start * setup.loops) % slots,
            (tables.ring[1] + start) % lines,
        )
        for tick in range(start, stop):
            line = (line + 1) % lines
            if setup.guarded:
                store_commands(state, commands, low, high, line, setup, rules)
            if setup.faults.possible:
                dispatch_commands(state, commands, tables.arrivals, low, high, line, setup)
            for turn in range(setup.loops):
                if setup.faults.possible:
                    obey_commands(state, tables.arrivals, low, high, line, turn, setup)
                elif setup.guarded:
                    follow_commands(state, commands, low, high, line, turn, setup)
                else:
                    ramp_to_newest(state, low, high, tick * setup.loops + turn, setup)
                turn_motors(state, counts, low, high, (slot + 1 + turn) % slots, setup)
                move_bodies(state, low, high, setup)
            slot = (slot + setup.loops) % slots
            if crowded:
                check_contacts(state, low, high, around)
            read_feedback(state, counts, low, high, slot, setup)
            if setup.faults.possible:
                for i in range(low, high):
                    tables.idle[i] |= is_silent(state[rows.AGE, i], rules)
            update_odometry(state, low, high, setup)
            if setup.sees:
                for i in range(low, high):
                    mark_trails(tables, i, setup, state[rows.STEPS, i] * setup.ticks + tick + 1.0)
        if setup.guarded:
            explain_commands(state, low, high, setup, rules)
        if stop < setup.ticks:
            continue
        if setup.sees:
            read_scans(tables, low, high, setup, around, False)
        if setup.falls_silent:
            for i in range(low, high):
                if tables.idle[i] and not tables.over[i]:
                    for number in range(rows.COMMAND_LOOPS):
                        state[number, i] = tables.kept[number, i]
                    state[rows.FAULT, i] = SILENCE
                    for k in range(tables.ranges.shape[1]):
                        tables.observations[i, numbers + k] = tables.kept_rays[i, k]
        steps = row(state, rows.STEPS, low, high)
        for i in range(high - low):
            steps[i] += 1.0


@jit
def settle_with_faults(state: Floats, i: int, setup: Setup, rules: SafetyRules) -> None:
    """Run robot i's reset with faults: it waits for two fresh readings, as `Robot.reset`.

    Where the single env would raise BoardSilentError, SILENT is set.
    """
    ticks, fresh, age = 0.0, 0, 0.0
    state[rows.LAST_COMMAND, i] = -1.0
    while fresh < 2:
        send_command(state, i, ticks, setup)
        ticks += 1.0
        state[rows.LOOPS, i] = ticks * setup.loops
        found = receive_line(state, i, setup) > 0.0
        age = 0.0 if found else age + setup.period
        fresh += found
        if is_silent(age, rules) or (fresh < 2 and ticks >= setup.faults.patience):
            state[rows.SILENT, i] = 1.0
            break
    state[rows.HEARD_TICK, i] = ticks - 1.0
    state[rows.HEARD_LOOP, i] = -1e18
