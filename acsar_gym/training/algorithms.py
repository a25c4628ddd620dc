"""The algorithms that `train` knows, by RL Zoo's names; torch is imported when one is asked for."""

from __future__ import annotations

import importlib
import inspect
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from acsar_gym.errors import ConfigError, MissingExtraError, suggestion

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

OURS = {"self", "policy", "env", "seed", "device", "verbose", "tensorboard_log"}
"""Arguments of an algorithm that a recipe doesn't give: `train` does."""


@dataclass(frozen=True)
class Algorithm:
    """One algorithm of stable-baselines3 or sb3-contrib."""

    name: str
    """As RL Zoo names it."""
    module: str
    kind: str
    """Name of its class."""
    replays: bool = False
    """Whether it is off-policy, and so has a replay buffer."""

    def load(self) -> type[BaseAlgorithm]:
        """Import its class.

        Raises:
            MissingExtraError: its library isn't installed.
        """
        try:
            found: type[BaseAlgorithm] = getattr(importlib.import_module(self.module), self.kind)
        except ImportError:
            raise MissingExtraError(f"training with {self.name}", "train") from None
        return found

    def arguments(self) -> frozenset[str]:
        """Names of the hyperparameters that it takes."""
        given = inspect.signature(self.load().__init__).parameters
        return frozenset(name for name in given if name not in OURS and name[0] != "_")


ALGORITHMS = {
    each.name: each
    for each in (
        Algorithm("ppo", "stable_baselines3", "PPO"),
        Algorithm("sac", "stable_baselines3", "SAC", replays=True),
        Algorithm("tqc", "sb3_contrib", "TQC", replays=True),
        Algorithm("ppo_lstm", "sb3_contrib", "RecurrentPPO"),
    )
}


def algorithm(name: str) -> Algorithm:
    """Find an algorithm by its name.

    Raises:
        ConfigError: there is none of that name.
    """
    if name not in ALGORITHMS:
        raise ConfigError(f"--algo {name}: unknown{suggestion(name, ALGORITHMS)}")
    return ALGORITHMS[name]


def of_model(model: Any) -> Algorithm | None:
    """Find the algorithm of a model by its class; None where `train` doesn't know it."""
    kinds = {each.kind: each for each in ALGORITHMS.values()}
    return kinds.get(type(model).__name__)
