"""The ids of the environments, told to Gymnasium once it is imported.

Importing Gymnasium takes longer than an emergency stop may, so this package doesn't. Where it is
there already the ids are registered at once; else as soon as somebody imports it, and before
anybody can see it: a finder on `sys.meta_path` hands out Gymnasium's own module spec, with the
registration behind the execution of the module. Python holds the module's import lock meanwhile.
"""

from __future__ import annotations

import importlib
import itertools
import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

GYMNASIUM = "gymnasium"
IDS: dict[str, dict[str, Any]] = {
    "PointGoal": {"max_episode_steps": 200, "reward_threshold": 4.0},
    "ObstacleGoal": {"max_episode_steps": 400, "reward_threshold": 10.0},
    "Barn": {"max_episode_steps": 1000, "reward_threshold": 14.0},
    "PathFollow": {"max_episode_steps": 400, "reward_threshold": 10.0},
}
"""What `gymnasium.register` is told of each."""


def register() -> None:
    """Register all ids; idempotent. Waits for another thread that is importing Gymnasium."""
    gymnasium = importlib.import_module(GYMNASIUM)
    for name, options in IDS.items():
        if f"acsar_gym/{name}-v0" not in gymnasium.registry:
            gymnasium.register(
                id=f"acsar_gym/{name}-v0",
                entry_point=f"acsar_gym.envs:{name}Env",
                vector_entry_point=f"acsar_gym.envs:{name}VectorEnv",
                **options,
            )


def when_gymnasium_is_imported() -> None:
    """Register the ids now, or right after the import of Gymnasium."""
    finder = _Finder()
    sys.meta_path.insert(0, finder)  # first, for another thread may begin to import it here
    if sys.modules.get(GYMNASIUM) is not None:
        sys.meta_path.remove(finder)
        register()


class _Finder(MetaPathFinder):
    """Finds Gymnasium as the other finders do, and registers the ids when it has been executed."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The spec of Gymnasium that a later finder has; nothing for any other module."""
        if name != GYMNASIUM:
            return None
        later = list(itertools.dropwhile(lambda finder: finder is not self, sys.meta_path))[1:]
        specs = (finder.find_spec(name, path, target) for finder in later)
        spec = next((spec for spec in specs if spec is not None), None)
        if spec is not None and spec.loader is not None:
            self._follow(spec.loader)
        return spec

    def _follow(self, loader: Loader) -> None:
        """Let the loader register the ids once it has executed Gymnasium."""
        execute = loader.exec_module

        def exec_module(module: ModuleType) -> None:
            execute(module)
            if module.__name__ == GYMNASIUM:
                vars(loader).pop("exec_module", None)
                if self in sys.meta_path:
                    sys.meta_path.remove(self)
                register()

        loader.exec_module = exec_module  # type: ignore[method-assign]
