"""Lines between drivers and boards that are lost or late, the same as in `links.fault_injection`.

A hash of the episode's key and the line's number decides which lines. Lines keep their order: none
overtakes a late one. Lines are numbered from the reset on, including the ticks in which a reset
waits for the wheels to stand; commands from 0, feedback from 1.
"""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.dynamics.timing import whole_loops
from acsar_gym.jit import jit
from acsar_gym.links.faults import DROPPED, EPSILON, LATE
from acsar_gym.links.lots import COMMANDS, EPISODE, FEEDBACK, lot
from acsar_gym.safety.rules import silent
from acsar_gym.vector.kernel.layout import (
    AGE,
    BOARD_FREE,
    COMMAND_DELAY,
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
    LATENCY_LOOPS,
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

SILENCE = 1.0
"""The code of BoardSilentError in info's `fault`, see `envs.told.fault_code`."""


@jit
def released(
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
    suffers = faults.feedback if whose == FEEDBACK else faults.commands
    if key < 0.0 or not suffers:
        return arrived
    if faults.dropped > 0.0 and lot(key, whose, number, DROPPED) < faults.dropped:
        return np.nan
    late = faults.late > 0.0 and lot(key, whose, number, LATE) < faults.late
    return max(before, arrived + faults.lateness if late else arrived)


@jit
def listen(state: Floats, i: int, setup: Setup) -> float:
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
    """Write robot i's command of this tick, and pass on what the wire lets through by now.

    Returns:
        Number of the newest line that is passed on, -1 for none, and the firmware loop in which
        the board has read all of them, one byte after the other.
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
    read = state[BOARD_FREE, i] + faults.processing_time + state[COMMAND_DELAY, i]
    return newest, whole_loops(read, setup.dt) + state[LATENCY_LOOPS, i]


@jit
def dispatch(tables: Tables, first: int, last: int, slot: int, setup: Setup) -> None:
    """Store in the ring's slot which commands the wire passes on to the boards in this tick."""
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
        if (now - state[HEARD_LOOP, i]) * setup.dt > setup.faults.command_timeout + EPSILON:
            state[NEW_RIGHT, i] = state[NEW_LEFT, i] = 0.0
    rights, lefts = row(state, NEW_RIGHT, first, last), row(state, NEW_LEFT, first, last)
    approach(state, rights, lefts, first, last, setup.ramps)


@jit
def draw_key(tables: Tables, i: int, setup: Setup) -> None:
    """Draw the key of robot i's episode; negative where the episode has no faults."""
    key = uniform(tables.random, i)
    ill = lot(key, EPISODE, 0.0, 0) < setup.faults.episodes
    tables.state[KEY, i] = key if ill else -1.0


@jit
def settle_late(state: Floats, i: int, setup: Setup) -> None:
    """Run robot i's reset with faults: it waits for two fresh readings, as `Robot.reset`.

    Where the single env would raise BoardSilentError, SILENT is set.
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
    """Mark robots that don't drive in this step, and keep the state before the step.

    `put_back` restores it for robots whose board falls silent during the step.
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
def watch(tables: Tables, first: int, last: int, setup: Setup) -> None:
    """Mark robots as idle whose feedback is too old; see `rules.silent`."""
    for i in range(first, last):
        if silent(tables.state[AGE, i], setup.rules):
            tables.idle[i] = True


@jit
def put_back(tables: Tables, first: int, last: int, setup: Setup) -> None:
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
