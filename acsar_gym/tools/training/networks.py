"""Networks for policies that see a LiDAR. Imports torch.

The classes are named in a recipe's `policy_kwargs`, for `acsar-gym train` and for RL Zoo. They are
made of plain torch modules, so that a policy's ONNX file contains them. Features are the clearances
of rays and along arcs. A ray that ends at some range stops each arc at a place that depends on
nothing else, so it is looked up in a table. `MirrorPolicy` knows that the robot is symmetric left
to right: such a network has half as much to learn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule

from acsar_gym.config import RobotConfig, RobotSource, footprint
from acsar_gym.config.footprint import Outline
from acsar_gym.errors import ConfigError
from acsar_gym.sensors.lidar import footprint_edges
from acsar_gym.sensors.scan import ray_spec
from acsar_gym.tools.training.recipes import find_classes
from acsar_gym.worlds.geometry import RaySpec

Floats = NDArray[np.float64]
Arc = tuple[int, float]
FORWARD, TURN, BACK = 1, 0, -1

CURVATURES = (-0.96, -0.48, -0.24, -0.12, 0.0, 0.12, 0.24, 0.48, 0.96)
"""Of the arcs ahead, times the footprint's radius; positive to the left."""
ARCS: tuple[Arc, ...] = (
    *((FORWARD, curvature) for curvature in CURVATURES),
    (TURN, -1.0),
    (TURN, 1.0),
    (BACK, 0.0),
)
"""Direction and curvature of each arc; TURN is on the spot, to the right and to the left."""
ARC_IMAGES = tuple(ARCS.index((direction, -curvature)) for direction, curvature in ARCS)
"""Number of each arc's mirror image."""
ARC_LENGTH = {FORWARD: 4.0, TURN: math.pi / 2.0, BACK: 2.0}
"""Length of an arc in radii of the footprint, or angle of a turn [rad]."""
ARC_POSES = 50
"""Poses that are tried along an arc."""
TOUCH_MARGIN = 0.125
"""Distance within which the footprint counts as touched, in radii of it."""
CELL_LENGTH = 1.0 / 12.0
"""Length of a cell of the table, in radii of the footprint."""
TABLE_CELLS = 100


def cell_length(config: RobotConfig) -> float:
    """Length of a cell of the table [m]."""
    return CELL_LENGTH * footprint.outline_radius(config.outline)


def free_ways(config: RobotConfig) -> Floats:
    """Make the table of free ways of a robot.

    Returns:
        Shape (rays, CELLS, arcs): the share of each arc that is free where a ray ends in a cell,
        0 to 1. The last cell stands for all that is farther.
    """
    return _table(config.outline, ray_spec(config), config.lidar_x_offset, config.lidar_y_offset)


@lru_cache(maxsize=16)
def _table(outline: Outline, rays: RaySpec, x: float, y: float) -> Floats:
    """As `free_ways`."""
    radius, angles = footprint.outline_radius(outline), rays.angles()
    ranges = (np.arange(TABLE_CELLS) + 0.5) * CELL_LENGTH * radius
    points = np.stack((np.outer(np.cos(angles), ranges) + x, np.outer(np.sin(angles), ranges) + y))
    table = np.ones((*points.shape[1:], len(ARCS)))
    for number, (direction, curvature) in enumerate(ARCS):
        # from the end: the first touch wins
        for share in np.linspace(1.0, 0.0, ARC_POSES, endpoint=False):
            way = share * ARC_LENGTH[direction]
            heading = curvature * way
            if direction == TURN:
                px, py = 0.0, 0.0
            elif curvature == 0.0:
                px, py = direction * way * radius, 0.0
            else:
                px = radius * math.sin(heading) / curvature
                py = radius * (1.0 - math.cos(heading)) / curvature
            cos, sin = math.cos(heading), math.sin(heading)
            dx, dy = points[0] - px, points[1] - py
            x_there, y_there = cos * dx + sin * dy, cos * dy - sin * dx
            touched = _within(outline, x_there, y_there, TOUCH_MARGIN * radius)
            table[touched, number] = share - 1.0 / ARC_POSES
    table[:, -1] = 1.0
    return table


def _within(outline: Outline, x: Floats, y: Floats, margin: float) -> NDArray[np.bool_]:
    """Whether points in the base frame are inside of the footprint, or within a margin of it."""
    inside, near = np.zeros(x.shape, np.bool_), np.zeros(x.shape, np.bool_)
    for (ax, ay), (bx, by) in footprint.outline_sides(outline):
        ex, ey = bx - ax, by - ay
        along = np.clip(((x - ax) * ex + (y - ay) * ey) / (ex * ex + ey * ey), 0.0, 1.0)
        near |= np.hypot(x - ax - along * ex, y - ay - along * ey) < margin
        if ay != by:
            crossed = (ay > y) != (by > y)
            inside ^= crossed & (x < ax + (y - ay) * ex / ey)
    return inside | near


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

    Args:
        *args: as of ActorCriticPolicy.
        odd: indices of the features that change their sign in the mirror.
        reversed_at: first and count of the features whose order it reverses, such as directions
            around the robot.
        **kwargs: as of ActorCriticPolicy; `net_arch` has the pairs of units of each layer. Classes
            may be given by the names in `classes`, as RL Zoo does with a recipe's.

    Raises:
        ConfigError: these aren't indices of the features.
    """

    def __init__(
        self,
        *args: Any,
        odd: Sequence[int] = (),
        reversed_at: tuple[int, int] = (0, 0),
        **kwargs: Any,
    ) -> None:
        first, count = reversed_at
        self._odd, self._reversed_at = tuple(odd), (first, count)
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
            half = torch.eye(len(even.bias)) / 2.0
            to_even, to_odd = torch.cat((half, half), 1), torch.cat((half, -half), 1)
        rows = action.linear.weight @ to_even, action.angular.weight @ to_odd
        biases = torch.cat((action.linear.bias, torch.zeros(1)))
        return torch.nn.Sequential(*layers, _dense(torch.cat(rows), biases))


class _Split(torch.nn.Module):
    """Features as coordinates of their even and odd parts, by one matrix.

    Args:
        width: of the features.
        odd: indices of the numbers that change their sign in the mirror.
        reversed_at: (first, count) of numbers whose order the mirror reverses.

    Raises:
        ConfigError: they aren't indices of the features.
    """

    def __init__(self, width: int, odd: Sequence[int], reversed_at: tuple[int, int]) -> None:
        super().__init__()
        first, count = reversed_at
        single = [k for k in range(width) if not first <= k < first + count]
        if not (set(odd) <= set(single) and 0 <= first <= first + count <= width):
            raise ConfigError(
                f"MirrorPolicy: odd = {tuple(odd)}, reversed_at = {tuple(reversed_at)}: must be "
                f"different ones of {width} numbers"
            )
        image = torch.diag(torch.tensor([-1.0 if k in odd else 1.0 for k in range(width)]))
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
    layer = torch.nn.Linear(weights.shape[1], weights.shape[0])
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


LOG_MARGIN = 0.05
"""Added to a clearance before its logarithm is taken [m]; five times the LiDAR's noise."""
LOG_SCALE, LOG_OFFSET = 0.5, 0.4
"""Of the logarithm; clearances of 0 to 5 m become numbers of -1.1 to 1.2."""


class RayClearance(BaseFeaturesExtractor):
    """Replaces the range of each ray by the logarithm of the footprint's clearance along the ray.

    An observation has `range / max_range`, in which the last 5 cm before a collision are 0.01, less
    than a small network can tell apart. Here they are a third of the input's whole width:

        0.5 log(max(range - edge, 0) + 0.05) + 0.4

    where `edge` is the distance from the LiDAR to the edge of the footprint in the direction of the
    ray [m]. All other numbers of the observation stay as they are.

    Args:
        observation_space: of a task with the LiDAR.
        robot: whose LiDAR and footprint these are; see `RobotConfig.of`.
        first: index of the first ray in the observation; None where the rays come last.

    Raises:
        ConfigError: the observation is too small for the robot's rays.
    """

    def __init__(
        self,
        observation_space: gymnasium.spaces.Box,
        robot: RobotSource = None,
        first: int | None = None,
    ) -> None:
        width = observation_space.shape[0]
        super().__init__(observation_space, width)
        config = RobotConfig.of(robot)
        rays = config.lidar.rays
        self._first = width - rays if first is None else first
        if not 0 <= self._first <= width - rays:
            raise ConfigError(f"RayClearance: no {rays} rays in an observation of {width} numbers")
        self._last = self._first + rays
        self._max_range = config.lidar.max_range
        self.edges: torch.Tensor
        self.register_buffer("edges", torch.tensor(footprint_edges(config), dtype=torch.float32))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Map observations (batch, n) to features (batch, n)."""
        before, rays, after = self._parts(observations)
        return torch.cat((before, self._near(rays), after), dim=1)

    def _parts(self, observations: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Split observations into the numbers before the rays, ranges [m], and numbers after."""
        before, rays, after = observations.tensor_split((self._first, self._last), dim=1)
        return before, rays * self._max_range, after

    def _near(self, ranges: torch.Tensor) -> torch.Tensor:
        """The logarithm of each ray's clearance (batch, rays)."""
        return scale_clearance(torch.clamp(ranges - self.edges, min=0.0))


class ArcClearance(RayClearance):
    """As RayClearance, and how far the robot can drive along some arcs, put before the rays.

    They are what the dynamic window approach looks at (Fox et al. 1997): the free ways along
    `ARCS`, with the exact footprint, as logarithms, too. A small network can't work out from
    single rays whether a corner of the footprint will pass.

    Args:
        observation_space: of a task with the LiDAR.
        robot: whose LiDAR and footprint these are; see `RobotConfig.of`.
        first: index of the first ray in the observation; None where the rays come last.

    Attributes:
        images: number of each arc's mirror image.

    Raises:
        ConfigError: the observation is too small for the robot's rays.
    """

    images = ARC_IMAGES

    def __init__(
        self,
        observation_space: gymnasium.spaces.Box,
        robot: RobotSource = None,
        first: int | None = None,
    ) -> None:
        super().__init__(observation_space, robot, first)
        config = RobotConfig.of(robot)
        self._features_dim += len(ARCS)
        table = scale_clearance(torch.tensor(free_ways(config), dtype=torch.float32))
        rays, cells, ways = table.shape
        self._cell, self._last_cell = cell_length(config), cells - 1
        self.table: torch.Tensor
        self.rows: torch.Tensor
        self.register_buffer("table", table.reshape(rays * cells, ways).contiguous())
        self.register_buffer("rows", torch.arange(rays) * cells)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Map observations (batch, n) to features (batch, n + arcs)."""
        before, ranges, after = self._parts(observations)
        return torch.cat((before, self._free(ranges), self._near(ranges), after), dim=1)

    def _free(self, ranges: torch.Tensor) -> torch.Tensor:
        """The logarithm of each arc's free share (batch, arcs); it has no gradient."""
        cells = (ranges.detach() / self._cell).long().clamp(0, self._last_cell)
        ways = torch.nn.functional.embedding(cells + self.rows, self.table)
        return ways.amin(dim=1)


def scale_clearance(lengths: torch.Tensor) -> torch.Tensor:
    """0.5 log(length + 0.05) + 0.4, which tells small lengths apart."""
    return LOG_SCALE * torch.log(lengths + LOG_MARGIN) + LOG_OFFSET
