"""Policies that know that the robot is symmetric left to right. Imports torch.

`MirrorPolicy` is named in a recipe's `policy`, for `acsar-gym train` and for RL Zoo.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule

from acsar_gym.errors import ConfigError
from acsar_gym.tools.training.recipes import import_classes


class MirrorPolicy(ActorCriticPolicy):
    """PPO's actor and critic, whose outputs are means over an observation and its mirror image.

    A mirrored observation gets the same linear velocity and value, and the opposite angular
    velocity, so that what is learnt on the left holds on the right. The layers are those of
    stable-baselines3.

    Args:
        *args: As for ActorCriticPolicy.
        odd: Indices of the numbers that change their sign in the mirror.
        reversed_at: First index and length of the groups whose order the mirror reverses.
        **kwargs: As for ActorCriticPolicy; classes may be names such as "torch.nn.ReLU".
    """

    def __init__(
        self,
        *args: Any,
        odd: Sequence[int] = (),
        reversed_at: Sequence[tuple[int, int]] = (),
        **kwargs: Any,
    ) -> None:
        self._mirror: dict[str, Any] = {"odd": [*odd], "reversed_at": [*reversed_at]}
        super().__init__(*args, **import_classes(kwargs))

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | self._mirror

    def _build(self, lr_schedule: Schedule) -> None:
        """Build the layers, then run them on both images; the weights stay the optimizer's."""
        super()._build(lr_schedule)
        order, signs = find_image(self.features_dim, **self._mirror)
        self.mlp_extractor = _OnBothImages(self.mlp_extractor, order, signs)  # type: ignore[assignment]
        self.action_net = _Mean(self.action_net, [1.0, -1.0])
        self.value_net = _Mean(self.value_net, [1.0])  # type: ignore[assignment]


def find_image(
    width: int, odd: Sequence[int], reversed_at: Sequence[Sequence[int]]
) -> tuple[list[int], list[float]]:
    """Return the order and the signs of the numbers of a mirrored observation.

    Raises:
        ConfigError: A number is named twice, or isn't one of the observation.
    """
    groups = [list(range(first, first + count)) for first, count in reversed_at]
    named = [*odd, *(place for group in groups for place in group)]
    if len(set(named)) < len(named) or not set(named) <= set(range(width)):
        raise ConfigError(
            f"MirrorPolicy: odd = {odd}, reversed_at = {reversed_at}: must be different ones of "
            f"{width} numbers"
        )
    order = list(range(width))
    for group in groups:
        order[group[0] : group[-1] + 1] = reversed(group)
    return order, [-1.0 if place in odd else 1.0 for place in range(width)]


class _OnBothImages(torch.nn.Module):
    """SB3's MlpExtractor, whose results for an observation and its image are side by side."""

    def __init__(self, layers: Any, order: list[int], signs: list[float]) -> None:
        super().__init__()
        self.layers = layers
        self.latent_dim_pi = layers.latent_dim_pi
        self.latent_dim_vf = layers.latent_dim_vf
        self.order: torch.Tensor
        self.signs: torch.Tensor
        self.register_buffer("order", torch.tensor(order))
        self.register_buffer("signs", torch.tensor(signs))

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """Return the actor's units, (batch, 2, n)."""
        latent: torch.Tensor = self.layers.forward_actor(self._both(features))
        return latent

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """Return the critic's units, (batch, 2, n)."""
        latent: torch.Tensor = self.layers.forward_critic(self._both(features))
        return latent

    def _both(self, features: torch.Tensor) -> torch.Tensor:
        image = features[:, self.order] * self.signs
        return torch.stack((features, image), dim=1)


class _Mean(torch.nn.Module):
    """The mean of a layer's results for both images, with the signs of the second."""

    def __init__(self, layer: torch.nn.Module, signs: list[float]) -> None:
        super().__init__()
        self.layer = layer
        self.signs: torch.Tensor
        self.register_buffer("signs", torch.tensor(signs))

    def forward(self, units: torch.Tensor) -> torch.Tensor:
        results = self.layer(units)
        mean: torch.Tensor = 0.5 * (results[:, 0] + results[:, 1] * self.signs)
        return mean
