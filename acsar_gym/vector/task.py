"""Run a task over a batch: by compiled loops, or in Python for one robot after the other."""

from __future__ import annotations

import threading
from collections import namedtuple
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError, TaskError, translate_errors
from acsar_gym.jit import COMPILED, NumbaError
from acsar_gym.tasks.base import Memory, Outcome, State, Task, info_names, is_compiled, new_memory
from acsar_gym.tasks.episode import ask_outcome, ask_reward
from acsar_gym.tasks.factory import task_name
from acsar_gym.vector.kernel import layout
from acsar_gym.vector.kernel import task as kernel
from acsar_gym.vector.kernel.episode import update_info
from acsar_gym.vector.kernel.layout import Setup, Spawns, Tables, TaskSetup, TaskTables

Mask = NDArray[np.bool_]
Info = dict[str, NDArray[np.float64]]
_NAMING = threading.Lock()
"""Two threads may make the first batches of a class at once."""


class Loops(Protocol):
    """The loops over robots that call a task."""

    compiled: bool
    """Whether `start` and `step` release the GIL, so that threads can run them for slices of
    robots."""

    @property
    def memory(self) -> NDArray[Any] | None:
        """What the task remembers of all robots; None where Python objects hold it."""

    def start(self, mask: Mask, first: int, last: int) -> None:
        """Begin the episodes of robots in the mask and write their first observations."""

    def step(self, first: int, last: int) -> None:
        """Write rewards, ends and observations of robots first to last, after their physics."""

    def info(self) -> Info:
        """The task's part of info, an array for each key."""


def make_loops(task: Task, tables: Tables, setup: Setup, spawns: Spawns) -> Loops:
    """Choose compiled loops where task and installation allow it, otherwise Python loops."""
    kind = CompiledLoops if COMPILED and is_compiled(task) else PythonLoops
    own = TaskTables(*(getattr(tables, name) for name in TaskTables._fields))
    numbers = TaskSetup(*(getattr(setup, name) for name in TaskSetup._fields))
    return kind(task, own, numbers, spawns)


class CompiledLoops:
    """Loops that numba compiles together with the methods of the task's class."""

    compiled = True

    def __init__(self, task: Task, tables: TaskTables, setup: TaskSetup, spawns: Spawns) -> None:
        self._task, self._tables, self._setup, self._spawns = task, tables, setup, spawns
        self._numbers = task_numbers(task)
        kinds = [(name, np.float64) for name in task.memory] or [("nothing", np.float64)]
        self.memory: NDArray[Any] = np.zeros(len(tables.rewards) + 1, kinds)
        for name, value in task.memory.items():
            self.memory[name][-1] = value
        self._start = kernel.bind_task(kernel.start, task)
        self._step = kernel.bind_task(kernel.step, task)

    def start(self, mask: Mask, first: int, last: int) -> None:
        """Begin the episodes of robots in the mask.

        ConfigError where numba can't compile the task.
        """
        self._call(self._start, mask, first, last)

    def step(self, first: int, last: int) -> None:
        """Write rewards, ends and observations of robots first to last."""
        self._call(self._step, first, last)

    def _call(self, loop: Callable[..., None], *share: Any) -> None:
        """Call a compiled loop; ConfigError where numba can't compile the task."""
        try:
            loop(self._numbers, self.memory, self._tables, *share, self._setup, self._spawns)
        except KeyError as error:  # of numba, for a field that the record doesn't have
            name = error.args[0]
            raise ConfigError(
                f"{task_name(self._task)}: memory.{name} isn't declared: give it a first "
                "value in the "
                f'class, such as memory = {{"{name}": 0.0}}'
            ) from None
        except (NumbaError, NotImplementedError, TypeError) as error:
            raise kernel.explain_error(self._task, error) from None
        except Exception as error:
            raise TaskError(
                f"{task_name(self._task)}: {type(error).__name__}: {error}, in a compiled method; "
                "with compiled = False, the line is told"
            ) from error

    def info(self) -> Info:
        """The task's part of info: what it remembers."""
        return {name: self.memory[name][:-1].copy() for name in info_names(self._task)}


def task_numbers(task: Task) -> Any:
    """Make the named tuple that compiled methods get as `self`: the task's numbers by name."""
    found = {}
    for name in dir(task):
        value = None if name.startswith("_") else getattr(task, name)
        if isinstance(value, bool | int | float | np.ndarray | np.generic) or _is_numbers(value):
            found[name] = value
    kind: Any = type(task)
    with _NAMING:
        return _params(kind, tuple(found))(**found)


def _params(kind: Any, names: tuple[str, ...]) -> Any:
    """Return a class's named tuple with these names; numba's cache finds it again in the class."""
    made: Any = vars(kind).get("TaskParams")
    if made is None or made._fields != names:
        make: Any = namedtuple  # its fields are found at run time
        made = make("TaskParams", names)
        made.__module__, made.__qualname__ = kind.__module__, f"{kind.__qualname__}.TaskParams"
        kind.TaskParams = made
    return made


def _is_numbers(value: Any) -> bool:
    """Whether a value is a non-empty tuple of numbers."""
    return (
        isinstance(value, tuple)
        and bool(value)
        and all(isinstance(n, bool | int | float) for n in value)
    )


class PythonLoops:
    """Loops that call the task's methods in Python, for one robot after the other."""

    compiled = False
    memory: NDArray[Any] | None = None

    def __init__(self, task: Task, tables: TaskTables, setup: TaskSetup, spawns: Spawns) -> None:
        self._task, self._tables, self._setup, self._spawns = task, tables, setup, spawns
        self._paths = spawns.paths.view()
        self._paths.setflags(write=False)  # all robots share them
        self._memory: list[Memory] = [new_memory(task) for _ in tables.rewards]
        self._numbers = len(task.observation)
        self._constants = (
            (setup.max_linear, setup.max_angular),
            setup.ticks * setup.period,
        )

    def start(self, mask: Mask, first: int, last: int) -> None:
        """Begin the episodes of robots in the mask and write their first observations."""
        robots = np.flatnonzero(mask[first:last]) + first
        rows = []
        with self._named():
            for robot, state in zip(robots.tolist(), self._states(robots), strict=True):
                self._memory[robot] = memory = new_memory(self._task)
                self._task.begin(state, memory)
                rows.append(self._task.observe(state, memory))
        self._observed(robots, rows)
        update_info(self._tables.state, first, last, self._setup)

    def step(self, first: int, last: int) -> None:
        """Write rewards, ends and observations of robots first to last."""
        tables, over = self._tables, self._tables.over
        tables.rewards[first:last], tables.ends[0, first:last] = 0.0, False
        tables.ends[1, first:last] = tables.idle[first:last] & ~over[first:last]
        self._judge(np.flatnonzero(~tables.idle[first:last]) + first)
        self.start(over, first, last)

    def _judge(self, robots: NDArray[np.int64]) -> None:
        """Call outcome, reward and observe for robots that have driven, and write the results."""
        task, memories = self._task, self._memory
        rewards, outcomes, rows = [], [], []
        with self._named():
            for robot, state in zip(robots.tolist(), self._states(robots), strict=True):
                memory = memories[robot]
                outcome = ask_outcome(task, state, memory)
                rewards.append(ask_reward(task, state, memory, outcome))
                outcomes.append(outcome)
                rows.append(task.observe(state, memory))
        self._observed(robots, rows)
        tables, values = self._tables, np.array(rewards, np.float64)
        tables.rewards[robots] = values
        tables.state[layout.RETURN, robots] += values
        tables.state[layout.OUTCOME, robots] = outcomes
        tables.ends[0, robots] = np.array(outcomes, np.int64) != Outcome.GOING
        tables.ends[1, robots] = tables.state[layout.STEPS, robots] >= self._setup.max_steps

    def _named(self) -> AbstractContextManager[None]:
        """Turn errors that the task raises inside a block into a TaskError with its name."""
        return translate_errors(TaskError, lambda: task_name(self._task))

    def _observed(self, robots: NDArray[np.int64], rows: list[tuple[float, ...]]) -> None:
        """Write the observations of these robots; TaskError where their number doesn't fit."""
        if rows and self._numbers:
            try:
                self._tables.observations[robots, : self._numbers] = rows
            except (TypeError, ValueError) as error:
                raise TaskError(f"{task_name(self._task)}.observe: {error}") from None

    def _states(self, robots: NDArray[np.int64]) -> list[State]:
        """The State of each of these robots."""
        tables, numbers = self._tables, self._numbers
        rows = tables.state[:, robots][kernel.STATE_ROWS].T.tolist()
        ranges, sensed = tables.ranges[robots], tables.observations[robots, numbers:]
        max_twist, period = self._constants
        return [
            State(
                (x, y, theta),
                (linear, angular),
                (a, b, c, d),
                (ahead, turn),
                (sent_linear, sent_angular),
                int(reason),
                ranges[place],
                tables.edges,
                sensed[place],
                steps * self._setup.ticks * self._setup.period,
                age,
                contact > 0.0,
                (goal_x, goal_y),
                *self._way(int(world), given > 0.0),
                max_twist,
                period,
            )
            for place, (
                x, y, theta, linear, angular, a, b, c, d, ahead, turn, sent_linear, sent_angular,
                reason, steps, age, contact, goal_x, goal_y, world, given,
            ) in enumerate(rows)
        ]  # fmt: skip

    def _way(self, world: int, given: bool) -> tuple[NDArray[np.float64], float]:
        """Samples of a world's path and its length [m]; NaN where it doesn't lead to the goal."""
        spawns = self._spawns
        known = len(spawns.lengths) > 0 and not given
        length = float(spawns.lengths[world]) if known else float("nan")
        if len(spawns.samples) == 0:
            return self._paths[0, :0], length
        return self._paths[world, : spawns.samples[world]], length

    def info(self) -> Info:
        """The task's part of info: what it remembers."""
        memories = [vars(memory) for memory in self._memory]
        return {
            name: np.array([memory[name] for memory in memories], np.float64)
            for name in info_names(self._task)
        }
