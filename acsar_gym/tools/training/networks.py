"""Policies that know that the robot is symmetric left to right. Imports torch.

`MirrorPolicy` is named in a recipe's `policy`, for `acsar-gym train` and for RL Zoo.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import Schedule

from acsar_gym.errors import ConfigError
from acsar_gym.tools.training.recipes import import_classes


class MirrorPolicy(ActorCriticPolicy):
    """PPO's actor and critic, equivariant under the mirror image left to right.

    A mirrored observation gets the same linear velocity and value, and the opposite angular
    velocity, so that what is learnt on the left holds on the right. Every hidden layer has weights
    for the even and for the odd part of its input, (x + mirrored x) / 2 and (x - mirrored x) / 2.

    Args:
        *args: As for ActorCriticPolicy.
        odd: Indices of the numbers that change their sign in the mirror.
        reversed_at: First index and length of the groups whose order the mirror reverses.
        **kwargs: As for ActorCriticPolicy. Classes may be names such as "torch.nn.ReLU".
    """

    def __init__(
        self,
        *args: Any,
        odd: Sequence[int] = (),
        reversed_at: Sequence[Sequence[int]] = (),
        **kwargs: Any,
    ) -> None:
        kwargs["features_extractor_class"] = _BothImages
        kwargs["features_extractor_kwargs"] = {"odd": [*odd], "reversed_at": reversed_at}
        super().__init__(*args, **import_classes(kwargs))

    def _build_mlp_extractor(self) -> None:
        """Make the hidden layers of stable-baselines3, then replace each by a `_MirrorLayer`."""
        super()._build_mlp_extractor()
        features: Any = self.features_extractor
        for layers in (self.mlp_extractor.policy_net, self.mlp_extractor.value_net):
            for place, layer in enumerate(layers):
                if isinstance(layer, torch.nn.Linear):
                    parts = () if place else (features.even, features.odd)
                    layers[place] = _MirrorLayer(layer, *parts)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        # Only the outputs are means. Their weights stay those of the optimizer.
        self.action_net = _Mean(self.action_net, [1.0, -1.0])
        self.value_net = _Mean(self.value_net, [1.0])  # type: ignore[assignment]


class _BothImages(FlattenExtractor):
    """Maps observations (batch, n) to themselves and their mirror images, (batch, 2, n)."""

    def __init__(self, space: Any, odd: list[int], reversed_at: Sequence[Sequence[int]]) -> None:
        super().__init__(space)
        # Where each number of the mirror image comes from, and its sign.
        places = list(range(self.features_dim))
        order = places.copy()
        for first, count in reversed_at:
            order[first : first + count] = reversed(range(first, first + count))
        if sorted(order) != places or not {*odd} <= {*places}:
            raise ConfigError(
                f"MirrorPolicy: odd = {odd}, reversed_at = {reversed_at}: must be different ones "
                f"of {len(places)} numbers"
            )
        self.order = torch.nn.Buffer(torch.tensor(order))
        self.signs = torch.nn.Buffer(torch.ones(len(places)))
        self.signs[odd] = -1.0

        # A pair has a mean and a difference, which need only one place each.
        self.even = [place for place in places if place <= order[place] and place not in odd]
        self.odd = [place for place in places if place < order[place] or place in odd]

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        features = self.flatten(observations)
        return torch.stack((features, features[:, self.order] * self.signs), dim=1)


class _MirrorLayer(torch.nn.Module):
    """Maps units and their mirror images, (batch, 2, n), to those of the next layer.

    Args:
        layer: Layer of the same size.
        even: Units whose even part is used, by default all.
        odd: Units whose odd part is used, by default all.
    """

    def __init__(
        self, layer: torch.nn.Linear, even: Sequence[int] = (), odd: Sequence[int] = ()
    ) -> None:
        super().__init__()
        # Only the odd part without a bias keeps its sign in the mirror.
        inputs = layer.in_features
        outputs = layer.out_features
        self.even_units: Any = torch.nn.Buffer(torch.tensor(even)) if even else slice(None)
        self.odd_units: Any = torch.nn.Buffer(torch.tensor(odd)) if odd else slice(None)
        self.even = torch.nn.Linear(len(even) or inputs, outputs)
        self.odd = torch.nn.Linear(len(odd) or inputs, outputs, bias=False)

    def forward(self, units: torch.Tensor) -> torch.Tensor:
        even = self.even(0.5 * (units[:, 0] + units[:, 1])[:, self.even_units])
        odd = self.odd(0.5 * (units[:, 0] - units[:, 1])[:, self.odd_units])
        return torch.stack((even + odd, even - odd), dim=1)


class _Mean(torch.nn.Module):
    """The mean of a layer's results for both images, with the signs of the second."""

    def __init__(self, layer: torch.nn.Module, signs: list[float]) -> None:
        super().__init__()
        self.layer = layer
        self.signs = torch.nn.Buffer(torch.tensor(signs))

    def forward(self, units: torch.Tensor) -> torch.Tensor:
        results = self.layer(units)
        mean: torch.Tensor = 0.5 * (results[:, 0] + results[:, 1] * self.signs)
        return mean
