"""Networks for policies that know that the robot is symmetric left to right. Imports torch.

`MirrorPolicy` is named in a recipe's `policy`, for `acsar-gym train` and for RL Zoo. Such a network
has half as much to learn. It is made of plain torch modules, so that a policy's ONNX file contains
it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule

from acsar_gym.errors import ConfigError
from acsar_gym.tools.training.recipes import find_classes

RECTIFIER_GAIN = 2.0**0.5
"""Of the first weights, for rectified units."""
ACTION_GAIN = 0.01
"""Of the first weights of the action, so that a new policy acts about zero."""

Parts = tuple[torch.Tensor, torch.Tensor]


class MirrorPolicy(ActorCriticPolicy):
    """PPO's actor and critic, equivariant under the mirror image left to right.

    Every layer has weights for the even part of its input, (x + mirrored x) / 2, and for the odd
    part, (x - mirrored x) / 2, and acts on their sum and their difference: its units and their
    mirror images. The linear velocity and the value are even, the angular velocity is odd. A layer
    of n pairs of units costs half of a layer of 2 n units.
    """

    def __init__(
        self,
        *args: Any,
        odd: Sequence[int] = (),
        reversed_at: Sequence[tuple[int, int]] = (),
        **kwargs: Any,
    ) -> None:
        self._odd = tuple(odd)
        self._reversed_at = tuple((first, count) for first, count in reversed_at)
        super().__init__(*args, **find_classes(kwargs))

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {
            "odd": self._odd,
            "reversed_at": self._reversed_at,
        }

    def _build_mlp_extractor(self) -> None:
        """Make the hidden layers of actor and critic."""
        split = _Split(self.features_dim, self._odd, self._reversed_at)
        given: Any = self.net_arch
        widths = given if isinstance(given, dict) else {"pi": given, "vf": given}
        built = _Hidden(split, list(widths["pi"]), list(widths["vf"]), self.activation_fn)
        self.mlp_extractor = built  # type: ignore[assignment]  # has the same methods

    def _build(self, lr_schedule: Schedule) -> None:
        """Make all layers and their first weights, and the optimizer."""
        self.ortho_init = False  # ActorCriticPolicy's would touch layers that have theirs already
        super()._build(lr_schedule)
        width = self.mlp_extractor.latent_dim_pi // 2
        self.action_net = _Action(width)  # instead of a Linear
        torch.nn.init.orthogonal_(self.value_net.weight)
        torch.nn.init.zeros_(self.value_net.bias)
        self.optimizer = self.optimizer_class(
            self.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]  # torch's Optimizer has no lr
            **self.optimizer_kwargs,
        )

    def plain_actor(self) -> torch.nn.Module:
        """Make ordinary layers that map features to the mean action as this policy does.

        They take half the time for one observation, and twice the time for thousands.
        """
        hidden: Any = self.mlp_extractor
        action: Any = self.action_net
        layers: list[torch.nn.Module] = []
        to_even, to_odd = hidden.split.parts
        for even, odd in zip(hidden.actor.even, hidden.actor.odd, strict=True):
            a, b = even.weight @ to_even, odd.weight @ to_odd
            layers += [_dense(torch.cat((a + b, a - b)), even.bias.repeat(2)), self.activation_fn()]
            half = torch.diag(torch.full_like(even.bias, 0.5))
            to_even, to_odd = torch.cat((half, half), 1), torch.cat((half, -half), 1)
        rows = action.linear.weight @ to_even, action.angular.weight @ to_odd
        biases = torch.cat((action.linear.bias, action.linear.bias.new_zeros(1)))
        return torch.nn.Sequential(*layers, _dense(torch.cat(rows), biases))


class _Split(torch.nn.Module):
    """Features as coordinates of their even and odd parts, by one matrix."""

    def __init__(
        self, width: int, odd: Sequence[int], reversed_at: Sequence[tuple[int, int]]
    ) -> None:
        super().__init__()
        named = [*odd, *(k for first, count in reversed_at for k in range(first, first + count))]
        if len(set(named)) < len(named) or not set(named) <= set(range(width)):
            raise ConfigError(
                f"MirrorPolicy: odd = {tuple(odd)}, reversed_at = {tuple(reversed_at)}: must be "
                f"different ones of {width} numbers"
            )
        image = torch.diag(torch.tensor([-1.0 if k in odd else 1.0 for k in range(width)]))
        for first, count in reversed_at:
            image[first : first + count, first : first + count] = torch.eye(count).flip(0)
        kept: dict[float, list[torch.Tensor]] = {1.0: [], -1.0: []}
        for parity, rows in kept.items():
            for row in torch.eye(len(image)) + parity * image:
                known = any(torch.equal(row, sign * one) for one in rows for sign in kept)
                if bool(row.any()) and not known:
                    rows.append(row)
        self.even, self.odd = (len(rows) for rows in kept.values())
        self.basis: torch.Tensor
        basis = torch.stack([*kept[1.0], *kept[-1.0]]).T.contiguous() / 2.0
        self.register_buffer("basis", basis)

    @property
    def parts(self) -> Parts:
        """Matrices (even, n) and (odd, n) that map features to their even and odd parts."""
        return self.basis.T[: self.even], self.basis.T[self.even :]

    def forward(self, features: torch.Tensor) -> Parts:
        parts = features @ self.basis
        return parts[:, : self.even], parts[:, self.even :]


class _Layers(torch.nn.Module):
    """Hidden layers on even and odd parts."""

    def __init__(
        self, even: int, odd: int, widths: Sequence[int], activation: type[torch.nn.Module]
    ) -> None:
        super().__init__()
        self.even = torch.nn.ModuleList(_linear(a, b) for a, b in pairwise([even, *widths]))
        self.odd = torch.nn.ModuleList(
            _linear(a, b, bias=False) for a, b in pairwise([odd, *widths])
        )
        self.activation = activation()

    def forward(self, even: torch.Tensor, odd: torch.Tensor) -> Parts:
        for on_even, on_odd in zip(self.even, self.odd, strict=True):
            even, odd = on_even(even), on_odd(odd)
            units, images = self.activation(even + odd), self.activation(even - odd)
            even, odd = 0.5 * (units + images), 0.5 * (units - images)
        return even, odd


class _Hidden(torch.nn.Module):
    """The hidden layers of actor and critic, with the methods of SB3's MlpExtractor."""

    def __init__(
        self,
        split: _Split,
        actor: Sequence[int],
        critic: Sequence[int],
        activation: type[torch.nn.Module],
    ) -> None:
        super().__init__()
        self.split = split
        self.actor = _Layers(split.even, split.odd, actor, activation)
        self.critic = _Layers(split.even, split.odd, critic, activation)
        self.latent_dim_pi, self.latent_dim_vf = 2 * actor[-1], critic[-1]

    def forward(self, features: torch.Tensor) -> Parts:
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """Even and odd units of the actor side by side, (batch, 2 n)."""
        return torch.cat(self.actor(*self.split(features)), dim=1)

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """Even units of the critic, (batch, n)."""
        even: torch.Tensor = self.critic(*self.split(features))[0]
        return even


class _Action(torch.nn.Module):
    """Linear velocity from the even units, angular velocity from the odd ones."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width
        self.linear = _linear(width, 1, ACTION_GAIN)
        self.angular = _linear(width, 1, ACTION_GAIN, bias=False)

    def forward(self, units: torch.Tensor) -> torch.Tensor:
        even, odd = units[:, : self.width], units[:, self.width :]
        return torch.cat((self.linear(even), self.angular(odd)), dim=1)


def _dense(weights: torch.Tensor, biases: torch.Tensor) -> torch.nn.Linear:
    """Make a layer of these weights and biases."""
    layer = torch.nn.Linear(weights.shape[1], weights.shape[0], device=weights.device)
    with torch.no_grad():
        layer.weight.copy_(weights)
        layer.bias.copy_(biases)
    return layer


def _linear(
    before: int, after: int, gain: float = RECTIFIER_GAIN, *, bias: bool = True
) -> torch.nn.Linear:
    """Make a layer with orthogonal weights and no bias at first."""
    layer = torch.nn.Linear(before, after, bias=bias)
    torch.nn.init.orthogonal_(layer.weight, gain)
    if bias:
        torch.nn.init.zeros_(layer.bias)
    return layer
