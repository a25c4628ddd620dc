"""Ids of environments: short names of this package's own, and those that other packages register.

| as given | means |
|---|---|
| `point_goal` | `acsar_gym/PointGoal-v0` |
| `acsar_gym/PointGoal-v0` | itself |
| `mine.module:mine/Clearance-v0` | the id that importing `mine.module` registers |
"""

from __future__ import annotations

import importlib
from typing import Any

import gymnasium

from acsar_gym.errors import AcsarError, ConfigError, explain_error, format_error
from acsar_gym.reading import find_modules_here
from acsar_gym.registration import IDS
from acsar_gym.vector.env import RobotVectorEnv


def full_id(name: str) -> str:
    """Expand an env's short name: "barn" is "acsar_gym/Barn-v1", its newest version.

    "dyna_barn" and "dynabarn" are the same.
    """
    if not name or "/" in name or ":" in name:
        return name
    # The table has the newest version of each id only.
    kind = name.replace("_", "").lower()
    newest = next((env_id for env_id in IDS if env_id.lower().startswith(f"{kind}-")), None)
    return f"acsar_gym/{newest or name.title().replace('_', '')}"


def strip_module(env_id: str) -> str:
    """Remove the module from an id, so that a file which stores the id can't cause an import."""
    return env_id.rpartition(":")[2]


def find_id(name: str) -> str:
    """Find the full id of a registered environment. Imports its module first, where one is named.

    Modules are also looked for in the current folder, as Python does for a script there.
    """
    env_id = full_id(name)
    module = env_id.rpartition(":")[0]
    try:
        if module:
            with find_modules_here():
                importlib.import_module(module)
    except AcsarError:
        raise
    except (Exception, SystemExit) as error:
        reason = format_error(error)
        raise ConfigError(f"env {name}: the module {module} can't be imported: {reason}") from error

    try:
        gymnasium.spec(strip_module(env_id))
    except gymnasium.error.Error as error:
        hint = f"importing {module} doesn't register it: " if module else ""
        hint += explain_error(error)
        if not module and not env_id.startswith("acsar_gym/"):
            hint = (
                "isn't registered: name the module that registers it, too, as in "
                f"mine_package:{name}"
            )
        raise ConfigError(f"env {name}: {hint}") from error
    return env_id


def make_vec(env_id: str, num_envs: int, **options: Any) -> RobotVectorEnv:
    """Make a batch of planar robots of a registered id."""
    mode = "vector_entry_point"
    try:
        batch = gymnasium.make_vec(env_id, num_envs, vectorization_mode=mode, **options)
    except (gymnasium.error.Error, ImportError, TypeError) as error:
        raise ConfigError(f"{env_id}: no batch of these options: {explain_error(error)}") from error
    if not isinstance(batch, RobotVectorEnv):
        batch.close()
        raise ConfigError(f"{env_id}: its batch isn't one of acsar_gym's robots")
    return batch
