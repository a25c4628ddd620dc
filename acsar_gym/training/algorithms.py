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
    policy: str
    """Base class of its policies."""
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

    def types(self) -> dict[str, Any]:
        """Annotations of the hyperparameters that it takes, by name."""
        given = inspect.signature(self.load().__init__).parameters
        return {
            name: one.annotation
            for name, one in given.items()
            if name not in OURS and name[0] != "_"
        }


ALGORITHMS = {
    each.name: each
    for each in (
        Algorithm("ppo", "stable_baselines3", "PPO", "ActorCriticPolicy"),
        Algorithm("sac", "stable_baselines3", "SAC", "SACPolicy", replays=True),
        Algorithm("tqc", "sb3_contrib", "TQC", "TQCPolicy", replays=True),
        Algorithm("ppo_lstm", "sb3_contrib", "RecurrentPPO", "RecurrentActorCriticPolicy"),
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


def of_policy(policy: Any) -> str | None:
    """Return the name of the algorithm that a policy is of; None where `train` doesn't know it."""
    names = {each.policy: each.name for each in ALGORITHMS.values()}
    bases = (names.get(kind.__name__) for kind in type(policy).__mro__)
    return next((name for name in bases if name is not None), None)
