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

Parts = tuple[torch.Tensor, torch.Tensor]
"""Even and odd parts of a layer's units, (batch, n) each."""


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
        self._mirror: dict[str, Any] = {"odd": [*odd], "reversed_at": [*reversed_at]}
        features = {
            "features_extractor_class": _Split,
            "features_extractor_kwargs": self._mirror,
        }
        super().__init__(*args, **import_classes(kwargs) | features)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | self._mirror

    def _build_mlp_extractor(self) -> None:
        """Make the hidden layers of stable-baselines3, then let each act on even and odd parts."""
        super()._build_mlp_extractor()
        features: Any = self.features_extractor
        sizes = (len(features.even), len(features.odd))
        for layers in (self.mlp_extractor.policy_net, self.mlp_extractor.value_net):
            for place, layer in enumerate(layers):
                if not isinstance(layer, torch.nn.Linear):
                    layers[place] = _MirrorActivation(layer)
                elif place:
                    layers[place] = _MirrorLayer(layer.in_features, layer.in_features, layer)
                else:
                    layers[place] = _MirrorLayer(*sizes, layer)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        # The optimizer has their weights already, whose places stay.
        self.action_net = _Outputs(self.action_net, odd=1)
        self.value_net = _Outputs(self.value_net, odd=0)  # type: ignore[assignment]


class _Split(FlattenExtractor):
    """Maps observations (batch, n) to their even and odd parts."""

    def __init__(self, space: Any, odd: list[int], reversed_at: list[Sequence[int]]) -> None:
        super().__init__(space)
        width = self.features_dim
        groups = [range(first, first + count) for first, count in reversed_at]
        mirrored = [*odd, *(place for group in groups for place in group)]
        if len(set(mirrored)) < len(mirrored) or not set(mirrored) <= set(range(width)):
            raise ConfigError(
                f"MirrorPolicy: odd = {odd}, reversed_at = {reversed_at}: must be different ones "
                f"of {width} numbers"
            )

        # Where each number of the mirror image comes from.
        order = list(range(width))
        for group in groups:
            order[group.start : group.stop] = reversed(group)
        self.order = torch.nn.Buffer(torch.tensor(order))
        self.signs = torch.nn.Buffer(torch.ones(width))
        self.signs[odd] = -1.0

        # A pair has a mean and a difference, which need only one place each.
        places = range(width)
        even = [place for place in places if place <= order[place] and place not in odd]
        odd = [place for place in places if place < order[place] or place in odd]
        self.even = torch.nn.Buffer(torch.tensor(even))
        self.odd = torch.nn.Buffer(torch.tensor(odd))

    def forward(self, observations: torch.Tensor) -> Parts:  # type: ignore[override]
        features = self.flatten(observations)
        image = features[:, self.order] * self.signs
        return 0.5 * (features + image)[:, self.even], 0.5 * (features - image)[:, self.odd]


class _MirrorLayer(torch.nn.Module):
    """Weights for `even` and for `odd` numbers instead of those of `layer`."""

    def __init__(self, even: int, odd: int, layer: torch.nn.Linear) -> None:
        super().__init__()
        # Only without a bias does the odd part keep its sign in the mirror.
        self.even = torch.nn.Linear(even, layer.out_features)
        self.odd = torch.nn.Linear(odd, layer.out_features, bias=False)

    def forward(self, parts: Parts) -> Parts:
        even, odd = parts
        return self.even(even), self.odd(odd)


class _MirrorActivation(torch.nn.Module):
    """Activates the units and their mirror images, whose mean and difference are the parts."""

    def __init__(self, activation: torch.nn.Module) -> None:
        super().__init__()
        self.activation = activation

    def forward(self, parts: Parts) -> Parts:
        even, odd = parts
        units = self.activation(even + odd)
        images = self.activation(even - odd)
        return 0.5 * (units + images), 0.5 * (units - images)


class _Outputs(torch.nn.Module):
    """Takes the last `odd` results of a layer from the odd part, without bias."""

    def __init__(self, layer: Any, odd: int) -> None:
        super().__init__()
        self.layer = layer
        self.odd = odd

    def forward(self, parts: Parts) -> torch.Tensor:
        even, odd = parts
        split = self.layer.out_features - self.odd
        weight = self.layer.weight
        linear = torch.nn.functional.linear
        results = linear(even, weight[:split], self.layer.bias[:split])
        return torch.cat((results, linear(odd, weight[split:])), dim=1)
