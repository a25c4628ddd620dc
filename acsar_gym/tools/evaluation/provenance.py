"""Records what is needed to repeat an evaluation.

This is the `header` in the JSON of `evaluate`, `run` and `demo`:

| key | content |
|---|---|
| `versions` | of acsar_gym, gymnasium, numpy, python, and, if they are installed, of onnxruntime, |
| | torch, pybullet and mujoco |
| `policy` | `file`, `sha256` of its content, the `function` of a Python file, the `env` that it |
| | was made for, the `differences` to its training, and whether it is `privileged`: knows the |
| | simulator's truth |
| `env` | `id`, `kwargs` as in its spec, `max_episode_steps` |
| `task` | `sha256` of the source of its class and of the user's modules that it imports |
| `robot` | `sha256` of its whole config |
| `link` | name of the link |
| `worlds` | `sets`, such as "clutter 0 to 199 (test split)", or "none" on an open floor, their |
| | `difficulty`, footprint `radius` [m], and `sha256` of their contents, or, if this package |
| | generates them, of all of these, its version and sources and NumPy's version |
| `seeds` | of the `first` and `last` episode |
| `options` | of the resets, and `late_share` |
| `workers` | how many episodes ran at a time |

The JSON also has the means of `metrics.Summary` with their `intervals`, and in `per_episode` the
fields of every `Episode`: seed, world, episode_return, length, and so on.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from importlib import metadata
from typing import Any

import gymnasium
import numpy as np

import acsar_gym
from acsar_gym.config.robot import hash_config
from acsar_gym.resources import PACKAGE, hash_modules, hash_sources
from acsar_gym.tasks.spec import to_plain
from acsar_gym.tools.evaluation.metrics import replace_nonfinite
from acsar_gym.tools.policies import FilePolicy
from acsar_gym.worlds import World
from acsar_gym.worlds.cache import fingerprint
from acsar_gym.worlds.movers import make_motions
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.registry import BUILT_IN_KINDS

DRIVING_LIBRARIES = ("onnxruntime", "torch", "pybullet", "pybullet-arm64", "mujoco")
"""Libraries that the results of episodes depend on, if they are installed."""
HIDDEN_ARGUMENTS = ("link", "record")
"""Arguments of an env that don't change its episodes."""
OWN_MODULES = ("acsar_gym", "abc", "builtins", "typing")
"""Modules of classes from which a user's class may inherit."""


def make_header(
    env: gymnasium.Env[Any, Any],
    policy: FilePolicy,
    link: str,
    seeds: range,
    options: Mapping[str, Any],
) -> dict[str, Any]:
    """Collect what is needed to repeat an evaluation, ready for JSON, see above for its keys."""
    inner: Any = env.unwrapped

    return {
        "versions": library_versions(*DRIVING_LIBRARIES),
        "policy": {
            **policy.about,
            "differences": [*policy.differences],
            "privileged": policy.privileged,
        },
        "env": _describe_env(env),
        "task": {"sha256": hash_source(type(inner.task))},
        "robot": {"sha256": hash_config(inner.robot.config)},
        "link": link,
        "worlds": _describe_worlds(inner.pool),
        "seeds": {"first": seeds[0], "last": seeds[-1]},
        "options": to_plain(options),
        "workers": 1,
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


def hash_source(code: Any) -> str:
    """Hash the source of a class or function and of the user's modules that it imports.

    Of code of this package, all sources of the package. Empty if the module has no file, as in a
    notebook.
    """
    # A user's class may inherit from another module of the user.
    kinds = code.__mro__ if isinstance(code, type) else (code,)
    modules = dict.fromkeys(kind.__module__ for kind in kinds)
    users = [name for name in modules if name.partition(".")[0] not in OWN_MODULES]
    return hash_modules(*users) if users else hash_sources(PACKAGE)


def hash_world(world: World) -> bytes:
    """Hash the numbers that define a world, its path only if nothing stands or moves in it."""
    # A path matters only if it is all that there is: elsewhere planners find ways of their own.
    start = world.start
    goal = world.goal
    theta = -10.0 if start.theta is None else start.theta
    is_empty = not (world.obstacles or world.movers)
    return hash_numbers(
        [
            world.circles,
            world.segments,
            (start.x, start.y, start.radius, theta),
            (goal.x, goal.y, goal.radius),
            world.path if world.path is not None and is_empty else (),
            *(make_motions([world.movers]) if world.movers else ()),
        ]
    )


def hash_numbers(parts: Sequence[Any]) -> bytes:
    """Hash numbers and their shapes, rounded to micrometres.

    Sums of floats differ in the last digits between machines.
    """
    digest = hashlib.sha256()
    for numbers in parts:
        rounded = np.rint(np.asarray(numbers, np.float64) * 1e6).astype("<i8")
        digest.update(repr(rounded.shape).encode() + rounded.tobytes())
    return digest.digest()


def _describe_env(env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """Describe the env by its spec, values that JSON can't hold by their repr()."""
    spec = env.spec
    kwargs = {} if spec is None else spec.kwargs
    shown = {name: value for name, value in kwargs.items() if name not in HIDDEN_ARGUMENTS}
    return {
        "id": spec and spec.id,
        "kwargs": replace_nonfinite(json.loads(json.dumps(shown, default=repr))),
        "max_episode_steps": spec and spec.max_episode_steps,
    }


def _describe_worlds(pool: Pool | None) -> dict[str, Any]:
    """Describe the worlds. The hash changes if any of them does."""
    if pool is None:
        return {"sets": "none", "difficulty": None, "radius": None, "sha256": None}
    about = {
        "sets": str(pool),
        "difficulty": [worlds.difficulty for worlds in pool.sets],
        "radius": pool.radius,
    }

    # Worlds of this package depend on its sources. Others may come from anywhere.
    contents = [fingerprint()]
    if not all(worlds.generator in BUILT_IN_KINDS for worlds in pool.sets):
        contents += [hash_world(world).hex() for world in pool]
    text = json.dumps([about, contents])
    return about | {"sha256": hashlib.sha256(text.encode()).hexdigest()}
