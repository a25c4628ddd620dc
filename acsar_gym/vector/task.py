"""Run a compiled task over a batch."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError, TranslatedErrors
from acsar_gym.jit import record_of
from acsar_gym.tasks.factory import task_name
from acsar_gym.tasks.task import Task, info_names, is_compiled
from acsar_gym.vector.kernel.binding import name_error, numbers_of
from acsar_gym.vector.kernel.layout import Setup, Spawns, Tables
from acsar_gym.vector.kernel.task import bind_task


class TaskLoop:
    """The loop that numba compiles together with the methods of a task's class.

    It releases the GIL, so that threads can run it for slices of robots.

    Raises:
        ConfigError: The task isn't compiled.
    """

    def __init__(self, task: Task, tables: Tables, setup: Setup, spawns: Spawns) -> None:
        if not is_compiled(task):
            raise ConfigError(
                f"{task_name(task)}: a batch needs a compiled task: set compiled = True in "
                f"{type(task).__name__}, or make_vec with vectorization_mode='async'"
            )
        self._task = task
        self._setups = record_of(setup)
        self._spawns = spawns
        self._loop = bind_task(task)

        # A row for each robot, and one with the first values.
        kinds = [(name, np.float64) for name in task.memory] or [("nothing", np.float64)]
        self._memory: NDArray[Any] = np.zeros(len(tables.rewards) + 1, kinds)
        with TranslatedErrors(ConfigError, lambda: task_name(task)):
            for name, value in task.memory.items():
                self._memory[name][-1] = value
        self._arguments = (numbers_of(task), self._memory, tables)

    def run(self, first: int, last: int) -> None:
        """Write rewards, ends and observations of blocks first to last, after their physics."""
        try:
            self._loop(*self._arguments, first, last, self._setups, self._spawns)
        except Exception as error:
            raise name_error(task_name(self._task), error) from error

    def info(self) -> dict[str, NDArray[np.float64]]:
        """The task's part of info, an array for each key: what it remembers."""
        return {name: self._memory[name][:-1].copy() for name in info_names(self._task)}
