"""Register the ids of the environments with Gymnasium, without importing Gymnasium.

Importing Gymnasium takes longer than an emergency stop may, so this package doesn't import it.
If it is imported already, the ids are registered at once. Otherwise they are registered when it
is imported, before anybody can use it: a finder on `sys.meta_path` returns Gymnasium's own module
spec, with the registration added after the execution of the module. Python holds the module's
import lock meanwhile.
"""

from __future__ import annotations

import importlib
import itertools
import re
import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from acsar_gym.tasks import Task

__all__ = ["IDS", "register"]
GYMNASIUM = "gymnasium"
IDS: dict[str, dict[str, Any]] = {
    "PointGoal-v0": {"max_episode_steps": 200, "reward_threshold": 4.0},
    "ObstacleGoal-v1": {"max_episode_steps": 400, "reward_threshold": 12.0},
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
    from acsar_gym.tasks.made import importable  # noqa: PLC0415 - this module is light
    from acsar_gym.tasks.options import by_mode  # noqa: PLC0415

    gymnasium = importlib.import_module(GYMNASIUM)
    gymnasium.register(
        id=id,
        entry_point="acsar_gym.envs.base:RobotEnv",
        vector_entry_point="acsar_gym.vector.env:RobotVectorEnv",
        max_episode_steps=max_episode_steps,
        reward_threshold=reward_threshold,
        kwargs={"task": importable(task), **by_mode(options)},
    )


def register_all() -> None:
    """Register this package's ids. Idempotent; waits for a thread that is importing Gymnasium."""
    gymnasium = importlib.import_module(GYMNASIUM)
    for name, options in IDS.items():
        if f"acsar_gym/{name}" not in gymnasium.registry:
            kind = name.partition("-")[0]
            home = f"acsar_gym.envs.{snake(kind)}"
            gymnasium.register(
                id=f"acsar_gym/{name}",
                entry_point=f"{home}:{kind}Env",
                vector_entry_point=f"{home}:{kind}VectorEnv",
                **options,
            )


def snake(name: str) -> str:
    """Convert "PointGoal" to "point_goal"."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()


def when_gymnasium_is_imported() -> None:
    """Register the ids now, or right after the import of Gymnasium."""
    finder = _Finder()
    sys.meta_path.insert(0, finder)  # before the check: another thread may import it meanwhile
    if sys.modules.get(GYMNASIUM) is not None:
        sys.meta_path.remove(finder)
        register_all()


class _Finder(MetaPathFinder):
    """Finds Gymnasium with the other finders, and registers the ids once it has been executed."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return Gymnasium's spec from a later finder; None for any other module."""
        if name != GYMNASIUM:
            return None
        later = list(itertools.dropwhile(lambda finder: finder is not self, sys.meta_path))[1:]
        specs = (finder.find_spec(name, path, target) for finder in later)
        spec = next((spec for spec in specs if spec is not None), None)
        if spec is not None and spec.loader is not None:
            self._follow(spec.loader)
        return spec

    def _follow(self, loader: Loader) -> None:
        """Make the loader register the ids once it has executed Gymnasium."""
        execute = loader.exec_module

        def exec_module(module: ModuleType) -> None:
            execute(module)
            if module.__name__ == GYMNASIUM:
                vars(loader).pop("exec_module", None)
                if self in sys.meta_path:
                    sys.meta_path.remove(self)
                register_all()

        loader.exec_module = exec_module  # type: ignore[method-assign]
