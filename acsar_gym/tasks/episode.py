"""One episode of a task in the single environment."""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.errors import TaskError, shown, translate_errors
from acsar_gym.tasks.base import Info, Memory, Observation, Outcome, State, Task, remembered, told
from acsar_gym.tasks.made import named
from acsar_gym.tasks.spawn import Assignment


def outcome_of(task: Task, state: State, memory: Memory) -> Outcome:
    """Ask a task for the outcome of a step.

    Raises:
        TaskError: it is no Outcome.
    """
    outcome = task.outcome(state, memory)
    try:
        return Outcome(outcome)
    except ValueError:
        raise TaskError(
            f"{named(task)}.outcome returned {shown(outcome)}: must be an Outcome"
        ) from None


def reward_of(task: Task, state: State, memory: Memory, outcome: Outcome) -> float:
    """Ask a task for the reward of a step.

    Raises:
        TaskError: it is no finite number.
    """
    reward = task.reward(state, memory, outcome)
    try:
        number = float(reward)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise TaskError(f"{named(task)}.reward returned {shown(reward)}: must be a finite number")
    return number


def check_observation(task: Task, numbers: Observation) -> None:
    """Check the task's own numbers of an observation.

    Args:
        task: that returned them.
        numbers: (numbers,), or (robots, numbers) of a batch.

    Raises:
        TaskError: for NaN and infinity; names the numbers.
    """
    if np.isfinite(numbers).all():
        return
    rows = np.atleast_2d(numbers)
    robot = int(np.isfinite(rows).all(axis=1).argmin())
    found = dict(zip(task.observation, rows[robot].tolist(), strict=True))
    wrong = {name: number for name, number in found.items() if not math.isfinite(number)}
    whose = f" for robot {robot}" if numbers.ndim > 1 else ""
    raise TaskError(f"{named(task)}.observe returned {shown(wrong)}{whose}: must be finite numbers")


class Episode:
    """The running episode of a task: its assignment (world, start, goal) and its memory.

    Attributes: `task`, `assignment`, `memory`; `steps` so far; `outcome` of the last step.
    """

    def __init__(self, task: Task, assignment: Assignment) -> None:
        self.task, self.assignment = task, assignment
        self.memory = remembered(task)
        self.steps = 0
        self.outcome = Outcome.GOING
        self._told = told(task)

    def begin(self, state: State) -> None:
        """Begin the episode with the state after the reset. TaskError as for `step`."""
        with translate_errors(TaskError, lambda: named(self.task)):
            self.task.begin(state, self.memory)

    def step(self, state: State) -> tuple[float, Outcome]:
        """Return the reward and the outcome of the step that led to this state.

        Raises:
            TaskError: the task raises an error, or returns what can't be used.
        """
        with translate_errors(TaskError, lambda: named(self.task)):
            self.outcome = outcome_of(self.task, state, self.memory)
            return reward_of(self.task, state, self.memory, self.outcome), self.outcome

    def observe(self, state: State) -> tuple[float, ...]:
        """Return the task's own numbers of the observation. TaskError as for `step`."""
        with translate_errors(TaskError, lambda: named(self.task)):
            return self.task.observe(state, self.memory)

    def info(self) -> Info:
        """Return what the task adds to info; the keys are the same at every step."""
        memory = vars(self.memory)
        return {name: float(memory[name]) for name in self._told} | self.assignment.info
