"""One env step of many planar robots: the loops behind `vector.py`.

Robots are columns of one float64 array, their numbers are its rows, so that every loop over robots
runs over contiguous memory. The functions are the ones that the single environment uses, compiled:
motors and tyres of `dynamics`, equations of `kinematics` and `odometry`, the task of `tasks`. What
the firmware's twin does with bytes and queues is done with numbers here: a command takes effect
after `command_loops` loops of the firmware, a feedback line is made every `feedback_loops` and is
read `delay_loops` later, both rounded to the wire's two decimals.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym import kinematics, odometry, tasks
from acsar_gym.dynamics import Params, jit, loop, towards, tyre_step, wheel_speed
from acsar_gym.pcg import uniform
from acsar_gym.protocol import MAX_SPEED
from acsar_gym.worlds.geometry import Surroundings, cast, collides

Floats = NDArray[np.float64]

# Rows of the state. The body, in the world frame:
X, Y, THETA, VX, VY, RATE = range(6)
WHEEL, POINT, ANGLE = 6, 10, 14  # four each: speeds, set points, angles
# The commands: targets of the right and left side, before and after the newest line.
OLD_RIGHT, OLD_LEFT, NEW_RIGHT, NEW_LEFT, HEARD = range(18, 23)
# What the driver knows:
LOOPS, LAST_LINE, AGE, READ = 23, 24, 25, 26  # four readings
ODOM_X, ODOM_Y, ODOM_THETA, LINEAR, ANGULAR = range(30, 35)
# The task and the episode:
GOAL_X, GOAL_Y, DISTANCE, LAST_LINEAR, LAST_ANGULAR, STEPS, RETURN, OUTCOME = range(35, 43)
CONTACT = 43
# The robot's own physics, drawn anew with every episode where it is randomized:
MASS, INERTIA, GRIP, RADIUS, DEADBAND, BLEND, GAIN = 44, 45, 46, 47, 48, 49, 53
COMMAND_LOOPS, DELAY_LOOPS, FEEDBACK_LOOPS, DROPPED = range(57, 61)
ROWS = 61
INFO = (
    "goal_distance",
    "odom_x",
    "odom_y",
    "odom_theta",
    "feedback_age",
    "true_x",
    "true_y",
    "true_theta",
    "true_goal_distance",
    "true_contact",
    "odometry_error",
    "is_success",
)
"""Names of the rows of info."""
KEPT = 5
"""So many of them are in the state as they are."""
NUMBERS = 7
"""Numbers of the observation before the rays."""
BLOCK = 128
"""Robots that go through a whole env step together, so that their state stays in the cache."""


TURN = 2.0 * math.pi


class Setup(NamedTuple):
    """What all robots of a batch share."""

    dt: float
    period: float
    half_wheelbase: float
    half_track: float
    slip_speed: float
    ramp: float
    top: float
    counts_per_radian: float
    speed_per_count: float
    window: int
    """Loops over which the encoders average."""
    ticks: int
    """Control periods in an env step."""
    loops: int
    """Firmware loops in a control period."""
    radius: float
    """What the odometry takes the wheel radius for."""
    separation: float
    max_wheel_speed: float
    max_linear: float
    max_angular: float
    min_distance: float
    max_distance: float
    tolerance: float
    boundary: float
    max_steps: float


sides = jit(kinematics.sides)
forward = jit(kinematics.twist)
integrate = jit(odometry.integrate)
goal_at = jit(tasks.goal_at)
seen_from = jit(tasks.seen_from)
numbers = jit(tasks.point_goal_numbers)
outcome_of = jit(tasks.point_goal_outcome)
reward_of = jit(tasks.point_goal_reward)


@jit
def sincos(theta: float) -> tuple[float, float]:
    """Sine and cosine without a branch, to 1e-15 for |theta| below 1e4, so that loops vectorise.

    Reduction to a quarter turn in two parts, then the usual minimax polynomials.
    """
    turns = np.floor(theta * (2.0 / math.pi) + 0.5)
    r = (theta - turns * 1.5707963267341256) - turns * 6.077100506506192e-11
    z = r * r
    s = r + r * z * (
        -1.66666666666666324348e-01
        + z
        * (
            8.33333333332248946124e-03
            + z
            * (
                -1.98412698298579493134e-04
                + z
                * (
                    2.75573137070700676789e-06
                    + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)
                )
            )
        )
    )
    c = (
        1.0
        - 0.5 * z
        + z
        * z
        * (
            4.16666666666666019037e-02
            + z
            * (
                -1.38888888888741095749e-03
                + z
                * (
                    2.48015872894767294178e-05
                    + z
                    * (
                        -2.75573143513906633035e-07
                        + z * (2.08757232129817482790e-09 - z * 1.13596475577881948265e-11)
                    )
                )
            )
        )
    )
    quarter = turns - 4.0 * np.floor(turns * 0.25)
    swap = quarter in (1.0, 3.0)
    sine, cosine = (c if swap else s), (s if swap else c)
    return (
        -sine if quarter >= 2.0 else sine,
        -cosine if quarter in (1.0, 2.0) else cosine,
    )


@jit
def on_the_wire(speed: float) -> float:
    """The speed [rad/s] after encoding and decoding: two decimals, saturated."""
    rounded: float = np.rint(speed * 100.0) / 100.0
    return min(max(rounded, -MAX_SPEED), MAX_SPEED)


@jit
def row(state: Floats, number: int, first: int, last: int) -> Floats:
    """One number of robots first to last, contiguous."""
    return state[number, first:last]


@loop
def command(state: Floats, actions: Floats, first: int, last: int, setup: Setup) -> None:
    """Actions to the targets that the board will hear of in this step."""
    old_right, old_left = row(state, OLD_RIGHT, first, last), row(state, OLD_LEFT, first, last)
    new_right, new_left = row(state, NEW_RIGHT, first, last), row(state, NEW_LEFT, first, last)
    heard, delay = row(state, HEARD, first, last), row(state, COMMAND_LOOPS, first, last)
    for i in range(last - first):
        linear = min(max(actions[first + i, 0], -1.0), 1.0)
        angular = min(max(actions[first + i, 1], -1.0), 1.0)
        state[LAST_LINEAR, first + i] = linear
        state[LAST_ANGULAR, first + i] = angular
        right, left = sides(
            linear * setup.max_linear,
            angular * setup.max_angular,
            setup.radius,
            setup.separation,
            setup.max_wheel_speed,
        )
        if heard[i] < setup.ticks * setup.loops:  # else the last command was lost
            old_right[i] = new_right[i]
            old_left[i] = new_left[i]
        new_right[i] = min(max(on_the_wire(right), -setup.top), setup.top)
        new_left[i] = min(max(on_the_wire(left), -setup.top), setup.top)
        heard[i] = delay[i]


@loop
def ramp(state: Floats, first: int, last: int, now: float, setup: Setup) -> None:
    """Set points of the firmware move towards the targets it has heard of by loop `now`."""
    a, b = row(state, POINT, first, last), row(state, POINT + 1, first, last)
    c, d = row(state, POINT + 2, first, last), row(state, POINT + 3, first, last)
    old_right, old_left = row(state, OLD_RIGHT, first, last), row(state, OLD_LEFT, first, last)
    new_right, new_left = row(state, NEW_RIGHT, first, last), row(state, NEW_LEFT, first, last)
    heard, step = row(state, HEARD, first, last), setup.ramp
    for i in range(last - first):
        new = now >= heard[i]
        right = new_right[i] if new else old_right[i]
        left = new_left[i] if new else old_left[i]
        a[i] = towards(a[i], right, step)
        b[i] = towards(b[i], left, step)
        c[i] = towards(c[i], left, step)
        d[i] = towards(d[i], right, step)


@loop
def motors(state: Floats, counts: Floats, first: int, last: int, slot: int, setup: Setup) -> None:
    """Wheel speeds, wheel angles, and the encoders' counts of this loop."""
    deadband = row(state, DEADBAND, first, last)
    for k in range(4):
        speeds, angles = row(state, WHEEL + k, first, last), row(state, ANGLE + k, first, last)
        points, gains = row(state, POINT + k, first, last), row(state, GAIN + k, first, last)
        blends, seen = row(state, BLEND + k, first, last), counts[slot, k, first:last]
        for i in range(last - first):
            point = points[i] * gains[i]
            speed = wheel_speed(speeds[i], point, blends[i], deadband[i], setup.top)
            angle = angles[i] + speed * setup.dt
            speeds[i] = speed
            angles[i] = angle
            seen[i] = np.floor(angle * setup.counts_per_radian)


@loop
def tyres(state: Floats, first: int, last: int, setup: Setup) -> None:
    """Tyre forces, then semi-implicit Euler, as the planar body does it."""
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
    radii, grips = row(state, RADIUS, first, last), row(state, GRIP, first, last)
    masses, inertias = row(state, MASS, first, last), row(state, INERTIA, first, last)
    dt, slip = setup.dt, setup.slip_speed
    half, side = setup.half_wheelbase, setup.half_track
    for i in range(last - first):
        sin, cos = sincos(thetas[i])
        vx, vy = vxs[i], vys[i]
        params = Params(
            dt, radii[i], half, side, masses[i], inertias[i], grips[i], slip, 0.0, 0.0, 0.0
        )
        ahead, left, rate = tyre_step(
            cos * vx + sin * vy, cos * vy - sin * vx, rates[i], (a[i], b[i], c[i], d[i]), params
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
    """Number of the newest line that has arrived by loop `loops`; line n is made n * `every` on."""
    line: float = np.floor((loops - delay) / every + 1e-9)
    return line


@loop
def feedback(state: Floats, counts: Floats, first: int, last: int, slot: int, setup: Setup) -> None:
    """The newest line that has arrived by the end of a tick, if it hasn't been read before."""
    slots = counts.shape[0]
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
            new = slot - int(now - np.ceil(line * every[i] - 1e-9))
            new += slots if new < 0 else 0
            old = new - setup.window
            old += slots if old < 0 else 0
            for k in range(4):
                turned = counts[new, k, first + i] - counts[old, k, first + i]
                state[READ + k, first + i] = on_the_wire(turned * setup.speed_per_count)
        else:
            ages[i] += setup.period


@loop
def dead_reckoning(state: Floats, first: int, last: int, setup: Setup) -> None:
    """Equations (1)-(10) on the newest readings."""
    a, b = row(state, READ, first, last), row(state, READ + 1, first, last)
    c, d = row(state, READ + 2, first, last), row(state, READ + 3, first, last)
    xs, ys = row(state, ODOM_X, first, last), row(state, ODOM_Y, first, last)
    thetas = row(state, ODOM_THETA, first, last)
    linears, angulars = row(state, LINEAR, first, last), row(state, ANGULAR, first, last)
    radius, separation, dt = setup.radius, setup.separation, setup.period
    for i in range(last - first):
        linear, angular = forward(a[i], b[i], c[i], d[i], radius, separation)
        sin, cos = sincos(thetas[i])
        x, y, theta = integrate(xs[i], ys[i], thetas[i], cos, sin, linear, angular, dt)
        xs[i] = x
        ys[i] = y
        thetas[i] = theta - TURN * np.floor(theta / TURN + 0.5)
        linears[i] = linear
        angulars[i] = angular


@loop
def drop_lines(
    state: Floats, random: NDArray[np.uint64], first: int, last: int, tick: int, setup: Setup
) -> None:
    """Lose this tick's command line, its feedback line, or both, on robots with a bad cable."""
    for i in range(first, last):
        share = state[DROPPED, i]
        if share > 0.0:
            heard = tick * setup.loops + state[COMMAND_LOOPS, i]
            if state[HEARD, i] == heard and uniform(random, i) < share:
                state[HEARD, i] = heard + setup.loops
            every = state[FEEDBACK_LOOPS, i]
            loops = state[LOOPS, i] + setup.loops
            line = newest_line(loops, state[DELAY_LOOPS, i], every)
            if line > state[LAST_LINE, i] and uniform(random, i) < share:
                state[LAST_LINE, i] = line


@loop
def touch(state: Floats, first: int, last: int, around: Surroundings) -> None:
    """Note which robots touch an obstacle now."""
    many = around.circles.shape[0] > 1 or around.segments.shape[0] > 1
    for i in range(first, last):
        s, c = sincos(state[THETA, i])
        if collides(state[X, i], state[Y, i], c, s, i if many else 0, around):
            state[CONTACT, i] = 1.0


@loop
def look(
    state: Floats, observations: NDArray[np.float32], first: int, last: int, around: Surroundings
) -> None:
    """The ranges of every robot's rays, as shares of the reach, behind its other numbers."""
    if around.directions.shape[0] == 0:
        return
    many = around.circles.shape[0] > 1 or around.segments.shape[0] > 1
    ranges = np.empty(around.directions.shape[0])
    for i in range(first, last):
        s, c = sincos(state[THETA, i])
        cast(state[X, i], state[Y, i], c, s, i if many else 0, around, ranges)
        for k in range(len(ranges)):
            observations[i, NUMBERS + k] = ranges[k] / around.reach


@loop
def drive(
    state: Floats,
    counts: Floats,
    random: NDArray[np.uint64],
    first: int,
    last: int,
    slot: int,
    lossy: bool,
    setup: Setup,
    around: Surroundings,
) -> None:
    """All ticks of an env step. `slot` is where the last loop wrote its counts."""
    slots = counts.shape[0]
    crowded = around.circles.shape[1] + around.segments.shape[1] > 0
    for tick in range(setup.ticks):
        if lossy:
            drop_lines(state, random, first, last, tick, setup)
        for turn in range(tick * setup.loops, (tick + 1) * setup.loops):
            slot = (slot + 1) % slots
            ramp(state, first, last, turn, setup)
            motors(state, counts, first, last, slot, setup)
            tyres(state, first, last, setup)
        if crowded:
            touch(state, first, last, around)
        feedback(state, counts, first, last, slot, setup)
        dead_reckoning(state, first, last, setup)


@loop
def judge(
    state: Floats, rewards: Floats, ends: NDArray[np.bool_], first: int, last: int, setup: Setup
) -> None:
    """Reward, success, bounds and time limit after an env step; ends is (terminated, truncated)."""
    for i in range(first, last):
        x, y = state[ODOM_X, i], state[ODOM_Y, i]
        dx, dy = state[GOAL_X, i] - x, state[GOAL_Y, i] - y
        before, after = state[DISTANCE, i], math.sqrt(dx * dx + dy * dy)
        start = math.sqrt(x * x + y * y)
        outcome = outcome_of(after, start, setup.tolerance, setup.boundary)
        outcome = 3 if state[CONTACT, i] > 0.0 else outcome
        reward = reward_of(before, after, state[LAST_LINEAR, i], outcome)
        state[DISTANCE, i] = after
        state[OUTCOME, i] = outcome
        state[STEPS, i] += 1.0
        state[RETURN, i] += reward
        rewards[i] = reward
        ends[0, i] = outcome != 0
        ends[1, i] = state[STEPS, i] >= setup.max_steps


@loop
def observe(
    state: Floats, observations: NDArray[np.float32], first: int, last: int, setup: Setup
) -> None:
    """The task's observation of every robot."""
    scales = (setup.max_distance, setup.max_linear, setup.max_angular)
    for i in range(first, last):
        s, c = sincos(state[ODOM_THETA, i])
        distance, ahead, left = seen_from(
            state[ODOM_X, i], state[ODOM_Y, i], c, s, state[GOAL_X, i], state[GOAL_Y, i]
        )
        twist = (state[LINEAR, i], state[ANGULAR, i])
        o0, o1, o2, o3, o4 = numbers(distance, ahead, left, twist, scales)
        observations[i, 0] = o0
        observations[i, 1] = o1
        observations[i, 2] = o2
        observations[i, 3] = o3
        observations[i, 4] = o4
        observations[i, 5] = state[LAST_LINEAR, i]
        observations[i, 6] = state[LAST_ANGULAR, i]


@loop
def report(state: Floats, info: Floats, first: int, last: int) -> None:
    """The info of every robot: one row for each name in INFO."""
    for k in range(KEPT):
        kept, told = row(state, DISTANCE, first, last), row(info, k, first, last)
        if k > 0:
            kept = row(state, AGE if k == KEPT - 1 else ODOM_X + k - 1, first, last)
        for i in range(last - first):
            told[i] = kept[i]
    xs, ys, thetas = (
        row(state, X, first, last),
        row(state, Y, first, last),
        row(state, THETA, first, last),
    )
    goal_xs, goal_ys = row(state, GOAL_X, first, last), row(state, GOAL_Y, first, last)
    odom_xs, odom_ys = row(state, ODOM_X, first, last), row(state, ODOM_Y, first, last)
    contacts, outcomes = row(state, CONTACT, first, last), row(state, OUTCOME, first, last)
    for i in range(last - first):
        x, y, theta = xs[i], ys[i], thetas[i]
        gx, gy, ox, oy = goal_xs[i] - x, goal_ys[i] - y, odom_xs[i] - x, odom_ys[i] - y
        info[KEPT, first + i] = x
        info[KEPT + 1, first + i] = y
        info[KEPT + 2, first + i] = theta - TURN * np.floor(theta / TURN + 0.5)
        info[KEPT + 3, first + i] = math.sqrt(gx * gx + gy * gy)
        info[KEPT + 4, first + i] = contacts[i]
        info[KEPT + 5, first + i] = math.sqrt(ox * ox + oy * oy)
        info[KEPT + 6, first + i] = 1.0 if outcomes[i] == 1.0 else 0.0


@jit
def settle_ticks(delay: float, every: float, loops: float) -> float:
    """Ticks that a reset takes until two fresh readings have come, as in `Robot.reset`."""
    one: float = np.ceil((np.ceil(every - 1e-9) + delay) / loops)
    two: float = np.ceil((np.ceil(2.0 * every - 1e-9) + delay) / loops)
    return max(one + 1.0, two)


@loop
def draw(  # noqa: C901 - nine keys, one condition each
    state: Floats,
    random: NDArray[np.uint64],
    i: int,
    nominal: Floats,
    ranges: Floats,
    setup: Setup,
) -> None:
    """Robot i's own physics: nominal values, varied within `ranges` (see `Randomization`)."""
    for row in range(MASS, ROWS):
        state[row, i] = nominal[row]
    if ranges[0, 0] <= ranges[0, 1]:
        factor = between(ranges, 0, random, i)
        state[MASS, i] *= factor
        state[INERTIA, i] *= factor
        state[GRIP, i] *= factor
    if ranges[1, 0] <= ranges[1, 1]:
        state[GRIP, i] *= between(ranges, 1, random, i)
    for k in range(4):
        if ranges[2, 0] <= ranges[2, 1]:
            state[GAIN + k, i] *= between(ranges, 2, random, i)
        if ranges[3, 0] <= ranges[3, 1]:
            lag = -setup.dt / math.log(1.0 - nominal[BLEND + k])
            lag *= between(ranges, 3, random, i)
            state[BLEND + k, i] = 1.0 - math.exp(-setup.dt / lag)
    if ranges[4, 0] <= ranges[4, 1]:
        state[DEADBAND, i] = between(ranges, 4, random, i)
    if ranges[5, 0] <= ranges[5, 1]:
        state[RADIUS, i] *= between(ranges, 5, random, i)
    if ranges[6, 0] <= ranges[6, 1]:
        extra = np.rint(between(ranges, 6, random, i) / setup.dt)
        state[COMMAND_LOOPS, i] += extra
        state[DELAY_LOOPS, i] += extra
    if ranges[7, 0] <= ranges[7, 1]:
        rate = between(ranges, 7, random, i)
        state[FEEDBACK_LOOPS, i] = max(1.0, np.rint(1.0 / (rate * setup.dt)))
    if ranges[8, 0] <= ranges[8, 1]:
        state[DROPPED, i] = between(ranges, 8, random, i)


@jit
def between(ranges: Floats, key: int, random: NDArray[np.uint64], i: int) -> float:
    """A number from the range of one key."""
    low: float = ranges[key, 0]
    high: float = ranges[key, 1]
    return low + (high - low) * uniform(random, i)


@loop
def begin(
    state: Floats,
    counts: Floats,
    random: NDArray[np.uint64],
    i: int,
    nominal: Floats,
    ranges: Floats,
    setup: Setup,
) -> None:
    """A new episode of robot i: at rest at the origin, a goal of its own generator's making."""
    for row in range(MASS):
        state[row, i] = 0.0
    counts[:, :, i] = 0.0
    distance = setup.min_distance + (setup.max_distance - setup.min_distance) * uniform(random, i)
    bearing = -math.pi + (math.pi - -math.pi) * uniform(random, i)
    state[GOAL_X, i], state[GOAL_Y, i] = goal_at(distance, bearing)
    draw(state, random, i, nominal, ranges, setup)
    state[DISTANCE, i] = math.sqrt(state[GOAL_X, i] ** 2 + state[GOAL_Y, i] ** 2)
    settled = settle_ticks(state[DELAY_LOOPS, i], state[FEEDBACK_LOOPS, i], setup.loops)
    state[LOOPS, i] = settled * setup.loops
    every = state[FEEDBACK_LOOPS, i]
    state[LAST_LINE, i] = newest_line(state[LOOPS, i], state[DELAY_LOOPS, i], every)


@loop
def reset(
    state: Floats,
    counts: Floats,
    random: NDArray[np.uint64],
    nominal: Floats,
    ranges: Floats,
    observations: NDArray[np.float32],
    info: Floats,
    mask: NDArray[np.bool_],
    first: int,
    last: int,
    setup: Setup,
    around: Surroundings,
) -> None:
    """New episodes for the robots in the mask."""
    for i in range(first, last):
        if mask[i]:
            begin(state, counts, random, i, nominal, ranges, setup)
            observe(state, observations, i, i + 1, setup)
            look(state, observations, i, i + 1, around)
            report(state, info, i, i + 1)


@loop
def step(
    state: Floats,
    counts: Floats,
    random: NDArray[np.uint64],
    nominal: Floats,
    ranges: Floats,
    actions: Floats,
    over: NDArray[np.bool_],
    observations: NDArray[np.float32],
    info: Floats,
    rewards: Floats,
    ends: NDArray[np.bool_],
    first: int,
    last: int,
    slot: int,
    setup: Setup,
    around: Surroundings,
) -> None:
    """An env step of robots first to last; those that were over begin anew instead."""
    lossy = ranges[8, 0] <= ranges[8, 1]
    for low in range(first, last, BLOCK):
        high = min(low + BLOCK, last)
        command(state, actions, low, high, setup)
        drive(state, counts, random, low, high, slot, lossy, setup, around)
        judge(state, rewards, ends, low, high, setup)
        observe(state, observations, low, high, setup)
        for i in range(low, high):
            if over[i]:
                begin(state, counts, random, i, nominal, ranges, setup)
                observe(state, observations, i, i + 1, setup)
                rewards[i] = 0.0
                ends[0, i] = ends[1, i] = False
        look(state, observations, low, high, around)
        report(state, info, low, high)
