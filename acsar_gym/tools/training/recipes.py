"""Recipes: hyperparameters by env in YAML, one file for each algorithm, which RL Zoo reads as well.

The keys are stable-baselines3's own, and `n_timesteps`, `n_envs`, `env_kwargs` and
`vec_env_wrapper` as in RL Zoo. A recipe runs no code: of classes only those are imported that
`CLASSES` and `CLASS_MODULES` list, or that are in the package of the env.
"""

from __future__ import annotations

import contextlib
import importlib
import inspect
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acsar_gym import reading
from acsar_gym.errors import ConfigError, format_error, require_extra, show_value, suggest_name
from acsar_gym.resources import AGENTS
from acsar_gym.tools.training.options import ALGORITHMS, parse_count
from acsar_gym.worlds import registry

if TYPE_CHECKING:  # imports torch
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv

BATCH_WRAPPER = "acsar_gym.tools.training.wrappers.batch"
"""The wrapper that makes a batch for RL Zoo; `train` makes it itself."""
CLASSES = (
    "acsar_gym.tools.training.networks.MirrorPolicy",
    "acsar_gym.tools.training.wrappers.without_rays",
)
CLASS_MODULES = ("torch.nn", "torch.optim")
MAX_RECIPE_BYTES = 1_000_000
DEFAULT_KEY = "default"
"""Key of the hyperparameters for envs that have none of their own."""
SCHEDULE_KEYS = ("learning_rate", "clip_range", "clip_range_vf")
OPTION_ARGUMENTS = ("autoreset_mode", "defaults", "env_id", "num_envs", "robot", "task", "threads")
"""Arguments of an env that `train` sets by its own options."""
OWN_KEYS = ("n_timesteps", "n_envs", "policy", "env_kwargs", "vec_env_wrapper")
"""Keys that aren't arguments of the algorithm."""
TRAIN_ARGUMENTS = ("self", "policy", "env", "seed", "device", "verbose", "tensorboard_log")
"""Arguments of an algorithm that `train` sets."""


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
        return {k: v for k, v in (self.values.get("env_kwargs") or {}).items() if k != "link"}

    @property
    def wrappers(self) -> list[str]:
        """Wrappers of the batch, in their order."""
        names = self.values.get("vec_env_wrapper") or []
        names = names if isinstance(names, list) else [names]
        return [str(name) for name in names if name != BATCH_WRAPPER]

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments of the algorithm, as in the file."""
        return {name: value for name, value in self.values.items() if name not in OWN_KEYS}

    def with_changes(self, **changes: Any) -> Recipe:
        """Return a recipe with some hyperparameters changed; None leaves one as it is."""
        changes = {name: value for name, value in changes.items() if value is not None}
        net = changes.pop("net", None)
        if net is not None:
            kwargs = self.values.get("policy_kwargs") or {}
            changes["policy_kwargs"] = {**kwargs, "net_arch": list(net)}
        return replace(self, values=self.values | changes)

    def build_arguments(self) -> dict[str, Any]:
        """Return the arguments of the algorithm, with schedules and classes for their names."""
        built = dict(self.arguments)
        with name_errors(self.place):
            for name in SCHEDULE_KEYS:
                if isinstance(built.get(name), str):
                    built[name] = parse_schedule(name, built[name])
            if isinstance(built.get("train_freq"), list):
                built["train_freq"] = tuple(built["train_freq"])
            built["policy_kwargs"] = import_classes(built.get("policy_kwargs") or {}, self.package)
            policy = {"policy": str(self.values.get("policy", "MlpPolicy"))}
            built |= import_classes(policy, self.package)

        steps: Any = built.get("n_steps")
        size: Any = built.get("batch_size")
        if isinstance(steps, int) and isinstance(size, int):
            built["batch_size"] = min(size, steps * self.robots)
        return built

    def steps_per_update(self, algorithm: type[BaseAlgorithm]) -> int | None:
        """Return the env steps of one robot between two updates; None if it counts episodes."""
        defaults = inspect.signature(algorithm.__init__).parameters
        name = "n_steps" if "n_epochs" in defaults else "train_freq"
        value = self.arguments.get(name, defaults[name].default)
        number, unit = value if isinstance(value, list | tuple) else (value, "step")
        return int(number) if unit == "step" else None

    def wrap_batch(self, batch: VecEnv) -> VecEnv:
        """Return the batch in the recipe's wrappers."""
        with name_errors(self.place):
            for name in self.wrappers:
                batch = import_class("vec_env_wrapper", name, self.package)(batch)
        return batch


def read_recipe(algo: str, env_id: str, file: Path | None = None, package: str = "") -> Recipe:
    """Read the recipe of an env.

    Args:
        algo: Name of the algorithm.
        env_id: Id of the env, without a module.
        file: The file; default: agents/recipes/ALGO.yml.
        package: Package of the env, whose classes the file may name.

    Raises:
        ConfigError: The file can't be used; the message names file and key.
    """
    path = file or AGENTS / "recipes" / f"{algo}.yml"
    text = reading.decode_text(reading.read_file(path, MAX_RECIPE_BYTES, ConfigError))
    with name_errors(path):
        entries = reading.parse_yaml(text)
        keys = [
            key for key in (env_id, DEFAULT_KEY) if isinstance(entries, dict) and key in entries
        ]
        if not keys:
            raise ConfigError(f"has no {show_value(env_id)} and no '{DEFAULT_KEY}'")
    with name_errors(path, keys[0]):
        values = entries[keys[0]]
        if not isinstance(values, dict):
            raise ConfigError("must be hyperparameters by name")
        return _check_recipe(algo, values, f"{path}: {keys[0]}", package)


def _check_recipe(algo: str, values: dict[str, Any], place: str, package: str) -> Recipe:
    """Check the names of a recipe before anything is imported."""
    signature = inspect.signature(load_algorithm(algo).__init__).parameters
    names = [*OWN_KEYS, *(name for name in signature if name not in TRAIN_ARGUMENTS)]
    for name in values:
        if name not in names:
            raise ConfigError(
                f"{show_value(name)}: no argument of {algo}{suggest_name(name, names)}"
            )

    counts = {
        "n_timesteps": _read_count("n_timesteps", values.get("n_timesteps")),
        "n_envs": _read_count("n_envs", values.get("n_envs", 1)),
    }
    recipe = Recipe(place, values | counts, package)
    for name in recipe.wrappers:
        check_class("vec_env_wrapper", name, package)
    import_classes(recipe.arguments.get("policy_kwargs") or {}, package)
    if "." in (policy := str(values.get("policy"))):
        check_class("policy", policy, package)
    for name, value in recipe.env_kwargs.items():
        if name in OPTION_ARGUMENTS:
            raise ConfigError(f"env_kwargs: {name}: leave it out: train's options set it")
        _check_modules(name, value, package)
    return recipe


def _read_count(name: str, value: Any) -> int:
    """Read a whole number; YAML reads 1e6 as a text."""
    try:
        count = parse_count(str(value))
    except (ValueError, OverflowError):
        count = 0
    if count < 1:
        raise ConfigError(f"{name} = {show_value(value)}: must be a whole number of at least 1")
    return count


def parse_schedule(name: str, text: str) -> Any:
    """Return a schedule that falls linearly to zero, of a text such as "lin_0.001"."""
    from stable_baselines3.common.utils import LinearSchedule  # noqa: PLC0415 - imports torch

    try:
        return LinearSchedule(float(text.removeprefix("lin_")), 0.0, 1.0)
    except ValueError as error:
        problem = f"{show_value(text)}: must be a number, or like lin_0.001"
        raise ConfigError(f"{name}: {problem}") from error


def check_class(key: str, name: str, package: str = "") -> None:
    """Check that a recipe may name a class. Imports nothing."""
    module = name.rpartition(".")[0]
    is_own = package and module.partition(".")[0] == package.partition(".")[0]
    if not (name in CLASSES or module in CLASS_MODULES or is_own):
        raise ConfigError(
            f"{key}: {show_value(name)}: not a class that recipes may name: those are in "
            f"{', '.join((*CLASSES, *CLASS_MODULES))}, and in the package of --env"
        )


def import_class(key: str, name: str, package: str = "") -> Any:
    """Import a class that `check_class` accepts; also from the current folder."""
    check_class(key, name, package)
    module, _, kind = name.rpartition(".")
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


def _check_modules(key: str, value: Any, package: str) -> None:
    """Refuse what would import another package than the env's, such as "evil:Sonar"."""
    if isinstance(value, dict):
        value = [*value, *value.values()]
    if isinstance(value, list):
        for item in value:
            _check_modules(key, item, package)

    if isinstance(value, str):
        module = value.partition(":")[0] if ":" in value else ""
        if key == "worlds":  # may also be a path, or a generator of ours: "clutter:0-99"
            generator = registry.parse_name(value)
            module = "" if generator is None else generator.module
        if module and module.partition(".")[0] != package.partition(".")[0]:
            raise ConfigError(
                f"env_kwargs: {key}: {show_value(value)}: a recipe imports nothing but the package "
                "of --env"
            )


@contextlib.contextmanager
def name_errors(*names: object) -> Iterator[None]:
    """Put file and keys in front of every ConfigError that is raised in this context."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(": ".join([*map(str, names), str(error)])) from error
