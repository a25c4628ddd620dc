"""The safety layer of many robots, tick by tick, and commands on their way to the board.

Only where there are limits or a geofence: without them all commands of a step are the same, which
`physics.command` and `physics.ramp` make use of. Here every tick's command is kept in a ring until
the board hears of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from acsar_gym.compiled import jit, loop
from acsar_gym.dynamics import towards
from acsar_gym.kernel.layout import (
    COMMAND_LOOPS,
    DROPPED,
    FENCED,
    LAST_ANGULAR,
    LAST_LINEAR,
    NEW_ANGULAR,
    NEW_LINEAR,
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
)
from acsar_gym.kernel.physics import on_the_wire, sides, tell
from acsar_gym.limiter import Limits, limited
from acsar_gym.pcg import uniform

GEOFENCE = 2.0
"""The number of `safety.Reason.GEOFENCE`."""


@jit
def wanted(state: Floats, i: int, setup: Setup) -> tuple[float, float]:
    """Robot i's next twist within the limits; the two before it move on."""
    asked = state[LAST_LINEAR, i] * setup.max_linear
    new, past = state[NEW_LINEAR, i], state[PAST_LINEAR, i]
    linear = _within(setup.linear, asked, new, past, setup.period)
    state[PAST_LINEAR, i], state[NEW_LINEAR, i] = new, linear
    asked = state[LAST_ANGULAR, i] * setup.max_angular
    new, past = state[NEW_ANGULAR, i], state[PAST_ANGULAR, i]
    angular = _within(setup.angular, asked, new, past, setup.period)
    state[PAST_ANGULAR, i], state[NEW_ANGULAR, i] = new, angular
    return linear, angular


@jit
def _within(axis: Limits, asked: float, last: float, before: float, dt: float) -> float:
    """`limited`, for compiled code can't unpack a tuple in a call."""
    return limited(asked, last, before, dt, axis[0], axis[1], axis[2], axis[3], axis[4], axis[5])


@jit
def halt(state: Floats, i: int) -> None:
    """Robot i is outside its fence: zero until the next reset."""
    state[NEW_LINEAR, i] = state[PAST_LINEAR, i] = 0.0
    state[NEW_ANGULAR, i] = state[PAST_ANGULAR, i] = 0.0
    state[SENT_LINEAR, i] = state[SENT_ANGULAR, i] = 0.0
    state[REASON, i] = GEOFENCE


@loop
def guard(state: Floats, commands: Floats, first: int, last: int, slot: int, setup: Setup) -> None:
    """This tick's command lines: speeds of the right and the left side, as the wire has them."""
    low_x, high_x, low_y, high_y = setup.fence
    for i in range(first, last):
        x, y = state[ODOM_X, i], state[ODOM_Y, i]
        linear, angular = wanted(state, i, setup)
        if not (low_x <= x <= high_x and low_y <= y <= high_y):
            state[FENCED, i] = 1.0
        right, left = sides(linear, angular, setup.radius, setup.separation, setup.max_wheel_speed)
        asked_linear = state[LAST_LINEAR, i] * setup.max_linear
        asked_angular = state[LAST_ANGULAR, i] * setup.max_angular
        tell(state, i, asked_linear, asked_angular, right, left, setup)
        if state[FENCED, i] > 0.0:
            halt(state, i)
            right = left = 0.0
        commands[slot, 0, i] = min(max(on_the_wire(right), -setup.top), setup.top)
        commands[slot, 1, i] = min(max(on_the_wire(left), -setup.top), setup.top)


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


@loop
def follow(
    state: Floats, commands: Floats, first: int, last: int, slot: int, turn: int, setup: Setup
) -> None:
    """Set points move towards the newest command that the board has heard of by this loop."""
    slots, step = commands.shape[0], setup.ramp
    for i in range(first, last):
        back = -int(np.floor((turn - state[COMMAND_LOOPS, i]) / setup.loops))
        heard = slot - back
        heard += slots if heard < 0 else 0
        right, left = commands[heard, 0, i], commands[heard, 1, i]
        state[POINT, i] = towards(state[POINT, i], right, step)
        state[POINT + 1, i] = towards(state[POINT + 1, i], left, step)
        state[POINT + 2, i] = towards(state[POINT + 2, i], left, step)
        state[POINT + 3, i] = towards(state[POINT + 3, i], right, step)
