"""Recipes: hyperparameters by env in RL Zoo's YAML format, one file for each algorithm.

All of a recipe are plain values: no code in it is run, and of classes only those are imported that
`KNOWN_CLASSES` lists, or that are of modules that the user has named.
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import inspect
import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin

from pydantic import BeforeValidator, ConfigDict, Field, create_model

from acsar_gym import reading
from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError, format_error, require_extra, show_value, suggest_name
from acsar_gym.resources import AGENTS
from acsar_gym.worlds import registry

if TYPE_CHECKING:  # imports torch
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv

BATCH_WRAPPER = "acsar_gym.tools.training.wrappers.batch"
"""The wrapper that makes a batch for RL Zoo; `train` makes it itself."""
NORMALIZE_WRAPPER = "stable_baselines3.common.vec_env.VecNormalize"
KNOWN_CLASSES: Mapping[str, tuple[str, ...]] = {
    "policy": ("acsar_gym.tools.training.networks.MirrorPolicy",),
    "vec_env_wrapper": (
        BATCH_WRAPPER,
        "acsar_gym.tools.training.wrappers.without_rays",
        NORMALIZE_WRAPPER,
    ),
    "features_extractor_class": ("stable_baselines3.common.torch_layers.FlattenExtractor",),
    "activation_fn": ("torch.nn",),
    "optimizer_class": ("torch.optim",),
}
"""Classes, or modules of them, that each place of a recipe may name: nothing that writes files or
takes code."""
POLICY_PLACES = ("activation_fn", "features_extractor_class", "optimizer_class")
"""The places in policy_kwargs."""
MAX_RECIPE_BYTES = 1_000_000
DEFAULT_KEY = "default"
"""Key of the hyperparameters for envs that have none of their own."""
RL_ZOO_KEYS = {
    "callback",
    "env_wrapper",
    "frame_stack",
    "monitor_kwargs",
    "noise_std",
    "noise_type",
    "replay_buffer_class",
}
"""Keys that only RL Zoo itself knows."""
TEXT_KEYS = ("policy_kwargs", "normalize", "replay_buffer_kwargs")
"""Keys whose texts RL Zoo evaluates as Python; here `parse_text` reads them."""
NOTE_OF_NORMALIZE = "normalize: observations aren't normalized: a task scales its own"
DEFAULT_GAMMA = 0.99
"""Discount factor of every algorithm where a recipe gives none."""
SCHEDULE_KEYS = ("learning_rate", "clip_range", "clip_range_vf")
OPTION_ARGUMENTS = ("autoreset_mode", "defaults", "env_id", "num_envs", "robot", "task", "threads")
"""Arguments of an env that `train` gives, by its own options, and a recipe may not."""
TRAIN_ARGUMENTS = {"self", "policy", "env", "seed", "device", "verbose", "tensorboard_log"}
"""Arguments of an algorithm that a recipe doesn't give: `train` does."""


@dataclass(frozen=True)
class Algorithm:
    """One algorithm of stable-baselines3 or sb3-contrib."""

    name: str
    """As RL Zoo names it."""
    module: str
    kind: str
    """Name of its class."""

    def load(self) -> type[BaseAlgorithm]:
        """Import its class."""
        with require_extra(f"training with {self.name}", "train"):
            kind: type[BaseAlgorithm] = getattr(importlib.import_module(self.module), self.kind)
        return kind


ALGORITHMS = {
    "ppo": Algorithm("ppo", "stable_baselines3", "PPO"),
    "sac": Algorithm("sac", "stable_baselines3", "SAC"),
    "tqc": Algorithm("tqc", "sb3_contrib", "TQC"),
    "ppo_lstm": Algorithm("ppo_lstm", "sb3_contrib", "RecurrentPPO"),
}


def find_algorithm(name: str) -> Algorithm:
    """Find an algorithm by its name."""
    if name not in ALGORITHMS:
        raise ConfigError(f"--algo {name}: unknown{suggest_name(name, ALGORITHMS)}")
    return ALGORITHMS[name]


def check_class(place: str, name: str, modules: Collection[str] = ()) -> None:
    """Check that a recipe may name a class. Imports nothing."""
    allowed, module = KNOWN_CLASSES[place], name.rpartition(".")[0]
    if name not in allowed and module not in allowed and module not in modules:
        raise ConfigError(
            f"{place}: {show_value(name)}: not a class that recipes may name"
            f"{suggest_name(name[:100], allowed)}; a module of your own is named with "
            "--modules"
        )


def find_class(place: str, name: str, modules: Collection[str] = ()) -> Any:
    """Import a class that `check_class` accepts; a module in the current folder is found, too."""
    check_class(place, name, modules)
    module, _, kind = name.rpartition(".")
    try:
        with reading.find_modules_here():
            return getattr(importlib.import_module(module), kind)
    except (Exception, SystemExit) as error:
        raise ConfigError(f"{place}: {name}: can't be imported: {format_error(error)}") from error


def find_classes(policy_kwargs: Mapping[str, Any], modules: Collection[str] = ()) -> dict[str, Any]:
    """Return the arguments of a policy with classes for their names; see `find_class`."""
    return {
        place: find_class(place, value, modules)
        if place in POLICY_PLACES and isinstance(value, str)
        else value
        for place, value in policy_kwargs.items()
    }


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
    note: str = ""
    """What of the file isn't done, for people."""

    def with_changes(self, **changes: Any) -> Recipe:
        """Return a recipe with some hyperparameters changed; None leaves one as it is."""
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
        wrappers = [{name: given} for name, given in self.wrappers.items()]
        return {
            "n_timesteps": self.steps,
            "n_envs": self.robots,
            "policy": self.policy,
            "env_kwargs": self.env_kwargs | {"link": "planar"},
            "vec_env_wrapper": [BATCH_WRAPPER, *wrappers],
            **self.arguments,
        }

    def build_arguments(self) -> dict[str, Any]:
        """Return the arguments of the algorithm, with schedules and classes for their names."""
        from stable_baselines3.common.utils import LinearSchedule  # noqa: PLC0415 - imports torch

        built = dict(self.arguments)
        for name in SCHEDULE_KEYS:
            if isinstance(text := built.get(name), str):
                try:
                    number = float(text.removeprefix("lin_")) if text[:4] == "lin_" else math.nan
                except ValueError:
                    number = math.nan
                if not math.isfinite(number):
                    said = f"{show_value(text)}: must be a number, or like lin_0.001"
                    raise ConfigError(f"{self.file}: {self.key}: {name}: {said}")
                built[name] = LinearSchedule(number, 0.0, 1.0)
        if isinstance(built.get("train_freq"), list):
            built["train_freq"] = tuple(built["train_freq"])
        with name_errors(self.file, self.key):
            if "policy_kwargs" in built:
                built["policy_kwargs"] = find_classes(built["policy_kwargs"] or {}, self.modules)
            built["policy"] = self.policy
            if "." in self.policy:
                built["policy"] = find_class("policy", self.policy, self.modules)
        return built

    def steps_per_update(self, algorithm: Algorithm) -> int | None:
        """Return the env steps of one robot between two updates; None where it counts episodes."""
        defaults = inspect.signature(algorithm.load().__init__).parameters
        name = "n_steps" if "n_epochs" in defaults else "train_freq"
        given = self.arguments.get(name, defaults[name].default)
        number, unit = given if isinstance(given, list | tuple) else (given, "step")
        return int(number) if unit == "step" else None

    def check_names(self) -> None:
        """Check what the file names, before anything is imported."""
        if "." in self.policy:
            check_class("policy", self.policy, self.modules)
        for place in POLICY_PLACES:
            if (kind := (self.arguments.get("policy_kwargs") or {}).get(place)) is not None:
                check_class(place, str(kind), self.modules)
                if str(kind).startswith("torch."):
                    find_class(place, str(kind))
        for name, given in self.wrappers.items():
            check_class("vec_env_wrapper", name, self.modules)
            if name == NORMALIZE_WRAPPER and given.get("norm_obs") is not False:
                raise ConfigError(
                    "VecNormalize: norm_obs must be false: policy files have no statistics"
                )
        for name, value in self.env_kwargs.items():
            if name in OPTION_ARGUMENTS:
                raise ConfigError(f"env_kwargs: {name}: leave it out: train's options give it")
            _check_modules(name, value, self.modules)

    def wrap_batch(self, batch: VecEnv) -> VecEnv:
        """Return the batch in the recipe's wrappers."""
        with name_errors(self.file, self.key):
            for name, given in self.wrappers.items():
                try:
                    batch = find_class("vec_env_wrapper", name, self.modules)(batch, **given)
                except TypeError as error:
                    said = format_error(error)
                    raise ConfigError(f"vec_env_wrapper: {name}: {said}") from error
        return batch


@contextlib.contextmanager
def name_errors(*names: object) -> Iterator[None]:
    """Put file and keys in front of every ConfigError that is raised in this context."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(": ".join([*map(str, names), str(error)])) from error


def read_recipe(
    algorithm: Algorithm,
    env_id: str,
    file: Path | None = None,
    modules: Sequence[str] = (),
    entry: str | None = None,
) -> Recipe:
    """Read the recipe of an env."""
    path = file or AGENTS / "recipes" / f"{algorithm.name}.yml"
    data = reading.read_file(path, MAX_RECIPE_BYTES, ConfigError)
    names = (env_id, DEFAULT_KEY) if entry is None else (entry,)
    with name_errors(path):
        entries = reading.parse_yaml(reading.decode_text(data), aliases=True)
        if not isinstance(entries, dict):
            raise ConfigError("must be values by name")
        key = next((name for name in names if name in entries), None)
        if key is None:
            missing = " and no ".join(map(show_value, names))
            similar = suggest_name(names[0], map(str, entries))[:120].removesuffix("?")
            raise ConfigError(f"has no {missing}{similar}: name one with --conf-entry")
        given = entries[key]
    with name_errors(path, key):
        if not isinstance(given, dict):
            raise ConfigError("must be hyperparameters by name")
        note = NOTE_OF_NORMALIZE if given.get("normalize") else ""
        given = _evaluate_texts(given)
        foreign = RL_ZOO_KEYS & set(given)
        if foreign:
            raise ConfigError(f"{min(foreign)}: only rl_zoo3 knows it; remove it to train")
        values = _recipe_model(algorithm).model_validate(given)
        recipe = Recipe(
            path,
            key,
            values.n_timesteps,
            values.n_envs,
            values.policy,
            {name: one for name, one in given.items() if name not in RecipeValues.model_fields},
            {name: one for name, one in values.env_kwargs.items() if name != "link"},
            values.vec_env_wrapper,
            tuple(modules),
            note,
        )
        recipe.check_names()
    return recipe


def _evaluate_texts(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return hyperparameters with values for RL Zoo's texts, and VecNormalize for `normalize`."""
    values = dict(given)
    for name in TEXT_KEYS:
        if isinstance(values.get(name), str):
            with name_errors(name):
                values[name] = parse_text(values[name])
    kwargs = values.get("policy_kwargs")
    net = kwargs.get("net_arch") if isinstance(kwargs, dict) else None
    if kwargs and isinstance(net, list) and len(net) == 1 and isinstance(net[0], dict):
        values["policy_kwargs"] = {**kwargs, "net_arch": net[0]}  # as stable-baselines3 1.x had it
    if (normalize := values.pop("normalize", False)) is not False:
        normalize = {} if normalize is True else normalize
        if not isinstance(normalize, dict):
            raise ConfigError(f"normalize: {show_value(normalize)}: must be true, false or a dict")
        if normalize.get("norm_reward", True):
            rewards = (
                {"gamma": values.get("gamma", DEFAULT_GAMMA)} | normalize | {"norm_obs": False}
            )
            wrappers = values.get("vec_env_wrapper") or []
            wrappers = wrappers if isinstance(wrappers, list) else [wrappers]
            values["vec_env_wrapper"] = [*wrappers, {NORMALIZE_WRAPPER: rewards}]
    return values


class _Names(ast.NodeTransformer):
    """Replaces dict(...) by {...}, and names of classes by texts, for `ast.literal_eval`."""

    def visit_Call(self, node: ast.Call) -> ast.AST:
        named = not node.args and all(part.arg for part in node.keywords)
        if not (isinstance(node.func, ast.Name) and node.func.id == "dict" and named):
            return node
        keys: list[ast.expr | None] = [ast.Constant(part.arg) for part in node.keywords]
        return ast.Dict(keys, [self.visit(part.value) for part in node.keywords])

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        return ast.Constant(re.sub(r"^(th|torch)\.|^(?=nn\.)", "torch.", ast.unparse(node)))


def parse_text(text: str) -> Any:
    """Read a Python value such as "dict(net_arch=[64], activation_fn=nn.ReLU)"; runs no code."""
    try:
        return ast.literal_eval(_Names().visit(ast.parse(text.strip(), mode="eval")))
    except (SyntaxError, ValueError, TypeError, MemoryError, RecursionError) as error:
        raise ConfigError(
            f"{show_value(text)}: must be values and dict(...) of them, and classes such as nn.ReLU"
        ) from error


def _parse_wrappers(asked: Any) -> dict[str, dict[str, Any]]:
    """Read the wrappers: a name, or a list of names and of `{name: arguments}`, as in RL Zoo."""
    found: dict[str, dict[str, Any]] = {}
    for one in asked if isinstance(asked, list) else [asked or {}]:
        pairs = list(one.items()) if isinstance(one, dict) else [(one, {})]
        for name, arguments in pairs:
            if not isinstance(name, str) or not isinstance(arguments, dict) or name in found:
                raise ValueError(
                    f"{show_value(name)} must be module.name, or that with its arguments, and "
                    "only once"
                )
            found[name] = arguments
    found.pop(BATCH_WRAPPER, None)
    return found


Count = Annotated[
    int,  # RL Zoo's files have floats such as 1e6, too, which YAML reads as a text
    BeforeValidator(lambda value: float(value) if isinstance(value, str) else value),
    Field(ge=1, strict=False),
]


Wrappers = Annotated[dict[str, dict[str, Any]], BeforeValidator(_parse_wrappers)]


class RecipeValues(Section):
    """What `train` reads of a recipe, besides the arguments of the algorithm."""

    model_config = ConfigDict(strict=True)
    n_timesteps: Count
    n_envs: Count = 1
    policy: str = "MlpPolicy"
    env_kwargs: Annotated[dict[str, Any], BeforeValidator(lambda value: value or {})] = Field({})
    vec_env_wrapper: Wrappers = Field({})


def _recipe_model(algorithm: Algorithm) -> type[RecipeValues]:
    """Make the model of a recipe, with the algorithm's own arguments and the types of plain ones.

    Algorithms that get a value of another type fail only in the middle of a training.
    """
    fields: dict[str, Any] = {}
    for name, one in inspect.signature(algorithm.load().__init__).parameters.items():
        if name not in TRAIN_ARGUMENTS and name[0] != "_":
            kinds = get_args(one.annotation) or (one.annotation,)
            plain = (float, int, bool, str, type(None))
            known = all(kind in plain or get_origin(kind) is dict for kind in kinds)
            fields[name] = (one.annotation if known else Any, None)
    return create_model(algorithm.name, __base__=RecipeValues, **fields)


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
            generator = registry.parse_name(value)
            module = "" if generator is None else generator.module
        if module and module not in modules:
            raise ConfigError(
                f"env_kwargs: {name}: {show_value(value)}: a recipe imports nothing: name the "
                "module with --modules"
            )
