"""The loop that calls a task's compiled methods for every robot.

`bind_task` makes copies of it in which the names `task_*` are the methods of one task. numba caches
a compiled copy beside the task's own file, under the name of the task's class.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from acsar_gym.jit import jit
from acsar_gym.tasks.state import State, write_maker
from acsar_gym.tasks.task import TASK_METHODS, Outcome, Task
from acsar_gym.vector.kernel.binding import bind_methods
from acsar_gym.vector.kernel.episode import update_info
from acsar_gym.vector.kernel.layout import BLOCK_ROBOTS, ROWS, Records, Setup, Spawns, Tables

OUTCOMES = len(Outcome)

# Placeholders: in the copies that `bind_task` makes, these names are the task's compiled methods.
task_begin: Any = Task.begin
task_outcome: Any = Task.outcome
task_reward: Any = Task.reward
task_observe: Any = Task.observe


def read_field(name: str) -> str:
    """The expression that reads a field of robot i; of wheels, four numbers."""
    if len(ROWS[name]) == 1:
        return f"numbers.{name}[i]"
    return ", ".join(f"numbers.{name}[{wheel}, i]" for wheel in range(4))


make_state = jit(write_maker(read_field))


@jit
def state_of(tables: Tables, robot: int, setup: Setup, spawns: Spawns) -> State:
    """Make a robot's State."""
    robots, i = tables.blocks[robot // BLOCK_ROBOTS], robot % BLOCK_ROBOTS
    world, kind, rays = int(robots.world[i]), int(robots.kind[i]), int(robots.rays[i])
    path = spawns.paths[0 if len(spawns.samples) == 0 else world]
    samples = 0 if len(spawns.samples) == 0 else spawns.samples[world]
    leads = len(spawns.lengths) > 0 and robots.goal_given[i] == 0.0
    return make_state(
        robots,
        i,
        tables.ranges[robot, :rays],
        tables.edges[kind, :rays],
        tables.observations[robot, setup.numbers :],
        robots.steps[i] * setup.ticks * setup.period,
        path[:samples],
        spawns.lengths[world] if leads else np.nan,
        setup.ticks * setup.period,
    )


def run(
    task: Any,
    memory: NDArray[Any],
    tables: Tables,
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
        state, remembered = state_of(tables, robot, setup, spawns), memory[robot]
        if over:
            task_begin(task, state, remembered)
        else:
            outcome = 0 + task_outcome(task, state, remembered)  # an Outcome, or its number
            if not 0 <= outcome < OUTCOMES:
                raise ValueError("outcome returned what is no Outcome")
            reward = task_reward(task, state, remembered, outcome)
            robots.outcome[i] = outcome
            robots.total_reward[i] += reward
            tables.rewards[robot] = reward
            tables.ends[0, robot] = outcome != 0
            tables.ends[1, robot] = robots.steps[i] >= setup.max_steps
        store_numbers(tables.observations, robot, 0, task_observe(task, state, remembered))
    update_info(tables.blocks, first, last, setups)


def store_numbers(columns: NDArray[np.float32], i: int, k: int, numbers: Any) -> None:
    """Write numbers into row i, from column k on."""
    for number, value in enumerate(numbers):
        columns[i, k + number] = value


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
    """Make a copy of `run` that calls the methods of one task, compiled; see `bind_methods`."""
    return bind_methods(type(task), run, {f"task_{one}": one for one in TASK_METHODS})
