"""The loops that call a task's compiled methods for every robot.

`bind_task` makes copies of the loops in which the names `task_*` are the methods of one task. numba
caches a compiled copy beside the task's own file, under the name of the task's class.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from types import FunctionType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError
from acsar_gym.jit import COMPILED, WITHIN, jit
from acsar_gym.jit import loop as compiled
from acsar_gym.tasks.base import TASK_METHODS, Outcome, State, Task
from acsar_gym.tasks.factory import task_name
from acsar_gym.vector.kernel.episode import update_info
from acsar_gym.vector.kernel.layout import (
    AGE,
    ANGULAR,
    CONTACT,
    GOAL_GIVEN,
    GOAL_X,
    GOAL_Y,
    LAST_ANGULAR,
    LAST_LINEAR,
    LINEAR,
    ODOM_THETA,
    ODOM_X,
    ODOM_Y,
    OUTCOME,
    READ,
    REASON,
    RETURN,
    SENT_ANGULAR,
    SENT_LINEAR,
    STEPS,
    WORLD,
    Spawns,
    TaskSetup,
    TaskTables,
)
from acsar_gym.worlds.registry import hash_modules as sources_of

STATE_ROWS = [
    ODOM_X,
    ODOM_Y,
    ODOM_THETA,
    LINEAR,
    ANGULAR,
    *range(READ, READ + 4),
    LAST_LINEAR,
    LAST_ANGULAR,
    SENT_LINEAR,
    SENT_ANGULAR,
    REASON,
    STEPS,
    AGE,
    CONTACT,
    GOAL_X,
    GOAL_Y,
    WORLD,
    GOAL_GIVEN,
]
"""The rows that a State is made of, for tasks in Python."""

# Placeholders: in the copies that `bind_task` makes, these names are the task's compiled methods.
OUTCOMES = len(Outcome)

task_begin: Any = Task.begin
task_outcome: Any = Task.outcome
task_reward: Any = Task.reward
task_observe: Any = Task.observe


@jit
def make_state(tables: TaskTables, i: int, setup: TaskSetup, spawns: Spawns) -> State:
    """Make robot i's State."""
    s, world = tables.state, int(tables.state[WORLD, i])
    path = spawns.paths[0 if len(spawns.samples) == 0 else world]
    samples = 0 if len(spawns.samples) == 0 else spawns.samples[world]
    known = len(spawns.lengths) > 0 and s[GOAL_GIVEN, i] == 0.0
    return State(
        (s[ODOM_X, i], s[ODOM_Y, i], s[ODOM_THETA, i]),
        (s[LINEAR, i], s[ANGULAR, i]),
        (s[READ, i], s[READ + 1, i], s[READ + 2, i], s[READ + 3, i]),
        (s[LAST_LINEAR, i], s[LAST_ANGULAR, i]),
        (s[SENT_LINEAR, i], s[SENT_ANGULAR, i]),
        int(s[REASON, i]),
        tables.ranges[i],
        tables.edges,
        tables.observations[i, setup.numbers :],
        s[STEPS, i] * setup.ticks * setup.period,
        s[AGE, i],
        s[CONTACT, i] > 0.0,
        (s[GOAL_X, i], s[GOAL_Y, i]),
        path[:samples],
        spawns.lengths[world] if known else np.nan,
        (setup.max_linear, setup.max_angular),
        setup.ticks * setup.period,
    )


@jit
def store_end(tables: TaskTables, i: int, reward: float, outcome: int, setup: TaskSetup) -> None:
    """Store the reward and the outcome of robot i's step, and whether its episode has ended."""
    state = tables.state
    state[OUTCOME, i] = outcome
    state[RETURN, i] += reward
    tables.rewards[i] = reward
    tables.ends[0, i] = outcome != 0
    tables.ends[1, i] = state[STEPS, i] >= setup.max_steps


@jit
def truncate_silent(tables: TaskTables, i: int) -> None:
    """Truncate robot i's episode because its board is silent; the observation stays as it was."""
    tables.rewards[i] = 0.0
    tables.ends[0, i], tables.ends[1, i] = False, True


def start(
    task: Any,
    memory: NDArray[Any],
    tables: TaskTables,
    mask: NDArray[np.bool_],
    first: int,
    last: int,
    setup: TaskSetup,
    spawns: Spawns,
) -> None:
    """Begin the task's episodes of robots in the mask and write their first observations.

    `memory` has a row for each robot, and a last one with the first values.
    """
    for i in range(first, last):
        if mask[i]:
            memory[i] = memory[len(memory) - 1]
            state = make_state(tables, i, setup, spawns)
            task_begin(task, state, memory[i])
            store_numbers(tables.observations, i, 0, task_observe(task, state, memory[i]))
    update_info(tables.state, first, last, setup)


def step(
    task: Any,
    memory: NDArray[Any],
    tables: TaskTables,
    first: int,
    last: int,
    setup: TaskSetup,
    spawns: Spawns,
) -> None:
    """Write reward, end and observation of robots first to last; robots in `over` begin anew."""
    for i in range(first, last):
        if tables.idle[i] and not tables.over[i]:
            truncate_silent(tables, i)
            continue
        if tables.over[i]:
            memory[i] = memory[len(memory) - 1]
        state, own = make_state(tables, i, setup, spawns), memory[i]
        if tables.over[i]:
            task_begin(task, state, own)
            tables.rewards[i] = 0.0
            tables.ends[0, i] = tables.ends[1, i] = False
        else:
            outcome = 0 + task_outcome(task, state, own)  # an Outcome, or its number
            if not 0 <= outcome < OUTCOMES:
                raise ValueError("outcome returned what is no Outcome")
            store_end(tables, i, task_reward(task, state, own, outcome), outcome, setup)
        store_numbers(tables.observations, i, 0, task_observe(task, state, own))
    update_info(tables.state, first, last, setup)


def store_numbers(rows: NDArray[np.float32], i: int, k: int, numbers: Any) -> None:
    """Write numbers into row i, from column k on."""
    for number, value in enumerate(numbers):
        rows[i, k + number] = value


if COMPILED:
    import numba
    from numba.extending import overload

    HEAD = "def unrolled(rows: Any, i: Any, k: Any, numbers: Any):"
    """The signature must equal that of `_store`: numba compares them."""

    @overload(store_numbers)  # type: ignore[untyped-decorator]
    def _store(rows: Any, i: Any, k: Any, numbers: Any) -> Callable[..., None]:
        """Compile `store` as one assignment for each number, because their types may differ."""
        lines = [f"    rows[i, k + {n}] = numbers[{n}]" for n in range(len(numbers))] or [
            "    pass"
        ]
        made: dict[str, Any] = {"__name__": __name__}
        exec("\n".join([HEAD, *lines, "    return"]), made)  # noqa: S102 - our own
        unrolled: Callable[..., None] = made["unrolled"]
        return unrolled


def bind_task(loop: Callable[..., None], task: Task) -> Callable[..., None]:
    """Make a copy of `start` or `step` that calls the methods of one task, compiled.

    Compilation happens at the first call; `explain_error` makes a message of numba's errors.

    Args:
        loop: `start` or `step` of this module.
        task: whose class has the methods.
    """
    kind, name = type(task), _cached_as(type(task), loop)
    options = WITHIN | {"error_model": "python", "boundscheck": True, "forceinline": True}
    names = {f"task_{one}": numba.njit(**options)(getattr(kind, one)) for one in TASK_METHODS}
    template: Any = loop
    file = getattr(sys.modules[kind.__module__], "__file__", None) or __file__
    code = template.__code__.replace(co_filename=file, co_firstlineno=1)
    copy = FunctionType(code, template.__globals__ | names, loop.__name__)
    copy.__module__, copy.__qualname__ = kind.__module__, name or kind.__qualname__
    return compiled(copy, keep=bool(name))


def _cached_as(kind: type[Task], loop: Callable[..., None]) -> str:
    """Make the name under which numba keeps a compiled loop: it holds a hash of all its sources.

    numba itself would only notice a change of the file that has the class. Empty, for not to be
    kept, where a source isn't known, as in a notebook, and for classes made in functions.
    """
    modules = {one.__module__ for one in kind.__mro__}
    own = [name for name in modules if name.partition(".")[0] not in ("builtins", "acsar_gym")]
    sources = sources_of(*sorted(own)) if own else "acsar_gym"  # whose sources `jit` minds
    if not sources or "<locals>" in kind.__qualname__:
        return ""
    said = hashlib.sha256(sources.encode())
    for name in TASK_METHODS:
        said.update(_content(getattr(kind, name)))
    return f"{kind.__qualname__}.{loop.__name__}.{said.hexdigest()[:16]}"


def _content(method: FunctionType) -> bytes:
    """What numba compiles of a method: its code, and the values of the names that it uses."""
    code, known = method.__code__, method.__globals__
    values = [known.get(name) for name in code.co_names]
    used = [value for value in values if isinstance(value, bool | int | float | str | tuple)]
    return f"{code.co_code!r} {code.co_consts!r} {used!r}".encode()


def explain_error(task: Task, error: Exception) -> ConfigError:
    """Make a ConfigError of one line from numba's error about a task that it can't compile."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    said = "; ".join(lines[:3])[:300]
    return ConfigError(
        f"{task_name(task)}: numba can't compile it: {said} - mend it, or set compiled = False"
    )
