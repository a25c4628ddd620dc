"""Records what is needed to repeat an evaluation.

This is the `header` in the JSON of `evaluate`, `run` and `demo`:

| key | content |
|---|---|
| `versions` | of acsar_gym, gymnasium, numpy, python, and, where they are installed, of |
| | onnxruntime, torch, pybullet and mujoco |
| `policy` | `file`, `sha256` of what was read from it (null where nothing was), the `function` of |
| | a Python file (else null), the `env` that it was made for, the `differences` between the |
| | robot and those of its training, and whether it is `privileged`: knows the simulator's truth |
| `env` | `id`, `kwargs` as in its spec, `max_episode_steps` |
| `robot` | `sha256` of its whole config |
| `link` | name of the link |
| `worlds` | `kind` ("none" on an open floor), `split` ("train", "test" or null), numbers of the |
| | `first` and `last` world, `difficulty`, footprint `radius` [m], `sha256` of what defines them: |
| | their contents, or, if this package generates them, all of these, its version and sources and |
| | NumPy's version. A list of these for several sets |
| `seeds` | of the `first` and `last` episode |
| `options` | of the resets, and `in_order`, `late_share` |
| `workers` | how many episodes ran at a time; null for one per CPU of the cluster |
| `address` | of the Ray cluster that they ran on; null for this machine |

The JSON also has the means of `metrics.Summary` with their `intervals`, and in `per_episode` the
fields of every `Episode`: seed, world, episode_return, length, and so on.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import platform
from collections.abc import Mapping
from importlib import metadata
from typing import Any

import gymnasium
import numpy as np

import acsar_gym
from acsar_gym.config.robot import hash_config
from acsar_gym.tasks.spec import to_plain
from acsar_gym.tools.policies import FilePolicy
from acsar_gym.worlds.cache import fingerprint
from acsar_gym.worlds.mover_files import format_mover
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.registry import BUILT_IN_KINDS
from acsar_gym.worlds.sets import WorldSet
from acsar_gym.worlds.world import World

DRIVING_LIBRARIES = ("onnxruntime", "torch", "pybullet", "pybullet-arm64", "mujoco")
"""Libraries that the results of episodes depend on, if they are installed."""
HIDDEN_ARGUMENTS = ("link", "record")  # arguments of an env that say nothing about its episodes


def make_header(
    env: gymnasium.Env[Any, Any],
    policy: FilePolicy,
    link: str,
    seeds: range,
    options: Mapping[str, Any],
) -> dict[str, Any]:
    """Collect what is needed to repeat an evaluation, ready for JSON; see above for its keys.

    `options` are those of the resets and of the evaluation.
    """
    inner: Any = env.unwrapped
    return {
        "versions": library_versions(*DRIVING_LIBRARIES),
        "policy": policy.about
        | {
            "differences": [*policy.outside, *policy.differences],
            "privileged": policy.privileged,
        },
        "env": _describe_env(env),
        "robot": {"sha256": hash_config(inner.robot.config)},
        "link": link,
        "worlds": _describe_worlds(inner.pool),
        "seeds": {"first": seeds[0], "last": seeds[-1]},
        "options": to_plain(options),
        "workers": 1,
        "address": None,
    }


def library_versions(*libraries: str) -> dict[str, str]:
    """Return the versions of this package, of what it always needs, and of installed libraries."""
    versions = {
        "acsar_gym": acsar_gym.__version__,
        "gymnasium": gymnasium.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }
    for name in libraries:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions


def _describe_env(env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """Describe the env by its spec; values that JSON can't hold by their repr()."""
    spec = env.spec
    if spec is None:
        return {"id": None, "kwargs": {}, "max_episode_steps": None}
    kwargs = {}
    for name, value in spec.kwargs.items():
        if name not in HIDDEN_ARGUMENTS:
            kwargs[name] = value
            try:
                json.dumps(value, allow_nan=False)
            except (TypeError, ValueError):
                kwargs[name] = repr(value)
    return {"id": spec.id, "kwargs": kwargs, "max_episode_steps": spec.max_episode_steps}


def _describe_worlds(pool: Pool | None) -> dict[str, Any] | list[dict[str, Any]]:
    """Describe the worlds, several sets in a list; a hash changes if any world of a set does."""
    if pool is None:
        keys = ("split", "first", "last", "difficulty", "radius", "sha256")
        return {"kind": "none", **dict.fromkeys(keys)}
    descriptions = [_describe_set(worlds, pool.radius) for worlds in pool.sets]
    return descriptions if len(descriptions) > 1 else descriptions[0]


def _describe_set(worlds: WorldSet, radius: float) -> dict[str, Any]:
    """Describe a set of worlds and what defines them."""
    about = {
        "kind": worlds.kind,
        "split": worlds.split or None,
        "first": worlds.numbers[0],
        "last": worlds.numbers[-1],
        "difficulty": worlds.difficulty,
        "radius": radius,
    }
    content: list[Any] = [about, fingerprint()]
    if worlds.generator not in BUILT_IN_KINDS:
        content = [_describe_world(world) for world in Pool([worlds], radius)]
    text = json.dumps(content, sort_keys=True)
    return about | {"sha256": hashlib.sha256(text.encode()).hexdigest()}


def _describe_world(world: World) -> list[Any]:
    """List what defines a world, ready for JSON."""
    return [
        world.circles.tolist(),
        world.segments.tolist(),
        repr(world.start),
        repr(world.goal),
        None if world.path is None else world.path.tolist(),
        *map(format_mover, world.movers),
    ]
