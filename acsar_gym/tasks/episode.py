"""One episode of a task in the single environment."""

from __future__ import annotations

from acsar_gym.errors import ConfigError, shown
from acsar_gym.tasks.base import Info, Memory, Outcome, State, Task, remembered, told
from acsar_gym.tasks.made import named
from acsar_gym.tasks.spawn import Assignment


def outcome_of(task: Task, state: State, memory: Memory) -> Outcome:
    """Ask a task for the outcome of a step.

    Raises:
        ConfigError: it is no Outcome.
    """
    outcome = task.outcome(state, memory)
    try:
        return Outcome(outcome)
    except ValueError:
        raise ConfigError(
            f"{named(task)}.outcome returned {shown(outcome)}: must be an Outcome"
        ) from None


def reward_of(task: Task, state: State, memory: Memory, outcome: Outcome) -> float:
    """Ask a task for the reward of a step.

    Raises:
        ConfigError: it is no number.
    """
    reward = task.reward(state, memory, outcome)
    try:
        return float(reward)
    except (TypeError, ValueError):
        raise ConfigError(
            f"{named(task)}.reward returned {shown(reward)}: must be a number"
        ) from None


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
        """Begin the episode with the state after the reset."""
        self.task.begin(state, self.memory)

    def step(self, state: State) -> tuple[float, Outcome]:
        """Return the reward and the outcome of the step that led to this state."""
        self.outcome = outcome_of(self.task, state, self.memory)
        return reward_of(self.task, state, self.memory, self.outcome), self.outcome

    def observe(self, state: State) -> tuple[float, ...]:
        """Return the task's own numbers of the observation."""
        return self.task.observe(state, self.memory)

    def info(self) -> Info:
        """Return what the task adds to info; the keys are the same at every step."""
        memory = vars(self.memory)
        return {name: float(memory[name]) for name in self._told} | self.assignment.info
