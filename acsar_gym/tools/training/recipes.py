"""Recipes: hyperparameters by env in YAML, one file for each algorithm, which RL Zoo reads as well.

The keys are stable-baselines3's own, and `n_timesteps`, `n_envs`, `env_kwargs` and
`vec_env_wrapper` as in RL Zoo. A recipe runs no code: only those classes are imported that
`CLASSES` and `CLASS_MODULES` list, or that are in the package of the env.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_origin

from pydantic import ConfigDict, create_model

from acsar_gym import reading
from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError, format_error, require_extra, show_value
from acsar_gym.resources import AGENTS
from acsar_gym.tools.training.options import ALGORITHMS, parse_count
from acsar_gym.worlds.registry import BUILT_IN_KINDS

if TYPE_CHECKING:  # imports torch
    from stable_baselines3.common.base_class import BaseAlgorithm

BATCH_WRAPPER = "acsar_gym.tools.training.wrappers.batch"
"""The wrapper that makes a batch for RL Zoo. `train` makes the batch itself."""
CLASSES = (
    "acsar_gym.tools.training.networks.MirrorPolicy",
    "acsar_gym.tools.training.wrappers.without_rays",
)
CLASS_MODULES = ("torch.nn", "torch.optim")
MAX_RECIPE_BYTES = 1_000_000
DEFAULT_KEY = "default"
"""Key of the hyperparameters for envs that have none of their own."""
OPTION_ARGUMENTS = ("autoreset_mode", "defaults", "env_id", "num_envs", "robot", "task", "threads")
"""Arguments of an env that `train` sets by its own options."""
OPTION_KEYS = ("env", "seed", "device", "tensorboard_log")
"""Arguments of an algorithm that `train` sets."""
PLAIN_TYPES = (float, int, bool, str, type(None))
"""Types of an algorithm's arguments that YAML has."""
OWN_KEYS = ("n_timesteps", "n_envs", "policy", "env_kwargs", "vec_env_wrapper")
"""Keys that aren't arguments of the algorithm."""


def load_algorithm(name: str) -> type[BaseAlgorithm]:
    """Import the class of an algorithm."""
    module, kind = ALGORITHMS[name]
    with require_extra(f"training with {name}", "train"):
        algorithm: type[BaseAlgorithm] = getattr(importlib.import_module(module), kind)
    return algorithm


@dataclass(frozen=True)
class Recipe:
    """Hyperparameters for one env and one algorithm."""

    place: str
    """File and key, for messages."""
    values: dict[str, Any]
    """The hyperparameters by their keys in the file."""
    package: str = ""
    """Package of the env, whose classes the file may name."""

    @property
    def steps(self) -> int:
        """Env steps of the training."""
        return int(self.values["n_timesteps"])

    @property
    def robots(self) -> int:
        """Robots that are stepped together."""
        return int(self.values["n_envs"])

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """Arguments of the env, without the link."""
        kwargs = self.values.get("env_kwargs") or {}
        return {name: value for name, value in kwargs.items() if name != "link"}

    def count_rollout_steps(self, algo: str) -> int:
        """Return the steps of a robot between two updates. 1 if the recipe counts episodes."""
        parameters = inspect.signature(load_algorithm(algo)).parameters
        name = "n_steps" if "n_epochs" in parameters else "train_freq"
        value = self.values.get(name, parameters[name].default)
        number, unit = value if isinstance(value, list | tuple) else (value, "step")
        return max(int(number), 1) if unit == "step" else 1

    def with_changes(self, **changes: Any) -> Recipe:
        """Return a recipe with some hyperparameters changed. None changes nothing."""
        changes = {name: value for name, value in changes.items() if value is not None}
        # The width of the layers is one of several arguments of the policy.
        if "net" in changes:
            net = {"net_arch": list(changes.pop("net"))}
            changes["policy_kwargs"] = (self.values.get("policy_kwargs") or {}) | net
        return replace(self, values=self.values | changes)

    def build_arguments(self) -> dict[str, Any]:
        """Return the arguments of the algorithm, with schedules and classes for their names."""
        arguments = {
            name: parse_schedule(value) if str(value).startswith("lin_") else value
            for name, value in self.values.items()
            if name not in OWN_KEYS
        }
        # Only these may name classes.
        policy = {"policy": self.values.get("policy", "MlpPolicy")}
        arguments |= import_classes(policy, self.package)
        policy_kwargs = arguments.get("policy_kwargs") or {}
        arguments["policy_kwargs"] = import_classes(policy_kwargs, self.package)
        if isinstance(arguments.get("train_freq"), list):  # YAML has no tuples
            arguments["train_freq"] = tuple(arguments["train_freq"])

        # A minibatch can't be larger than a rollout, which is smaller with fewer robots.
        rollout = arguments.get("n_steps", 0) * self.robots
        if rollout and "batch_size" in arguments:
            arguments["batch_size"] = min(arguments["batch_size"], rollout)
        return arguments

    def import_wrappers(self) -> list[Any]:
        """Return the functions that wrap the batch."""
        # RL Zoo takes a name, {name: arguments}, or a list of both.
        items = self.values.get("vec_env_wrapper") or []
        wrappers = []
        for item in items if isinstance(items, list) else [items]:
            pairs = item.items() if isinstance(item, dict) else [(item, {})]
            for name, arguments in pairs:
                if name != BATCH_WRAPPER:
                    wrapper = import_class("vec_env_wrapper", str(name), self.package)
                    wrappers.append(partial(wrapper, **(arguments or {})))
        return wrappers

    def check(self, algo: str) -> None:
        """Check keys and values, and import the classes that are allowed.

        Raises:
            ConfigError: The algorithm has no such argument, or a value can't be used.
        """
        algorithm = load_algorithm(algo)
        check_types(algorithm, self.values)
        for name, value in self.env_kwargs.items():
            if name in OPTION_ARGUMENTS:
                raise ConfigError(f"env_kwargs: {name}: leave it out: train's options set it")
            _check_modules(f"env_kwargs: {name}", value, self.package)
        # These import classes, and find out what the algorithm doesn't take, before any is made.
        self.import_wrappers()
        arguments = self.build_arguments()
        options = dict.fromkeys(OPTION_KEYS)
        if twice := options.keys() & self.values.keys():
            raise ConfigError(f"{min(twice)}: leave it out: train's options set it")
        inspect.signature(algorithm).bind(**options, **arguments)


class _Values(Section):
    """Values of a recipe, with their types."""

    model_config = ConfigDict(strict=True)
    policy: str = ""
    env_kwargs: dict[str, Any] | None = None


def check_types(algorithm: type[BaseAlgorithm], values: Mapping[str, Any]) -> None:
    """Raise ConfigError for a value of another type than an algorithm takes.

    Algorithms that get one fail only in the middle of a training.
    """
    # Schedules and classes have texts in a recipe, so only plain types are checked.
    types: dict[str, Any] = {}
    for name, parameter in inspect.signature(algorithm).parameters.items():
        kinds = get_args(parameter.annotation) or (parameter.annotation,)
        if all(kind in PLAIN_TYPES or get_origin(kind) is dict for kind in kinds):
            types[name] = (parameter.annotation, None)

    checked = {*types, *_Values.model_fields}
    model = create_model(algorithm.__name__, __base__=_Values, **types)
    model.model_validate({name: value for name, value in values.items() if name in checked})


def read_recipe(algo: str, env_id: str, file: Path | None = None, package: str = "") -> Recipe:
    """Read the recipe of an env.

    Args:
        algo: Name of the algorithm.
        env_id: Id of the env, without a module.
        file: The file. Default: agents/recipes/ALGO.yml.
        package: Package of the env, whose classes the file may name.

    Raises:
        ConfigError: The file can't be used. The message names file and key.
    """
    path = file or AGENTS / "recipes" / f"{algo}.yml"
    with reading.name_errors(path):
        text = reading.decode_text(reading.read_content(path, MAX_RECIPE_BYTES))
        entries = reading.parse_yaml(text)
        if not isinstance(entries, dict) or not {env_id, DEFAULT_KEY} & set(entries):
            raise ConfigError(f"has no {show_value(env_id)} and no '{DEFAULT_KEY}'")

    key = env_id if env_id in entries else DEFAULT_KEY
    with reading.name_errors(path, key):
        if not isinstance(entries[key], dict):
            raise ConfigError("must be hyperparameters by name")
        values = {"n_envs": 1, **entries[key]}
        # YAML reads 1e6 as a float.
        for name in ("n_timesteps", "n_envs"):
            with reading.name_errors(name):
                values[name] = parse_count(str(values.get(name)))
                if values[name] < 1:
                    raise ValueError("must be at least 1")
        recipe = Recipe(f"{path}: {key}", values, package)
        recipe.check(algo)
    return recipe


def import_class(key: str, name: str, package: str = "") -> Any:
    """Import a class that a recipe may name, also from the current folder.

    Raises:
        ConfigError: A recipe may not name it, or it can't be imported.
    """
    # Importing a module runs it, so a recipe of a stranger may import only what is listed.
    module, _, kind = name.rpartition(".")
    is_own = package and module.partition(".")[0] == package.partition(".")[0]
    if not (name in CLASSES or module in CLASS_MODULES or is_own):
        raise ConfigError(
            f"{key}: {show_value(name)}: not a class that recipes may name: those are in "
            f"{', '.join((*CLASSES, *CLASS_MODULES))}, and in the package of --env"
        )

    try:
        with reading.find_modules_here():
            return getattr(importlib.import_module(module), kind)
    except (Exception, SystemExit) as error:
        raise ConfigError(f"{key}: {name}: can't be imported: {format_error(error)}") from error


def import_classes(values: Mapping[str, Any], package: str = "") -> dict[str, Any]:
    """Return arguments with classes for dotted names."""
    return {
        key: import_class(key, value, package) if isinstance(value, str) and "." in value else value
        for key, value in values.items()
    }


def parse_schedule(text: str) -> Any:
    """Return a schedule that falls linearly to zero, of a text such as "lin_0.001"."""
    from stable_baselines3.common.utils import LinearSchedule  # noqa: PLC0415 - imports torch

    return LinearSchedule(float(text.removeprefix("lin_")), 0.0, 1.0)


def _check_modules(key: str, value: Any, package: str) -> None:
    """Refuse what would import another package than the env's, such as "evil:Sonar"."""
    if isinstance(value, dict):
        value = [*value, *value.values()]
    if isinstance(value, list):
        for item in value:
            _check_modules(key, item, package)
        return

    module, colon, _ = str(value).partition(":")  # or a generator: "clutter:0-99", "clutter+6:test"
    allowed = (package.partition(".")[0], *BUILT_IN_KINDS)
    if colon and module.partition("+")[0].partition(".")[0] not in allowed:
        raise ConfigError(
            f"{key}: {show_value(value)}: a recipe imports nothing but the package of --env"
        )
