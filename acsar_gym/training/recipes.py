"""Recipes: hyperparameters by env in RL Zoo's YAML format, one file for each algorithm.

All of a recipe are plain values: no code in it is run, and of classes only those are imported that
`classes` lists, or that are of modules that the user has named.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from acsar_gym.errors import ConfigError, shown, suggestion
from acsar_gym.policies.base import one_line
from acsar_gym.reading import bounded, structured
from acsar_gym.resources import AGENTS
from acsar_gym.training.algorithms import Algorithm
from acsar_gym.training.classes import (
    BATCH,
    IN_POLICY,
    NORMALIZE,
    check_class,
    find_class,
    find_classes,
)
from acsar_gym.worlds import names

if TYPE_CHECKING:  # imports torch
    from stable_baselines3.common.vec_env import VecEnv

MAX_BYTES = 1_000_000
DEFAULT = "default"
"""Key of the hyperparameters for envs that have none of their own."""
OWN = {"n_timesteps", "n_envs", "policy", "env_kwargs", "vec_env_wrapper"}
"""Keys of RL Zoo that `train` reads, besides the arguments of the algorithm."""
FOREIGN = {
    "callback",
    "env_wrapper",
    "frame_stack",
    "monitor_kwargs",
    "noise_std",
    "noise_type",
    "normalize",
    "replay_buffer_class",
}
"""Keys that only RL Zoo itself knows."""
KEYWORDS = ("env_kwargs", "policy_kwargs", "replay_buffer_kwargs")
"""Arguments by name, which RL Zoo also takes as Python code in a text."""
SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf")
FROM_OPTIONS = ("autoreset_mode", "defaults", "env_id", "num_envs", "robot", "task", "threads")
"""Arguments of an env that `train` gives, by its own options, and a recipe may not."""


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
    modules: tuple[str, ...] = ()
    """Modules of the user's own, whose classes the file may name."""

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
            kwargs = arguments.get("policy_kwargs") or {}
            arguments["policy_kwargs"] = {**kwargs, "net_arch": list(net)}
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
            ConfigError: a value can't be read, or a class may not be named or isn't there.
        """
        built = dict(self.arguments)
        for name in SCHEDULES:
            if isinstance(built.get(name), str):
                with self.named(name):
                    built[name] = _schedule(built[name])
        if isinstance(built.get("train_freq"), list):
            built["train_freq"] = tuple(built["train_freq"])
        if "policy_kwargs" in built:
            with self.named("policy_kwargs"):
                built["policy_kwargs"] = find_classes(built["policy_kwargs"] or {}, self.modules)
        built["policy"] = self.policy
        if "." in self.policy:
            with self.named():
                built["policy"] = find_class("policy", self.policy, self.modules)
        return built

    def check(self) -> None:
        """Check what the file names, before anything is imported.

        Raises:
            ConfigError: a class or module may not be named, or a wrapper's arguments are refused.
        """
        with self.named():
            if "." in self.policy:
                check_class("policy", self.policy, self.modules)
            for place in IN_POLICY:
                if (kind := (self.arguments.get("policy_kwargs") or {}).get(place)) is not None:
                    check_class(place, str(kind), self.modules)
            for name, given in self.wrappers.items():
                check_class("vec_env_wrapper", name, self.modules)
                if name == NORMALIZE and given.get("norm_obs") is not False:
                    raise ConfigError(
                        "VecNormalize: norm_obs must be false: policy files have no statistics"
                    )
            for name, value in self.env_kwargs.items():
                if name in FROM_OPTIONS:
                    raise ConfigError(f"env_kwargs: {name}: leave it out: train's options give it")
                _check_modules(name, value, self.modules)

    def wrapped(self, batch: VecEnv) -> VecEnv:
        """Return the batch in the recipe's wrappers.

        Raises:
            ConfigError: a wrapper may not be named, or doesn't take its arguments or the batch.
        """
        for name, given in self.wrappers.items():
            with self.named():
                try:
                    batch = find_class("vec_env_wrapper", name, self.modules)(batch, **given)
                except TypeError as error:
                    raise ConfigError(f"vec_env_wrapper: {name}: {one_line(error)}") from None
        return batch

    def named(self, *keys: str) -> contextlib.AbstractContextManager[None]:
        """Name file and keys in every ConfigError that is raised in this context."""
        return _named(": ".join([str(self.file), self.key, *keys]))


@contextlib.contextmanager
def _named(name: str) -> Iterator[None]:
    """Put a name in front of every ConfigError."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from None


def _schedule(text: str) -> Any:
    """Read "lin_VALUE", a number that falls linearly to zero over the training."""
    from stable_baselines3.common.utils import LinearSchedule  # noqa: PLC0415 - imports torch

    kind, _, value = text.partition("_")
    try:
        number = float(value) if kind == "lin" else math.nan
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ConfigError(f"{shown(text)}: must be a number, or like lin_0.001")
    return LinearSchedule(number, 0.0, 1.0)


def recipe(
    algorithm: Algorithm, env_id: str, file: Path | None = None, modules: Sequence[str] = ()
) -> Recipe:
    """Read the recipe of an env.

    Args:
        algorithm: the algorithm.
        env_id: id of the env, without its module.
        file: recipe file; default: the packaged one of the algorithm.
        modules: of the user's own, such as "mine.networks", whose classes the file may name.

    Raises:
        ConfigError: the file can't be read, has neither this env nor a default, or has unknown
            keys; the message names file and key.
    """
    path = file or AGENTS / "recipes" / f"{algorithm.name}.yml"
    recipes = content(path)
    key = env_id if env_id in recipes else DEFAULT
    if key not in recipes:
        raise ConfigError(f"{path}: has no recipe for {env_id}, and no {DEFAULT!r}")
    given = recipes[key]
    if not isinstance(given, dict):
        raise ConfigError(f"{path}: {key}: must be hyperparameters by name")
    _check_keys(path, key, given, algorithm)
    env_kwargs: dict[str, Any] = given.get("env_kwargs") or {}
    found = Recipe(
        path,
        key,
        _count(path, key, given, "n_timesteps"),
        _count(path, key, given, "n_envs"),
        str(given.get("policy", "MlpPolicy")),
        {name: value for name, value in given.items() if name not in OWN},
        {name: value for name, value in env_kwargs.items() if name != "link"},  # a batch has none
        _wrappers(path, key, given),
        tuple(modules),
    )
    found.check()
    return found


def content(path: Path) -> dict[str, Any]:
    """Read a YAML file that holds a mapping."""
    data = bounded.read(path, MAX_BYTES, ConfigError)
    with _named(str(path)):
        found = structured.from_yaml(structured.decoded(data))
    if not isinstance(found, dict):
        raise ConfigError(f"{path}: must be hyperparameters by env id")
    return found


CHECKED_TYPES: dict[Any, str] = {
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
        if name in KEYWORDS and not isinstance(value or {}, dict):
            raise ConfigError(
                f"{path}: {key}: {name}: {shown(value)}: must be arguments by name, as in "
                "{net_arch: [64, 64]}: a text isn't evaluated"
            )
        kinds = get_args(types.get(name)) or (types.get(name),)
        if set(kinds) <= set(CHECKED_TYPES) and not _fits(value, kinds):
            wanted = " or ".join(CHECKED_TYPES[kind] for kind in kinds)
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


def _check_modules(name: str, value: Any, modules: Sequence[str]) -> None:
    """Refuse what would import a module that the user hasn't named, such as "evil:Sonar"."""
    if isinstance(value, dict):
        value = [*value, *value.values()]
    if isinstance(value, list):
        for each in value:
            _check_modules(name, each, modules)
    elif isinstance(value, str):
        module = value.partition(":")[0] if ":" in value else ""
        if name == "worlds":  # may also be a path, or one of our generators: "clutter:0-99"
            generator = names.parsed(value)
            module = "" if generator is None else generator.module
        if module and module not in modules:
            raise ConfigError(
                f"env_kwargs: {name}: {shown(value)}: a recipe imports nothing: name the module "
                "with --modules"
            )


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
