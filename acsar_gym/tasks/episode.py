"""One episode of a task in the single environment."""

from __future__ import annotations

from acsar_gym.tasks.base import Info, Outcome, State, Task, remembered, told
from acsar_gym.tasks.spawn import Assignment


class Episode:
    """A task, what this episode of it is about, and what it remembers.

    Attributes: `task`, `assignment`, `memory`; `steps` so far; `outcome` of the last step.
    """

    def __init__(self, task: Task, assignment: Assignment) -> None:
        self.task, self.assignment = task, assignment
        self.memory = remembered(task)
        self.steps = 0
        self.outcome = Outcome.GOING
        self._told = told(task)

    def begin(self, state: State) -> None:
        """The robot stands at the start."""
        self.task.begin(state, self.memory)

    def step(self, state: State) -> tuple[float, Outcome]:
        """Reward and outcome of the step that led to this state."""
        self.outcome = Outcome(self.task.outcome(state, self.memory))
        return float(self.task.reward(state, self.memory, self.outcome)), self.outcome

    def observe(self, state: State) -> tuple[float, ...]:
        """The task's numbers of the observation."""
        return self.task.observe(state, self.memory)

    def info(self) -> Info:
        """What the task tells, the same keys at every step."""
        memory = vars(self.memory)
        return {name: float(memory[name]) for name in self._told} | self.assignment.info
