"""What an environment tells its recorder: task, goals, observations, actions and rewards."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError, show_value
from acsar_gym.recording import Recorder
from acsar_gym.recording.encoder import Stepped
from acsar_gym.robot import Robot
from acsar_gym.tasks import Observation, Task
from acsar_gym.tasks.episode import Assignment
from acsar_gym.tasks.factory import task_name


class EnvRecord:
    """Records the steps of one environment; does nothing without a recorder.

    Args:
        record: a file to write, a Recorder, or None.

    Attributes: `recorder`, for the robot; None without one.

    Raises:
        ConfigError: for anything else.
    """

    def __init__(self, record: Any) -> None:
        if (
            record is not None
            and not isinstance(record, str | Recorder)
            and not hasattr(record, "__fspath__")
        ):
            raise ConfigError(f"record = {show_value(record)}: must be the name of a file")
        ready = record is None or isinstance(record, Recorder)
        self.recorder: Recorder | None = record if ready else Recorder(record)

    def begin(
        self, spec: EnvSpec | None, task: Task, seed: int | None, assignment: Assignment
    ) -> None:
        """Before the robot's reset: describe the env, and the episode that begins."""
        if self.recorder is None:
            return
        told: dict[str, Any] = {} if spec is None else {"id": spec.id, "kwargs": _own(spec)}
        self.recorder.about.setdefault("env", told)
        self.recorder.about.setdefault("task", task_name(task))
        self.recorder.about.setdefault("observation", list(task.observation))
        info = {"seed": seed, "goal": list(assignment.goal), "start": list(assignment.start)}
        world = None if assignment.world is None else assignment.number
        self.recorder.describe(info | {"world": world})

    def first(self, robot: Robot, observation: Observation) -> None:
        """After a reset."""
        if self.recorder is not None:
            now = robot.link.now()
            self.recorder.add(Stepped(0, now, observation.copy(), None, math.nan, False, False))

    def stepped(
        self,
        robot: Robot,
        step: int,
        action: NDArray[np.float32],
        told: tuple[Observation, float, bool, bool],
        success: float = 0.0,
    ) -> None:
        """After a step.

        Args:
            robot: with the clock.
            step: its number in the episode, from 1.
            action: as it was given.
            told: observation, reward, terminated, truncated.
            success: 1.0 where the task is solved.
        """
        if self.recorder is not None:
            observation, reward, terminated, truncated = told
            now, seen = robot.link.now(), observation.copy()
            ends = terminated, truncated, success == 1.0
            taken = np.array(action, np.float32)
            self.recorder.add(Stepped(step, now, seen, taken, reward, *ends))


def _own(spec: EnvSpec) -> dict[str, Any]:
    """The arguments of an env, except for its link and its recording."""
    return {name: value for name, value in spec.kwargs.items() if name not in ("link", "record")}
