"""Run a task over a batch: by compiled loops, or in Python for one robot after the other."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError, TaskError, translate_errors
from acsar_gym.jit import COMPILED
from acsar_gym.tasks.factory import ask_outcome, ask_reward, task_name
from acsar_gym.tasks.task import (
    TASK_METHODS,
    Memory,
    Outcome,
    State,
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
    Records,
    Setup,
    Spawns,
    Tables,
    TaskTables,
    read_fields,
    view_numbers,
)

STATE_FIELDS = (
    *("odom_x", "odom_y", "odom_theta", "linear", "angular", "read_speed"),
    *("action_linear", "action_angular", "sent_linear", "sent_angular", "reason"),
    *("steps", "age", "contact", "goal_x", "goal_y", "world", "goal_given"),
    *("max_linear", "max_angular", "kind", "rays"),
)
"""The fields that a State is made of."""


class TaskLoops(Protocol):
    """The loops over robots that call a task."""

    compiled: bool
    """Whether `run` releases the GIL, so that threads can run it for slices of robots."""

    @property
    def memory(self) -> NDArray[Any] | None:
        """What the task remembers of all robots; None where Python objects hold it."""

    def run(self, first: int, last: int) -> None:
        """Write rewards, ends and observations of blocks first to last, after their physics.

        Robots in `over` begin anew.
        """

    def info(self) -> dict[str, NDArray[np.float64]]:
        """The task's part of info, an array for each key."""


def make_loops(
    task: Task, tables: Tables, setup: Setup, setups: Records, spawns: Spawns
) -> TaskLoops:
    """Choose compiled loops where task and installation allow it, otherwise Python loops."""
    own = TaskTables(*(getattr(tables, name) for name in TaskTables._fields))
    if COMPILED and is_compiled(task):
        return CompiledLoops(task, own, setups, spawns)
    return PythonLoops(task, own, setup, setups, spawns)


class CompiledLoops:
    """A loop that numba compiles together with the methods of the task's class."""

    compiled = True

    def __init__(self, task: Task, tables: TaskTables, setups: Records, spawns: Spawns) -> None:
        self._task, self._arguments = task, (tables, setups, spawns)
        self._numbers = numbers_of(task)
        kinds = [(name, np.float64) for name in task.memory] or [("nothing", np.float64)]
        self.memory: NDArray[Any] = np.zeros(len(tables.rewards) + 1, kinds)
        for name, value in task.memory.items():
            self.memory[name][-1] = value
        self._loop = kernel.bind_task(task)

    def run(self, first: int, last: int) -> None:
        """Write rewards, ends and observations of blocks first to last.

        ConfigError where numba can't compile the task.
        """
        tables, setups, spawns = self._arguments
        try:
            self._loop(self._numbers, self.memory, tables, first, last, setups, spawns)
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
            raise TaskError(
                f"{task_name(self._task)}: {type(error).__name__}: {error}, in a compiled method; "
                "with compiled = False, the line is told"
            ) from error

    def info(self) -> dict[str, NDArray[np.float64]]:
        """The task's part of info: what it remembers."""
        return {name: self.memory[name][:-1].copy() for name in info_names(self._task)}


class PythonLoops:
    """Loops that call the task's methods in Python, for one robot after the other."""

    compiled = False
    memory: NDArray[Any] | None = None

    def __init__(
        self, task: Task, tables: TaskTables, setup: Setup, setups: Records, spawns: Spawns
    ) -> None:
        self._task, self._tables, self._setup, self._spawns = task, tables, setup, spawns
        self._setups = setups
        self._paths = spawns.paths.view()
        self._paths.setflags(write=False)  # all robots share them
        self._memory: list[Memory] = [new_memory(task) for _ in tables.rewards]

    def run(self, first: int, last: int) -> None:
        """Write rewards, ends and observations of blocks first to last."""
        task, tables, setup = self._task, self._tables, self._setup
        here = slice(first * BLOCK_ROBOTS, last * BLOCK_ROBOTS)
        tables.rewards[here], tables.ends[0, here] = 0.0, False
        tables.ends[1, here] = tables.idle[here] & ~tables.over[here]
        driven = np.flatnonzero(tables.over[here] | ~tables.idle[here]) + here.start
        observed = []
        with translate_errors(TaskError, lambda: task_name(task)):
            for robot, seen in zip(driven.tolist(), self._states(driven), strict=True):
                if tables.over[robot]:
                    self._memory[robot] = memory = new_memory(task)
                    task.begin(seen, memory)
                else:
                    memory = self._memory[robot]
                    outcome = ask_outcome(task, seen, memory)
                    reward = ask_reward(task, seen, memory, outcome)
                    tables.rewards[robot] = reward
                    robots, i = tables.blocks[robot // BLOCK_ROBOTS], robot % BLOCK_ROBOTS
                    robots["total_reward"][i] += reward
                    robots["outcome"][i] = outcome
                    tables.ends[0, robot] = outcome != Outcome.GOING
                    tables.ends[1, robot] = robots["steps"][i] >= setup.max_steps
                observed.append(task.observe(seen, memory))
        if observed and setup.numbers:
            try:
                tables.observations[driven, : setup.numbers] = observed
            except (TypeError, ValueError) as error:
                raise TaskError(f"{task_name(task)}.observe: {error}") from error
        update_info(tables.blocks, first, last, self._setups)

    def _states(self, robots: NDArray[np.int64]) -> list[State]:
        """The State of each of these robots."""
        tables, setup = self._tables, self._setup
        numbers = read_fields(view_numbers(tables.blocks), STATE_FIELDS, robots).T.tolist()
        ranges, sensed = tables.ranges[robots], tables.observations[robots, setup.numbers :]
        period = setup.ticks * setup.period
        return [
            State(
                (x, y, theta),
                (linear, angular),
                (a, b, c, d),
                (ahead, turn),
                (sent_linear, sent_angular),
                int(reason),
                ranges[place, : int(rays)],
                tables.edges[int(kind), : int(rays)],
                sensed[place],
                steps * setup.ticks * setup.period,
                age,
                contact > 0.0,
                (goal_x, goal_y),
                *self._way(int(world), given > 0.0),
                (max_linear, max_angular),
                period,
            )
            for place, (
                x, y, theta, linear, angular, a, b, c, d, ahead, turn, sent_linear, sent_angular,
                reason, steps, age, contact, goal_x, goal_y, world, given, max_linear, max_angular,
                kind, rays,
            ) in enumerate(numbers)
        ]  # fmt: skip

    def _way(self, world: int, given: bool) -> tuple[NDArray[np.float64], float]:
        """Samples of a world's path and its length [m]; NaN where it doesn't lead to the goal."""
        spawns = self._spawns
        known = len(spawns.lengths) > 0 and not given
        length = float(spawns.lengths[world]) if known else float("nan")
        if len(spawns.samples) == 0:
            return self._paths[0, :0], length
        return self._paths[world, : spawns.samples[world]], length

    def info(self) -> dict[str, NDArray[np.float64]]:
        """The task's part of info: what it remembers."""
        memories = [vars(memory) for memory in self._memory]
        return {
            name: np.array([memory[name] for memory in memories], np.float64)
            for name in info_names(self._task)
        }
