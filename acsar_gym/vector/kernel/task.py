"""The loop that calls a task's compiled methods for every robot.

`bind_task` makes copies of it in which the names `task_*` are the methods of one task. numba caches
a compiled copy beside the task's own file, under the name of the task's class.
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
from acsar_gym.vector.kernel.layout import BLOCK_ROBOTS, Records, Setup, Spawns, TaskTables
from acsar_gym.worlds.registry import hash_modules

OUTCOMES = len(Outcome)

# Placeholders: in the copies that `bind_task` makes, these names are the task's compiled methods.
task_begin: Any = Task.begin
task_outcome: Any = Task.outcome
task_reward: Any = Task.reward
task_observe: Any = Task.observe


@jit
def make_state(tables: TaskTables, robot: int, setup: Setup, spawns: Spawns) -> State:
    """Make a robot's State."""
    robots, i = tables.blocks[robot // BLOCK_ROBOTS], robot % BLOCK_ROBOTS
    read, world = robots.read_speed, int(robots.world[i])
    path = spawns.paths[0 if len(spawns.samples) == 0 else world]
    samples = 0 if len(spawns.samples) == 0 else spawns.samples[world]
    known = len(spawns.lengths) > 0 and robots.goal_given[i] == 0.0
    return State(
        (robots.odom_x[i], robots.odom_y[i], robots.odom_theta[i]),
        (robots.linear[i], robots.angular[i]),
        (read[0, i], read[1, i], read[2, i], read[3, i]),
        (robots.action_linear[i], robots.action_angular[i]),
        (robots.sent_linear[i], robots.sent_angular[i]),
        int(robots.reason[i]),
        tables.ranges[robot],
        tables.edges,
        tables.observations[robot, setup.numbers :],
        robots.steps[i] * setup.ticks * setup.period,
        robots.age[i],
        robots.contact[i] > 0.0,
        (robots.goal_x[i], robots.goal_y[i]),
        path[:samples],
        spawns.lengths[world] if known else np.nan,
        (setup.max_linear, setup.max_angular),
        setup.ticks * setup.period,
    )


def run(
    task: Any,
    memory: NDArray[Any],
    tables: TaskTables,
    first: int,
    last: int,
    setups: Records,
    spawns: Spawns,
) -> None:
    """Write reward, end and observation of the robots of blocks first to last.

    Robots in `over` begin anew; the episodes of others that are idle are truncated, and their
    observations stay as they were. `memory` has a row for each robot, and a last one with the first
    values.
    """
    setup = setups[0]
    for robot in range(first * BLOCK_ROBOTS, min(last * BLOCK_ROBOTS, len(tables.over))):
        robots, i = tables.blocks[robot // BLOCK_ROBOTS], robot % BLOCK_ROBOTS
        over = tables.over[robot]
        if over or tables.idle[robot]:
            tables.rewards[robot] = 0.0
            tables.ends[0, robot], tables.ends[1, robot] = False, not over
        if over:
            memory[robot] = memory[len(memory) - 1]
        elif tables.idle[robot]:
            continue
        state, own = make_state(tables, robot, setup, spawns), memory[robot]
        if over:
            task_begin(task, state, own)
        else:
            outcome = 0 + task_outcome(task, state, own)  # an Outcome, or its number
            if not 0 <= outcome < OUTCOMES:
                raise ValueError("outcome returned what is no Outcome")
            reward = task_reward(task, state, own, outcome)
            robots.outcome[i] = outcome
            robots.total_reward[i] += reward
            tables.rewards[robot] = reward
            tables.ends[0, robot] = outcome != 0
            tables.ends[1, robot] = robots.steps[i] >= setup.max_steps
        store_numbers(tables.observations, robot, 0, task_observe(task, state, own))
    update_info(tables.blocks, first, last, setups)


def store_numbers(columns: NDArray[np.float32], i: int, k: int, numbers: Any) -> None:
    """Write numbers into row i, from column k on."""
    for number, value in enumerate(numbers):
        columns[i, k + number] = value


if COMPILED:
    import numba
    from numba.extending import overload

    HEAD = "def unrolled(columns: Any, i: Any, k: Any, numbers: Any):"
    """The signature must equal that of `_store`: numba compares them."""

    @overload(store_numbers)  # type: ignore[untyped-decorator]
    def _store(columns: Any, i: Any, k: Any, numbers: Any) -> Callable[..., None]:
        """Compile it as one assignment for each number, because their types may differ."""
        lines = [f"    columns[i, k + {n}] = numbers[{n}]" for n in range(len(numbers))]
        made: dict[str, Any] = {"__name__": __name__}
        exec("\n".join([HEAD, *lines, "    return"]), made)  # noqa: S102 - our own
        unrolled: Callable[..., None] = made["unrolled"]
        return unrolled


def bind_task(task: Task) -> Callable[..., None]:
    """Make a copy of `run` that calls the methods of one task, compiled.

    Compilation happens at the first call; `explain_error` makes a message of numba's errors.

    Args:
        task: whose class has the methods.
    """
    kind, template = type(task), run
    options = WITHIN | {"error_model": "python", "boundscheck": True, "forceinline": True}
    names = {f"task_{one}": numba.njit(**options)(getattr(kind, one)) for one in TASK_METHODS}
    file = getattr(sys.modules[kind.__module__], "__file__", None) or __file__
    code = template.__code__.replace(co_filename=file, co_firstlineno=1)
    copy = FunctionType(code, template.__globals__ | names, "run")
    name = _cached_as(kind)
    copy.__module__, copy.__qualname__ = kind.__module__, name or kind.__qualname__
    return compiled(copy, keep=bool(name))


def _cached_as(kind: type[Task]) -> str:
    """Make the name under which numba keeps a compiled loop: it holds a hash of all its sources.

    numba itself would only notice a change of the file that has the class. Empty, for not to be
    kept, where a source isn't known, as in a notebook, and for classes made in functions.
    """
    modules = {one.__module__ for one in kind.__mro__}
    own = [name for name in modules if name.partition(".")[0] not in ("builtins", "acsar_gym")]
    sources = hash_modules(*sorted(own)) if own else "acsar_gym"  # whose sources `jit` minds
    if not sources or "<locals>" in kind.__qualname__:
        return ""
    said = hashlib.sha256(sources.encode())
    for name in TASK_METHODS:  # what numba compiles: code, and values of the names that it uses
        code, known = getattr(kind, name).__code__, getattr(kind, name).__globals__
        values = [known.get(one) for one in code.co_names]
        used = [value for value in values if isinstance(value, bool | int | float | str | tuple)]
        said.update(f"{code.co_code!r} {code.co_consts!r} {used!r}".encode())
    return f"{kind.__qualname__}.{said.hexdigest()[:16]}"


def explain_error(task: Task, error: Exception) -> ConfigError:
    """Make a ConfigError of one line from numba's error about a task that it can't compile."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    said = "; ".join(lines[:3])[:300]
    return ConfigError(
        f"{task_name(task)}: numba can't compile it: {said} - mend it, or set compiled = False"
    )
