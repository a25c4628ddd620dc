"""The safety layer of many robots, tick by tick, and commands on their way to the board.

Used only where there are limits, a geofence, faults, or commands that take longer than a step.
Without them all commands of a step are the same, and `dynamics.command` and `dynamics.ramp` are
faster. Here every tick's command is kept in a ring until the board uses it. The rules are those of
`acsar_gym.safety.rules`.
"""

from __future__ import annotations

import numpy as np

from acsar_gym.dynamics.board import towards
from acsar_gym.jit import jit
from acsar_gym.protocol import Speeds
from acsar_gym.safety.rules import Memory, allowed, told, wheels
from acsar_gym.vector.kernel.dynamics import on_the_wire
from acsar_gym.vector.kernel.layout import (
    AGE,
    COMMAND_LOOPS,
    LAST_ANGULAR,
    LAST_LINEAR,
    LATCHED,
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
    SENT_ANGULAR,
    SENT_LINEAR,
    Floats,
    Setup,
    row,
)


@jit
def guard(state: Floats, first: int, last: int, setup: Setup) -> None:
    """Compute the twist that every robot is sent in this tick."""
    asks, turns = row(state, LAST_LINEAR, first, last), row(state, LAST_ANGULAR, first, last)
    new, past = row(state, NEW_LINEAR, first, last), row(state, PAST_LINEAR, first, last)
    bent, past_bent = row(state, NEW_ANGULAR, first, last), row(state, PAST_ANGULAR, first, last)
    latched, reasons = row(state, LATCHED, first, last), row(state, REASON, first, last)
    xs, ys = row(state, ODOM_X, first, last), row(state, ODOM_Y, first, last)
    ages, rules = row(state, AGE, first, last), setup.rules
    for i in range(last - first):
        linear, angular = asks[i] * setup.max_linear, turns[i] * setup.max_angular
        before = Memory(latched[i], 0.0, new[i], bent[i], past[i], past_bent[i], 0.0, 0.0)
        after = allowed(linear, angular, xs[i], ys[i], ages[i], before, rules)
        latched[i] = after.latched
        reasons[i] = after.reason
        new[i] = after.linear
        bent[i] = after.angular
        past[i] = after.past_linear
        past_bent[i] = after.past_angular


@jit
def lines(state: Floats, commands: Floats, first: int, last: int, slot: int, setup: Setup) -> None:
    """Store this tick's command lines: wheel speeds right and left [rad/s]."""
    new, bent = row(state, NEW_LINEAR, first, last), row(state, NEW_ANGULAR, first, last)
    rights, lefts = commands[slot, 0, first:last], commands[slot, 1, first:last]
    for i in range(last - first):
        right, left = wheels(new[i], bent[i], setup.rules)
        rights[i] = min(max(on_the_wire(right), -setup.top), setup.top)
        lefts[i] = min(max(on_the_wire(left), -setup.top), setup.top)


@jit
def explain(state: Floats, first: int, last: int, setup: Setup) -> None:
    """Store the twist of the newest command line, and the reason why it isn't the one asked for."""
    for i in range(first, last):
        linear = state[LAST_LINEAR, i] * setup.max_linear
        angular = state[LAST_ANGULAR, i] * setup.max_angular
        right, left = wheels(state[NEW_LINEAR, i], state[NEW_ANGULAR, i], setup.rules)
        ahead, turn, why = told(linear, angular, right, left, state[REASON, i], setup.rules)
        state[SENT_LINEAR, i] = ahead
        state[SENT_ANGULAR, i] = turn
        state[REASON, i] = why


@jit
def heard(delay: float, slot: int, slots: int, turn: int, loops: int) -> int:
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
def follow(
    state: Floats, commands: Floats, first: int, last: int, slot: int, turn: int, setup: Setup
) -> None:
    """Move set points towards the newest command that each board knows by this loop."""
    slots, delays = commands.shape[0], row(state, COMMAND_LOOPS, first, last)
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
    approach(state, rights, lefts, first, last, setup.ramps)


@jit
def approach(
    state: Floats, rights: Floats, lefts: Floats, first: int, last: int, steps: Speeds
) -> None:
    """Move set points towards these targets of the right and the left wheels [rad/s]."""
    a, b = row(state, POINT, first, last), row(state, POINT + 1, first, last)
    c, d = row(state, POINT + 2, first, last), row(state, POINT + 3, first, last)
    for i in range(last - first):
        right, left = rights[i], lefts[i]
        a[i] = towards(a[i], right, steps[0])
        b[i] = towards(b[i], left, steps[1])
        c[i] = towards(c[i], left, steps[2])
        d[i] = towards(d[i], right, steps[3])
