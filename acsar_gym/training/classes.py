"""Classes that a recipe names: those listed here, and those of modules that the user has named."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Collection, Mapping
from typing import Any

from acsar_gym.errors import ConfigError, shortened, shown, suggestion

BATCH = "acsar_gym.training.rl_zoo.batch"
"""The wrapper that makes a batch for RL Zoo; `train` makes it itself."""
NORMALIZE = "stable_baselines3.common.vec_env.VecNormalize"
ACTIVATIONS = (
    *("CELU", "ELU", "GELU", "Hardswish", "Hardtanh", "Identity", "LeakyReLU", "Mish", "ReLU"),
    *("ReLU6", "SELU", "SiLU", "Sigmoid", "Softplus", "Softsign", "Tanh"),
)
KNOWN: Mapping[str, tuple[str, ...]] = {
    "policy": ("acsar_gym.training.mirrored.MirrorPolicy",),
    "vec_env_wrapper": (
        BATCH,
        "acsar_gym.training.shaping.Detours",
        "acsar_gym.training.shaping.detours",
        NORMALIZE,
    ),
    "activation_fn": tuple(f"torch.nn.{name}" for name in ACTIVATIONS),
    "features_extractor_class": (
        "acsar_gym.training.networks.ArcClearance",
        "acsar_gym.training.networks.RayClearance",
        "stable_baselines3.common.torch_layers.FlattenExtractor",
    ),
    "optimizer_class": tuple(f"torch.optim.{name}" for name in ("Adam", "AdamW", "RMSprop", "SGD")),
}
"""What may be named at each place of a recipe: nothing that writes files or takes code."""
IN_POLICY = ("activation_fn", "features_extractor_class", "optimizer_class")
"""The places in policy_kwargs."""


def check_class(place: str, name: str, modules: Collection[str] = ()) -> None:
    """Check that a recipe may name a class. Imports nothing.

    Args:
        place: where it is named, one of `KNOWN`.
        name: such as "torch.nn.ReLU".
        modules: of the user's own, such as "mine.networks", whose classes may be named, too.

    Raises:
        ConfigError: it may not.
    """
    if name not in KNOWN[place] and name.rpartition(".")[0] not in modules:
        raise ConfigError(
            f"{place}: {shown(name)}: not a class that recipes may name"
            f"{suggestion(shortened(name), KNOWN[place])}; a module of your own is named with "
            "--modules"
        )


def find_class(place: str, name: str, modules: Collection[str] = ()) -> Any:
    """Import a class that `check_class` accepts; a module in the current folder is found, too.

    Args:
        place: as of `check_class`.
        name: as of `check_class`.
        modules: as of `check_class`.

    Raises:
        ConfigError: a recipe may not name it, or it can't be imported.
    """
    check_class(place, name, modules)
    module, _, kind = name.rpartition(".")
    if name not in KNOWN[place] and "" not in sys.path:
        sys.path.append("")
    try:
        return getattr(importlib.import_module(module), kind)
    except (Exception, SystemExit) as error:  # noqa: BLE001 - whatever a user's module raises
        said = shortened(" ".join(f"{type(error).__name__}: {error}".split()), 300)
        raise ConfigError(f"{place}: {name}: can't be imported: {said}") from None


def find_classes(policy_kwargs: Mapping[str, Any], modules: Collection[str] = ()) -> dict[str, Any]:
    """Return the arguments of a policy with classes for their names; see `find_class`."""
    found = dict(policy_kwargs)
    for place in IN_POLICY:
        if isinstance(found.get(place), str):
            found[place] = find_class(place, found[place], modules)
    return found
