"""Recipes: hyperparameters by env in RL Zoo's YAML format, one file for each algorithm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import yaml

from acsar_gym.errors import ConfigError, shown, suggestion
from acsar_gym.policies.base import one_line
from acsar_gym.reading import bounded
from acsar_gym.resources import AGENTS
from acsar_gym.training import expressions
from acsar_gym.training.algorithms import Algorithm

if TYPE_CHECKING:  # imports torch
    from stable_baselines3.common.vec_env import VecEnv

MAX_BYTES = 1_000_000
DEFAULT = "default"
"""Key of the hyperparameters for envs that have none of their own."""
OWN = {"n_timesteps", "n_envs", "policy", "env_kwargs", "vec_env_wrapper"}
"""Keys of RL Zoo that `train` reads, besides the arguments of the algorithm."""
BATCH = "acsar_gym.training.rl_zoo.batch"
"""The wrapper that makes a batch for RL Zoo; `train` makes it itself."""
FOREIGN = {
    "callback",
    "env_wrapper",
    "frame_stack",
    "monitor_kwargs",
    "noise_std",
    "noise_type",
    "normalize",
}
"""Keys that only RL Zoo itself knows."""
SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf")


@dataclass(frozen=True)
class Recipe:
    """Hyperparameters for one env and one algorithm."""

    file: Path
    key: str
    """The key in the file, for messages."""
    steps: int
    robots: int
    policy: str
    arguments: dict[str, Any] = field(default_factory=dict)
    """Arguments of the algorithm, as in the file."""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    """Arguments of the env, without the link."""
    wrappers: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Wrappers of the batch, with their arguments, in their order."""

    def with_(self, **changes: Any) -> Recipe:
        """Return a recipe with some hyperparameters changed; None leaves one as it is.

        Args:
            **changes: steps, robots, net (widths of the hidden layers), or any argument of the
                algorithm.
        """
        wanted = {name: value for name, value in changes.items() if value is not None}
        own = {name: wanted.pop(name) for name in ("steps", "robots") if name in wanted}
        net = wanted.pop("net", None)
        arguments = self.arguments | wanted
        if net is not None:
            arguments["policy_kwargs"] = _with_net(arguments.get("policy_kwargs") or {}, net)
        return replace(self, arguments=arguments, **own)

    def as_dict(self) -> dict[str, Any]:
        """Return the hyperparameters as a recipe file has them."""
        return {
            "n_timesteps": self.steps,
            "n_envs": self.robots,
            "policy": self.policy,
            "env_kwargs": self.env_kwargs | {"link": "planar"},
            "vec_env_wrapper": [BATCH, *({name: given} for name, given in self.wrappers.items())],
            **self.arguments,
        }

    def built(self) -> dict[str, Any]:
        """Return the arguments of the algorithm, with schedules and classes for their names.

        Raises:
            ConfigError: a value can't be read, or a class can't be imported.
        """
        built = dict(self.arguments)
        for name in SCHEDULES:
            if isinstance(built.get(name), str):
                with self.named(name):
                    built[name] = expressions.schedule(built[name])
        if isinstance(built.get("train_freq"), list):
            built["train_freq"] = tuple(built["train_freq"])
        for name in ("policy_kwargs", "replay_buffer_kwargs"):
            if name in built:
                with self.named(name):
                    built[name] = expressions.arguments(built[name])
        with self.named("policy"):
            built["policy"] = expressions.imported(self.policy)
        return built

    def wrapped(self, batch: VecEnv) -> VecEnv:
        """Return the batch in the recipe's wrappers.

        Raises:
            ConfigError: a wrapper can't be imported, or doesn't take its arguments or the batch.
        """
        for name, given in self.wrappers.items():
            with self.named("vec_env_wrapper"):
                try:
                    batch = expressions.imported(name)(batch, **given)
                except TypeError as error:
                    raise ConfigError(f"{name}: {one_line(error)}") from None
        return batch

    def named(self, key: str) -> expressions.Named:
        """Name file and key in every ConfigError that is raised in this context."""
        return expressions.Named(f"{self.file}: {self.key}: {key}")


def _with_net(policy_kwargs: Any, net: Sequence[int]) -> Any:
    """Change the widths of the layers; an expression becomes another one."""
    if isinstance(policy_kwargs, str):
        return f"dict({policy_kwargs}, net_arch={list(net)})"
    return {**policy_kwargs, "net_arch": list(net)}


def recipe(algorithm: Algorithm, env_id: str, file: Path | None = None) -> Recipe:
    """Read the recipe of an env.

    Args:
        algorithm: the algorithm.
        env_id: id of the env, without its module.
        file: recipe file; default: the packaged one of the algorithm.

    Raises:
        ConfigError: the file can't be read, has neither this env nor a default, or has unknown
            keys; the message names file and key.
    """
    path = file or AGENTS / "recipes" / f"{algorithm.name}.yml"
    found = content(path)
    key = env_id if env_id in found else DEFAULT
    if key not in found:
        raise ConfigError(f"{path}: has no recipe for {env_id}, and no {DEFAULT!r}")
    given = found[key]
    if not isinstance(given, dict):
        raise ConfigError(f"{path}: {key}: must be hyperparameters by name")
    _check_keys(path, key, given, algorithm)
    known = OWN | {"replay_buffer_class"}
    return Recipe(
        path,
        key,
        _count(path, key, given, "n_timesteps"),
        _count(path, key, given, "n_envs"),
        str(given.get("policy", "MlpPolicy")),
        {name: value for name, value in given.items() if name not in known},
        _env_kwargs(path, key, given),
        _wrappers(path, key, given),
    )


def content(path: Path) -> dict[Any, Any]:
    """Read a YAML file that holds a mapping."""
    data = bounded.read(path, MAX_BYTES, ConfigError)
    try:
        found = yaml.safe_load(data)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not YAML: {' '.join(str(error).split())}") from None
    if not isinstance(found, dict):
        raise ConfigError(f"{path}: must be hyperparameters by env id")
    return found


PLAIN: dict[Any, str] = {
    float: "a number",
    int: "a whole number",
    bool: "true or false",
    str: "a word",
    type(None): "null",
}
"""Types of hyperparameters that are checked, in the words of messages; algorithms that get another
one fail only in the middle of a training."""


def _check_keys(path: Path, key: str, given: dict[Any, Any], algorithm: Algorithm) -> None:
    """Refuse hyperparameters that the algorithm doesn't have, and those of a wrong type."""
    types = algorithm.types()
    known = OWN | set(types)
    for name, value in given.items():
        if name in FOREIGN:
            raise ConfigError(f"{path}: {key}: {name}: only rl_zoo3 knows it; remove it to train")
        if name not in known:
            hint = suggestion(str(name), known)
            raise ConfigError(
                f"{path}: {key}: {shown(name)}: not a hyperparameter of {algorithm.name}{hint}"
            )
        kinds = get_args(types.get(name)) or (types.get(name),)
        if set(kinds) <= set(PLAIN) and not _fits(value, kinds):
            wanted = " or ".join(PLAIN[kind] for kind in kinds)
            raise ConfigError(f"{path}: {key}: {name}: {shown(value)}: must be {wanted}")


def _fits(value: Any, kinds: Sequence[type]) -> bool:
    """Whether a value is of one of these types; a whole number is a number, true is none."""
    return any(type(value) is kind or (kind is float and type(value) is int) for kind in kinds)


def _count(path: Path, key: str, given: dict[Any, Any], name: str) -> int:
    """Read a whole number of at least 1; RL Zoo's files have floats such as 1e6, too."""
    value = given.get(name)
    try:
        number = int(float(value)) if isinstance(value, int | float | str) else 0
    except (ValueError, OverflowError):
        number = 0
    if number < 1:
        raise ConfigError(f"{path}: {key}: {name}: {shown(value)}: must be a number of at least 1")
    return number


def _env_kwargs(path: Path, key: str, given: dict[Any, Any]) -> dict[str, Any]:
    """Read the arguments of the env; a batch has no link."""
    with expressions.Named(f"{path}: {key}: env_kwargs"):
        found = expressions.arguments(given.get("env_kwargs") or {})
    return {name: value for name, value in found.items() if name != "link"}


def _wrappers(path: Path, key: str, given: dict[Any, Any]) -> dict[str, dict[str, Any]]:
    """Read the wrappers: a name, or a list of names and of `{name: arguments}`, as in RL Zoo."""
    asked = given.get("vec_env_wrapper") or []
    found: dict[str, dict[str, Any]] = {}
    for one in asked if isinstance(asked, list) else [asked]:
        pairs = list(one.items()) if isinstance(one, dict) else [(one, {})]
        name, arguments = pairs[0] if len(pairs) == 1 else (None, None)
        if not isinstance(name, str) or not isinstance(arguments, dict) or name in found:
            raise ConfigError(
                f"{path}: {key}: vec_env_wrapper: {shown(one)}: must be module.name, or that with "
                "its arguments, and only once"
            )
        if one != BATCH:
            found[name] = arguments
    return found
