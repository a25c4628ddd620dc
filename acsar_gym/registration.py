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
"""What `gymnasium.register` gets for each id; the one place that knows their versions."""


@dataclass(frozen=True)
class SceneChoice:
    """Worlds, robots and score of one set of an id's scenes, for `acsar-gym benchmark`."""

    worlds: str | None = None
    """Generator of the worlds, such as "clutter" or "mine.module:corridors", or their folder; ""
    is an open floor, None the task's own default."""
    robots: tuple[str, ...] = ("acsar",)
    """Presets, files, or robots drawn by number, each of which drives the scenes."""
    score: str = ""
    """What scores an episode that succeeds: "completion_time", "cross_track", "success", or one of
    the numbers that the task tells; see `tools.benchmark.figures.score_episode`. "" is
    "completion_time" where the task says its shortest path, otherwise "success"."""


TWO_ROBOTS = ("acsar", "jackal")
THREE_ROBOTS = (*TWO_ROBOTS, "husky")
UNSEEN_ROBOTS = tuple(f"drawn:{number}" for number in range(2000, 2005))
"""Robots drawn at random that no policy was trained on."""
SCENE_CHOICES: dict[str, dict[str, SceneChoice]] = {
    "acsar_gym/PointGoal-v0": {"open": SceneChoice("", THREE_ROBOTS, "completion_time")},
    "acsar_gym/ObstacleGoal-v1": {
        "clutter": SceneChoice("clutter", THREE_ROBOTS, "completion_time"),
        "clutter-unseen": SceneChoice("clutter", UNSEEN_ROBOTS, "completion_time"),
    },
    "acsar_gym/Barn-v1": {
        "barn": SceneChoice("barn", score="barn_score_own"),
        "barn-fast": SceneChoice("barn", ("jackal",), "barn_score"),
        "barn-husky": SceneChoice("barn", ("husky",), "barn_score_own"),
        "barn-unseen": SceneChoice("barn", UNSEEN_ROBOTS, "barn_score_own"),
    },
    "acsar_gym/Crowd-v0": {
        "crowd": SceneChoice("crowd", TWO_ROBOTS, "completion_time"),
        "crowd-reacting": SceneChoice("crowd_reacting", TWO_ROBOTS, "completion_time"),
    },
    "acsar_gym/DynaBarn-v0": {"dynabarn": SceneChoice("dynabarn", TWO_ROBOTS, "completion_time")},
    "acsar_gym/PathFollow-v0": {"path": SceneChoice("smooth_path", THREE_ROBOTS, "cross_track")},
}
"""The benchmark's sets of scenes by id and name."""


REGISTER_OPTIONS = ("task", "max_episode_steps", "reward_threshold", "scenes")
"""What `register` itself takes, for messages."""


def register(
    id: str,  # noqa: A002 - Gymnasium's own name
    *,
    task: type[Task] | str,
    max_episode_steps: int | None = None,
    reward_threshold: float | None = None,
    scenes: Mapping[str, Mapping[str, Any]] | None = None,
    **options: Any,
) -> None:
    """Register a user's own task with Gymnasium: one id for a single env and for batches.

    Args:
        id: such as "mine/Clearance-v0".
        task: the class of the task, a subclass of `acsar_gym.Task`, or "module:Class".
        max_episode_steps: time limit of an episode [steps]; None is none.
        reward_threshold: mean return from which the task counts as solved.
        scenes: the sets of scenes that `acsar-gym benchmark` drives, by name, as the fields of a
            `SceneChoice`, such as {"fast": {"robots": ["jackal"], "score": "laps"}}; by default
            one, "test", in the task's own worlds.
        **options: defaults of the env's and the task's options, such as worlds="clutter:train".
            Those that only a single env has (lidar, on_fault, view) don't count in a batch, and
            those that only a batch has (autoreset_mode, threads) not in a single env.

    Raises:
        ConfigError: where `task` isn't a class of tasks, `scenes` has other fields, or nothing has
            such an option.
    """
    from acsar_gym.errors import ConfigError  # noqa: PLC0415
    from acsar_gym.reading import import_object  # noqa: PLC0415
    from acsar_gym.tasks.factory import importable_task  # noqa: PLC0415
    from acsar_gym.tasks.options import check_register_options, split_by_mode  # noqa: PLC0415

    chosen = {}
    for name, given in (scenes or {}).items():
        try:
            chosen[name] = SceneChoice(
                **{**given, "robots": tuple(given.get("robots", ("acsar",)))}
            )
        except (TypeError, AttributeError) as error:
            raise ConfigError(f"{id}: scenes {name!r}: {error}") from error
    kind = import_object("task", task) if isinstance(task, str) else task
    named = importable_task(kind)
    check_register_options(id, kind, options, REGISTER_OPTIONS)
    SCENE_CHOICES[id] = chosen or {"test": SceneChoice()}
    gymnasium.register(
        id=id,
        entry_point="acsar_gym.envs.robot_env:RobotEnv",
        vector_entry_point="acsar_gym.vector.env:RobotVectorEnv",
        max_episode_steps=max_episode_steps,
        reward_threshold=reward_threshold,
        kwargs={"task": named, **split_by_mode(options)},
    )


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
