"""Register the ids of the environments with Gymnasium."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import gymnasium

if TYPE_CHECKING:
    from acsar_gym.tasks import Task

__all__ = ["IDS", "register"]
IDS: dict[str, dict[str, Any]] = {
    "PointGoal-v0": {"max_episode_steps": 200, "reward_threshold": 4.0},
    "ObstacleGoal-v1": {"max_episode_steps": 600, "reward_threshold": 12.0},
    "Barn-v1": {"max_episode_steps": 1000, "reward_threshold": 18.0},
    "PathFollow-v0": {"max_episode_steps": 400, "reward_threshold": 10.0},
}
"""What `gymnasium.register` gets for each id; the one place that knows their versions."""


def register(
    id: str,  # noqa: A002 - Gymnasium's own name
    *,
    task: type[Task] | str,
    max_episode_steps: int | None = None,
    reward_threshold: float | None = None,
    **options: Any,
) -> None:
    """Register a user's own task with Gymnasium: one id for a single env and for batches.

    Args:
        id: such as "mine/Clearance-v0".
        task: the class of the task, a subclass of `acsar_gym.Task`, or "module:Class".
        max_episode_steps: time limit of an episode [steps]; None is none.
        reward_threshold: mean return from which the task counts as solved.
        **options: defaults of the env's and the task's options, such as worlds="clutter:train".
            Those that only a single env has (lidar, on_fault, view) don't count in a batch, and
            those that only a batch has (autoreset_mode, threads) not in a single env.

    Raises:
        ConfigError: where `task` isn't a class of tasks.
    """
    from acsar_gym.tasks.factory import importable_task, split_by_mode  # noqa: PLC0415

    gymnasium.register(
        id=id,
        entry_point="acsar_gym.envs.base:RobotEnv",
        vector_entry_point="acsar_gym.vector.env:RobotVectorEnv",
        max_episode_steps=max_episode_steps,
        reward_threshold=reward_threshold,
        kwargs={"task": importable_task(task), **split_by_mode(options)},
    )


def register_all() -> None:
    """Register this package's ids. Idempotent."""
    for name, options in IDS.items():
        if f"acsar_gym/{name}" not in gymnasium.registry:
            kind = name.partition("-")[0]
            home = f"acsar_gym.envs.{snake_case(kind)}"
            gymnasium.register(
                id=f"acsar_gym/{name}",
                entry_point=f"{home}:{kind}Env",
                vector_entry_point=f"{home}:{kind}VectorEnv",
                **options,
            )


def snake_case(name: str) -> str:
    """Convert "PointGoal" to "point_goal"."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()
