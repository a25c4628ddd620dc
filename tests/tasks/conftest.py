"""Tasks without an environment: one episode, with states that a test makes up."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.tasks import Outcome, State, Task
from acsar_gym.tasks.episode import RunningEpisode, Spawn

ACSAR = RobotConfig.preset("acsar")


class Played:
    """An episode that has begun at the origin."""

    def __init__(self, task: Task, options: Mapping[str, Any], worlds: Any = None) -> None:
        spawn = Spawn(task, worlds, None, ACSAR)
        self.assignment = spawn.draw(np.random.default_rng(0), options)
        self.episode = RunningEpisode(task, self.assignment)
        self.episode.begin(self.state())

    def state(self, **known: Any) -> State:
        """A state of this episode."""
        path = self.assignment.path
        about: dict[str, Any] = {"goal": self.assignment.goal, "length": self.assignment.length}
        about |= {} if path is None else {"path": path}
        about["max_twist"] = (ACSAR.max_linear, ACSAR.max_angular)
        return State(**(about | known))

    def step(self, **known: Any) -> tuple[float, Outcome]:
        """Reward and outcome of one step, counted in `time`."""
        self.episode.steps += 1
        return self.episode.step(self.state(time=self.episode.steps * 0.1, **known))

    def seen(self, **known: Any) -> dict[str, float]:
        """The observation, by its names."""
        values = self.episode.observe(self.state(**known)).tolist()
        return dict(zip(self.episode.task.observation, values, strict=True))


@pytest.fixture(scope="session")
def play() -> type[Played]:
    """`play(task, options, worlds)` is an episode that has started."""
    return Played
