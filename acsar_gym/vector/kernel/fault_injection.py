"""Lines between drivers and boards that are lost or late, as `links.fault_injection` has them.

Which ones is a hash of the episode's key and the line's number. Lines keep their order: one behind
a late line comes no earlier than that. Numbers count from the reset on, those of the ticks in which
a reset waits for the wheels to stand included; commands from 0, feedback from 1.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import jit
from acsar_gym.links.faults import DROPPED, EPSILON, LATE
from acsar_gym.links.lots import COMMANDS, EPISODE, FEEDBACK, lot
from acsar_gym.safety import rules
from acsar_gym.vector.kernel.layout import (
    AGE,
    BOARD_FREE,
    COMMAND_LOOPS,
    COMMAND_RELEASE,
    DELAY_LOOPS,
    FAULT,
    FEEDBACK_LOOPS,
    FEEDBACK_RELEASE,
    HEARD_LOOP,
    HEARD_TICK,
    KEY,
    LAST_COMMAND,
    LAST_LINE,
    LOOPS,
    NEW_LEFT,
    NEW_RIGHT,
    SCAN_TICK,
    SILENT,
    Floats,
    LineFaults,
    Setup,
    Tables,
    row,
)
from acsar_gym.vector.kernel.safety import approach
from acsar_gym.vector.pcg import uniform

silent = jit(rules.silent)
SILENCE = 1.0
"""The number of BoardSilentError, see `envs.base.fault_code`."""


@jit
def released(
    key: float, whose: int, number: float, arrived: float, before: float, faults: LineFaults
) -> float:
    """When a line that arrived then is let through [s]; NaN where it never is.

    `before` is when the line before it was. A negative key is that of a sound episode.
    """
    suffers = faults.feedback if whose == FEEDBACK else faults.commands
    if key < 0.0 or not suffers:
        return arrived
    if faults.dropped > 0.0 and lot(key, whose, number, DROPPED) < faults.dropped:
        return np.nan
    late = faults.late > 0.0 and lot(key, whose, number, LATE) < faults.late
    return max(before, arrived + faults.lateness if late else arrived)


@jit
def listen(state: Floats, i: int, setup: Setup) -> float:
    """Number of the newest feedback line that comes to robot i by the end of its tick, or 0.

    The tick's loops have been counted.
    """
    loops, every, delay = state[LOOPS, i], state[FEEDBACK_LOOPS, i], state[DELAY_LOOPS, i]
    now, found = loops * setup.dt, 0.0
    newest = np.floor((loops - delay) / every + 1e-9)
    while state[LAST_LINE, i] < newest:
        line = state[LAST_LINE, i] + 1.0
        made = np.ceil(line * every - 1e-9)
        arrived = np.ceil((made + delay) / setup.loops) * setup.period
        before = state[FEEDBACK_RELEASE, i]
        when = released(state[KEY, i], FEEDBACK, line - 1.0, arrived, before, setup.faults)
        if when > now + EPSILON:
            break
        state[LAST_LINE, i] = line
        if not math.isnan(when):
            state[FEEDBACK_RELEASE, i] = when
            found = line
    return found


@jit
def send(state: Floats, i: int, tick: float, setup: Setup) -> tuple[float, float]:
    """What the wire lets through at the beginning of robot i's tick, after its command is written.

    Returns the number of the newest line, -1 where none is let through, and the loop in which the
    board has read all of them, one byte after the other.
    """
    now, newest, count = tick * setup.period, -1.0, 0.0
    while state[LAST_COMMAND, i] < tick:
        line = state[LAST_COMMAND, i] + 1.0
        written, before = line * setup.period, state[COMMAND_RELEASE, i]
        when = released(state[KEY, i], COMMANDS, line, written, before, setup.faults)
        if when > now + EPSILON:
            break
        state[LAST_COMMAND, i] = line
        if not math.isnan(when):
            state[COMMAND_RELEASE, i] = when
            newest, count = line, count + 1.0
    if count == 0.0:
        return newest, np.inf
    faults = setup.faults
    state[BOARD_FREE, i] = max(state[BOARD_FREE, i], now) + count * faults.line_time
    read = (state[BOARD_FREE, i] + faults.processing_time) / setup.dt
    return newest, math.ceil(read - 1e-6) + state[COMMAND_LOOPS, i] - setup.wire_loops


@jit
def dispatch(tables: Tables, first: int, last: int, slot: int, setup: Setup) -> None:
    """What reaches the boards of this tick's commands, which are in their slot of the ring."""
    state, commands, arrivals = tables.state, tables.commands, tables.arrivals
    slots = commands.shape[0]
    for i in range(first, last):
        tick = state[LOOPS, i] / setup.loops
        newest, loop_of = send(state, i, tick, setup)
        arrivals[slot, 0, i] = loop_of
        if newest >= 0.0:
            place = (slot - int(tick - newest) + slots) % slots
            arrivals[slot, 1, i] = commands[place, 0, i]
            arrivals[slot, 2, i] = commands[place, 1, i]


@jit
def obey(tables: Tables, first: int, last: int, slot: int, turn: int, setup: Setup) -> None:
    """Boards hear what has arrived by this loop of a tick, and set points move towards it.

    A board that hears nothing for too long stops its motors.
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
        if (now - state[HEARD_LOOP, i]) * setup.dt > setup.faults.command_timeout + EPSILON:
            state[NEW_RIGHT, i] = state[NEW_LEFT, i] = 0.0
    rights, lefts = row(state, NEW_RIGHT, first, last), row(state, NEW_LEFT, first, last)
    approach(state, rights, lefts, first, last, setup.ramp)


@jit
def draw_key(tables: Tables, i: int, setup: Setup) -> None:
    """The key of robot i's episode, negative where nothing goes wrong in it."""
    key = uniform(tables.random, i)
    ill = lot(key, EPISODE, 0.0, 0) < setup.faults.episodes
    tables.state[KEY, i] = key if ill else -1.0


@jit
def settle_late(state: Floats, i: int, setup: Setup) -> None:
    """Robot i's reset, which takes until two fresh readings have come, as `Robot.reset` has it.

    Where that one raises, because the board is silent for too long, the robot is noted as silent.
    """
    ticks, fresh, age = 0.0, 0, 0.0
    state[LAST_COMMAND, i] = -1.0
    while fresh < 2:
        send(state, i, ticks, setup)
        ticks += 1.0
        state[LOOPS, i] = ticks * setup.loops
        found = listen(state, i, setup) > 0.0
        age = 0.0 if found else age + setup.period
        fresh += found
        if silent(age, setup.rules) or (fresh < 2 and ticks >= setup.faults.patience):
            state[SILENT, i] = 1.0
            break
    state[HEARD_TICK, i] = ticks - 1.0
    state[HEARD_LOOP, i] = -1e18


@jit
def prepare(tables: Tables, first: int, last: int, setup: Setup) -> None:
    """Note what robots are told now, for those whose board falls silent in the step to come."""
    for i in range(first, last):
        tables.idle[i] = tables.over[i]
    if setup.falls_silent:
        tables.kept[:, first:last] = tables.state[:COMMAND_LOOPS, first:last]
        for i in range(first, last):
            tables.idle[i] |= tables.state[SILENT, i] > 0.0
            tables.kept_rays[i] = rays(tables, i, setup)


@jit
def rays(tables: Tables, i: int, setup: Setup) -> NDArray[np.float32]:
    """The ranges in robot i's observation."""
    return tables.observations[i, setup.numbers : setup.numbers + tables.ranges.shape[1]]


@jit
def watch(tables: Tables, first: int, last: int, setup: Setup) -> None:
    """Robots whose board has been silent for too long drive no more; see `rules.silent`."""
    for i in range(first, last):
        if silent(tables.state[AGE, i], setup.rules):
            tables.idle[i] = True


@jit
def put_back(tables: Tables, first: int, last: int, setup: Setup) -> None:
    """Robots that fell silent are told what they were told last, and that it is a fault."""
    state = tables.state
    for i in range(first, last):
        if tables.idle[i] and not tables.over[i]:
            for number in range(COMMAND_LOOPS):
                state[number, i] = tables.kept[number, i]
            state[SCAN_TICK, i] += setup.ticks  # the scan's age, too
            state[FAULT, i] = SILENCE
            rays(tables, i, setup)[:] = tables.kept_rays[i]
