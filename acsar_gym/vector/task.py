"""Run a task over a batch: by compiled loops, or in Python for one robot after the other."""

from __future__ import annotations

from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError, translate_errors
from acsar_gym.jit import record_of
from acsar_gym.tasks.factory import ask_outcome, ask_reward, task_name
from acsar_gym.tasks.state import STATE_NUMBERS, State, write_maker
from acsar_gym.tasks.task import (
    TASK_METHODS,
    Memory,
    Outcome,
    Task,
    info_names,
    is_compiled,
    new_memory,
)
from acsar_gym.vector.kernel import task as kernel
from acsar_gym.vector.kernel.binding import explain_error, is_compile_error, numbers_of
from acsar_gym.vector.kernel.episode import update_info
from acsar_gym.vector.kernel.layout import (
    BLOCK_ROBOTS,
    ROWS,
    Setup,
    Spawns,
    Tables,
    read_fields,
)

OTHER_NUMBERS = ("steps", "world", "goal_given", "kind", "rays")
"""Numbers of a robot that decide on the other fields of a State."""
_columns = count()
_COLUMNS = {name: [next(_columns) for _ in ROWS[name]] for name in STATE_NUMBERS}
make_state = write_maker(lambda name: ", ".join(f"numbers[{k}]" for k in _COLUMNS[name]))


def make_loops(
    task: Task, tables: Tables, setup: Setup, spawns: Spawns
) -> CompiledLoops | PythonLoops:
    """Make compiled loops where the task is compiled, otherwise Python loops."""
    kind = CompiledLoops if is_compiled(task) else PythonLoops
    return kind(task, tables, setup, spawns)


class CompiledLoops:
    """A loop that numba compiles together with the methods of the task's class.

    It releases the GIL, so that threads can run it for slices of robots.
    """

    compiled = True

    def __init__(self, task: Task, tables: Tables, setup: Setup, spawns: Spawns) -> None:
        self._task, self._tables, self._others = task, tables, (record_of(setup), spawns)
        self._numbers = numbers_of(task)
        kinds = [(name, np.float64) for name in task.memory] or [("nothing", np.float64)]
        self._memory: NDArray[Any] = np.zeros(len(tables.rewards) + 1, kinds)
        for name, value in task.memory.items():
            self._memory[name][-1] = value
        self._loop = kernel.bind_task(task)

    def run(self, first: int, last: int) -> None:
        """Write rewards, ends and observations of blocks first to last, after their physics.

        Robots in `over` begin anew. ConfigError where numba can't compile the task.
        """
        try:
            self._loop(self._numbers, self._memory, self._tables, first, last, *self._others)
        except KeyError as error:  # of numba, for a field that the record doesn't have
            name = error.args[0]
            raise ConfigError(
                f"{task_name(self._task)}: memory.{name} isn't declared: give it a first value in "
                f'the class, such as memory = {{"{name}": 0.0}}'
            ) from error
        except Exception as error:
            if is_compile_error(error):
                name, kind = task_name(self._task), type(self._task)
                raise explain_error(name, kind, TASK_METHODS, error) from error
            raise ConfigError(
                f"{task_name(self._task)}: {type(error).__name__}: {error}, in a compiled method; "
                "with compiled = False, the line is told"
            ) from error

    def info(self) -> dict[str, NDArray[np.float64]]:
        """The task's part of info, an array for each key: what it remembers."""
        return {name: self._memory[name][:-1].copy() for name in info_names(self._task)}


class PythonLoops:
    """Loops that call the task's methods in Python, for one robot after the other."""

    compiled = False

    def __init__(self, task: Task, tables: Tables, setup: Setup, spawns: Spawns) -> None:
        self._task, self._tables, self._setup, self._spawns = task, tables, setup, spawns
        self._setups = record_of(setup)
        self._paths = spawns.paths.view()
        self._paths.setflags(write=False)  # all robots share them
        self._memory: list[Memory] = [new_memory(task) for _ in tables.rewards]

    def run(self, first: int, last: int) -> None:
        """Write rewards, ends and observations of blocks first to last, as `CompiledLoops.run`."""
        task, tables, setup = self._task, self._tables, self._setup
        here = slice(first * BLOCK_ROBOTS, last * BLOCK_ROBOTS)
        tables.rewards[here], tables.ends[0, here] = 0.0, False
        tables.ends[1, here] = tables.idle[here] & ~tables.over[here]
        driven = np.flatnonzero(tables.over[here] | ~tables.idle[here]) + here.start
        observed = []
        with translate_errors(ConfigError, lambda: task_name(task)):
            for robot, state in zip(driven.tolist(), self._states(driven), strict=True):
                if tables.over[robot]:
                    self._memory[robot] = memory = new_memory(task)
                    task.begin(state, memory)
                else:
                    memory = self._memory[robot]
                    outcome = ask_outcome(task, state, memory)
                    reward = ask_reward(task, state, memory, outcome)
                    tables.rewards[robot] = reward
                    robots, i = tables.blocks[robot // BLOCK_ROBOTS], robot % BLOCK_ROBOTS
                    robots["total_reward"][i] += reward
                    robots["outcome"][i] = outcome
                    tables.ends[0, robot] = outcome != Outcome.GOING
                    tables.ends[1, robot] = robots["steps"][i] >= setup.max_steps
                observed.append(task.observe(state, memory))
        if observed and setup.numbers:
            try:
                tables.observations[driven, : setup.numbers] = observed
            except (TypeError, ValueError) as error:
                raise ConfigError(f"{task_name(task)}.observe: {error}") from error
        update_info(tables.blocks, first, last, self._setups)

    def _states(self, robots: NDArray[np.int64]) -> list[State]:
        """The State of each of these robots."""
        tables, setup, spawns = self._tables, self._setup, self._spawns
        numbers = read_fields(tables.numbers, (*STATE_NUMBERS, *OTHER_NUMBERS), robots)
        ranges, sensed = tables.ranges[robots], tables.observations[robots, setup.numbers :]
        period = setup.ticks * setup.period
        states = []
        for place, row in enumerate(numbers.T.tolist()):
            steps, world, given, kind, rays = row[-len(OTHER_NUMBERS) :]
            path, length = self._paths[0, :0], np.nan
            if len(spawns.samples):
                path = self._paths[int(world), : spawns.samples[int(world)]]
            if len(spawns.lengths) and not given:
                length = float(spawns.lengths[int(world)])
            states.append(
                make_state(
                    row,
                    0,
                    ranges[place, : int(rays)],
                    tables.edges[int(kind), : int(rays)],
                    sensed[place],
                    steps * setup.ticks * setup.period,
                    path,
                    length,
                    period,
                )
            )
        return states

    def info(self) -> dict[str, NDArray[np.float64]]:
        """The task's part of info: what it remembers."""
        memories = [vars(memory) for memory in self._memory]
        return {
            name: np.array([memory[name] for memory in memories], np.float64)
            for name in info_names(self._task)
        }
