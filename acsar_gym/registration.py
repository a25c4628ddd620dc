"""Register the ids of the environments with Gymnasium."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium

if TYPE_CHECKING:
    from acsar_gym.tasks import Task

__all__ = ["IDS", "SCENE_CHOICES", "SceneChoice", "register"]
IDS: dict[str, dict[str, Any]] = {
    "PointGoal-v0": {"max_episode_steps": 200, "reward_threshold": 4.0},
    "ObstacleGoal-v1": {"max_episode_steps": 600, "reward_threshold": 10.0},
    "Barn-v1": {"max_episode_steps": 1000, "reward_threshold": 13.0},
    "Crowd-v0": {"max_episode_steps": 800},
    "DynaBarn-v0": {"max_episode_steps": 1000},
    "PathFollow-v0": {"max_episode_steps": 400, "reward_threshold": 10.0},
}
"""What `gymnasium.register` gets for each id. The only place that contains their versions."""


@dataclass(frozen=True)
class SceneChoice:
    """Worlds, robots and score of one set of an id's scenes, for `acsar-gym benchmark`."""

    worlds: str | None = None
    """Generator of the worlds, such as "clutter" or "mine.module:corridors", or their folder. An
    empty name is an open floor, None the default of the task."""
    robots: tuple[str, ...] = ("acsar",)
    """Presets, files, or robots drawn by number, each of which drives the scenes."""
    score: str = ""
    """Score of an episode that succeeds: "completion_time", "cross_track", "success", or a number
    that the task reports. See `tools.benchmark.plan.score_episode`. An empty name is
    "completion_time" if the task has a shortest path, otherwise "success"."""


SCENE_CHOICES: dict[str, dict[str, SceneChoice]] = {}
"""Sets of scenes of users' own tasks by id and name, for `acsar-gym benchmark`."""


def register(
    id: str,  # noqa: A002 - Gymnasium's own name
    *,
    task: type[Task] | str,
    max_episode_steps: int | None = None,
    reward_threshold: float | None = None,
    scenes: Mapping[str, Mapping[str, Any]] | None = None,
    kwargs: Mapping[str, Any] | None = None,
    vector_kwargs: Mapping[str, Any] | None = None,
) -> None:
    """Register a user's own task with Gymnasium: one id for a single env and for batches.

    Args:
        id: Name with a namespace, such as "mine/Clearance-v0".
        task: Class of the task, a subclass of `acsar_gym.Task`, or "module:Class".
        max_episode_steps: Time limit of an episode [steps]. None for no limit.
        reward_threshold: Mean return from which the task counts as solved.
        scenes: Sets of scenes that `acsar-gym benchmark` drives, by name, as the fields of a
            `SceneChoice`, such as {"fast": {"robots": ["jackal"], "score": "laps"}}. By default
            one set, "test", in the worlds of the task.
        kwargs: Defaults of the env's and the task's options, such as {"worlds": "clutter:train"}.
            A batch leaves out options that only a single env has: lidar, on_fault, record, view.
        vector_kwargs: Defaults of options that only a batch has: autoreset_mode, threads.

    Raises:
        ConfigError: `task` isn't a class of tasks, `scenes` has other fields, or a batch has no
            such option of its own.

    Example:
        >>> import acsar_gym
        >>> acsar_gym.register(
        ...     "docs/Near-v0",
        ...     task="acsar_gym.tasks:PointGoal",
        ...     max_episode_steps=100,
        ...     kwargs={"goal_distance": (0.5, 1.0)},
        ... )
    """
    from acsar_gym.errors import ConfigError  # noqa: PLC0415
    from acsar_gym.tasks.factory import importable_task  # noqa: PLC0415
    from acsar_gym.tasks.options import (  # noqa: PLC0415
        BATCH_OPTIONS,
        MODE_DEFAULTS,
        SINGLE_OPTIONS,
        check_names,
    )

    # Check the sets of scenes now, not when a benchmark reads them.
    choices = {}
    for name, fields in (scenes or {}).items():
        try:
            robots = tuple(fields.get("robots", ("acsar",)))
            choices[name] = SceneChoice(**{**fields, "robots": robots})
        except (TypeError, AttributeError) as error:
            raise ConfigError(f"{id}: scenes {name!r}: {error}") from error

    # Gymnasium passes the same arguments to both modes.
    batch_options = dict(vector_kwargs or {})
    check_names(f"{id}: unknown option {{}} in vector_kwargs", batch_options, BATCH_OPTIONS)
    options = {**(kwargs or {}), "task": importable_task(task)}
    single_options = {name: options.pop(name) for name in SINGLE_OPTIONS if name in options}
    if single_options or batch_options:
        options[MODE_DEFAULTS] = single_options | batch_options

    gymnasium.register(
        id=id,
        entry_point="acsar_gym.envs.robot_env:RobotEnv",
        vector_entry_point="acsar_gym.vector.env:RobotVectorEnv",
        max_episode_steps=max_episode_steps,
        reward_threshold=reward_threshold,
        kwargs=options,
    )
    SCENE_CHOICES[id] = choices or {"test": SceneChoice()}


def register_all() -> None:
    """Register this package's ids. Idempotent."""
    for name, options in IDS.items():
        if f"acsar_gym/{name}" not in gymnasium.registry:
            home = f"acsar_gym.envs.manuals:{name.partition('-')[0]}"
            gymnasium.register(
                id=f"acsar_gym/{name}",
                entry_point=f"{home}Env",
                vector_entry_point=f"{home}VectorEnv",
                **options,
            )


def snake_case(name: str) -> str:
    """Convert "PointGoal" to "point_goal"."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()
