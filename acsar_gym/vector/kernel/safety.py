"""The safety layer of many robots, tick by tick, and commands on their way to the board.

Only where there are limits or a geofence: without them all commands of a step are the same, which
`physics.command` and `physics.ramp` make use of. Here every tick's command is kept in a ring until
the board hears of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from acsar_gym.dynamics.model import towards
from acsar_gym.jit import jit, loop
from acsar_gym.safety.limiter import Limits, limited
from acsar_gym.vector.kernel.dynamics import on_the_wire, sides, tell
from acsar_gym.vector.kernel.layout import (
    COMMAND_LOOPS,
    DROPPED,
    FENCED,
    LAST_ANGULAR,
    LAST_LINEAR,
    NEW_ANGULAR,
    NEW_LEFT,
    NEW_LINEAR,
    NEW_RIGHT,
    ODOM_X,
    ODOM_Y,
    PAST_ANGULAR,
    PAST_LINEAR,
    POINT,
    REASON,
    Floats,
    Setup,
    row,
)
from acsar_gym.vector.pcg import uniform

GEOFENCE = 2.0
"""The number of `safety.Reason.GEOFENCE`."""


@jit
def _within(axis: Limits, asked: float, last: float, before: float, dt: float) -> float:
    """`limited`, for compiled code can't unpack a tuple in a call."""
    return limited(asked, last, before, dt, axis[0], axis[1], axis[2], axis[3], axis[4], axis[5])


@loop
def ramps(state: Floats, first: int, last: int, setup: Setup) -> None:
    """The next twist of every robot within the limits; the two before it move on.

    One that is asked to stand, or is outside its fence, stops at once, as `Safety` has it.
    """
    asks, turns = row(state, LAST_LINEAR, first, last), row(state, LAST_ANGULAR, first, last)
    new, past = row(state, NEW_LINEAR, first, last), row(state, PAST_LINEAR, first, last)
    bent, past_bent = row(state, NEW_ANGULAR, first, last), row(state, PAST_ANGULAR, first, last)
    fenced = row(state, FENCED, first, last)
    for i in range(last - first):
        linear, angular = asks[i] * setup.max_linear, turns[i] * setup.max_angular
        stands = fenced[i] > 0.0 or (linear == 0.0 and angular == 0.0)
        linear = _within(setup.linear, linear, new[i], past[i], setup.period)
        angular = _within(setup.angular, angular, bent[i], past_bent[i], setup.period)
        past[i] = 0.0 if stands else new[i]
        new[i] = 0.0 if stands else linear
        past_bent[i] = 0.0 if stands else bent[i]
        bent[i] = 0.0 if stands else angular


@loop
def fence(state: Floats, first: int, last: int, setup: Setup) -> None:
    """Robots that are outside, until the next reset."""
    low_x, high_x, low_y, high_y = setup.fence
    for i in range(first, last):
        x, y = state[ODOM_X, i], state[ODOM_Y, i]
        if not (low_x <= x <= high_x and low_y <= y <= high_y):
            state[FENCED, i] = 1.0


@loop
def lines(state: Floats, commands: Floats, first: int, last: int, slot: int, setup: Setup) -> None:
    """This tick's command lines: speeds of the right and the left side, as the wire has them."""
    new, bent = row(state, NEW_LINEAR, first, last), row(state, NEW_ANGULAR, first, last)
    rights, lefts = commands[slot, 0, first:last], commands[slot, 1, first:last]
    radius, separation, top = setup.radius, setup.separation, setup.max_wheel_speed
    for i in range(last - first):
        right, left = sides(new[i], bent[i], radius, separation, top)
        rights[i] = min(max(on_the_wire(right), -setup.top), setup.top)
        lefts[i] = min(max(on_the_wire(left), -setup.top), setup.top)


@loop
def explain(state: Floats, first: int, last: int, setup: Setup) -> None:
    """What the newest command was, and why it isn't the one that was asked for."""
    radius, separation, top = setup.radius, setup.separation, setup.max_wheel_speed
    for i in range(first, last):
        linear = state[LAST_LINEAR, i] * setup.max_linear
        angular = state[LAST_ANGULAR, i] * setup.max_angular
        right, left = sides(state[NEW_LINEAR, i], state[NEW_ANGULAR, i], radius, separation, top)
        tell(state, i, linear, angular, right, left, setup)
        if state[FENCED, i] > 0.0:
            state[REASON, i] = GEOFENCE


@loop
def guard(state: Floats, commands: Floats, first: int, last: int, slot: int, setup: Setup) -> None:
    """The commands of one tick."""
    if setup.fenced:
        fence(state, first, last, setup)
    ramps(state, first, last, setup)
    lines(state, commands, first, last, slot, setup)


@loop
def lose(
    state: Floats, commands: Floats, random: NDArray[np.uint64], first: int, last: int, slot: int
) -> None:
    """Lose this tick's command line on robots with a bad cable: the board keeps the one before."""
    before = slot - 1 if slot > 0 else commands.shape[0] - 1
    for i in range(first, last):
        if state[DROPPED, i] > 0.0 and uniform(random, i) < state[DROPPED, i]:
            commands[slot, 0, i] = commands[before, 0, i]
            commands[slot, 1, i] = commands[before, 1, i]


@jit
def heard(delay: float, slot: int, slots: int, turn: int, loops: int) -> int:
    """The slot of the newest command that a board hears of by this loop of a tick."""
    place = slot + int(np.floor((turn - delay) / loops))
    return place + slots if place < 0 else place


@loop
def follow(
    state: Floats, commands: Floats, first: int, last: int, slot: int, turn: int, setup: Setup
) -> None:
    """Set points move towards the newest command that the board has heard of by this loop."""
    slots, step, delays = commands.shape[0], setup.ramp, row(state, COMMAND_LOOPS, first, last)
    differ = 0
    for i in range(last - first):
        differ += delays[i] != delays[0]
    place = heard(delays[0], slot, slots, turn, setup.loops)
    rights, lefts = commands[place, 0, first:last], commands[place, 1, first:last]
    if differ:
        rights, lefts = row(state, NEW_RIGHT, first, last), row(state, NEW_LEFT, first, last)
        for i in range(last - first):
            place = heard(delays[i], slot, slots, turn, setup.loops)
            rights[i], lefts[i] = commands[place, 0, first + i], commands[place, 1, first + i]
    a, b = row(state, POINT, first, last), row(state, POINT + 1, first, last)
    c, d = row(state, POINT + 2, first, last), row(state, POINT + 3, first, last)
    for i in range(last - first):
        right, left = rights[i], lefts[i]
        a[i] = towards(a[i], right, step)
        b[i] = towards(b[i], left, step)
        c[i] = towards(c[i], left, step)
        d[i] = towards(d[i], right, step)
