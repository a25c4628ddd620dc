"""Networks for policies that see a LiDAR. Imports torch.

The classes are named in a recipe's `policy_kwargs`, for `acsar-gym train` and for RL Zoo. They are
made of plain torch modules, so that a policy's ONNX file contains them.
"""

from __future__ import annotations

import gymnasium
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from acsar_gym.config import RobotConfig, RobotSource
from acsar_gym.errors import ConfigError
from acsar_gym.lidars.base import edges
from acsar_gym.training import arcs

MARGIN = 0.05
"""Added to a clearance before its logarithm is taken [m]; five times the LiDAR's noise."""
SCALE, OFFSET = 0.5, 0.4
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
        self.register_buffer("edges", torch.tensor(edges(config), dtype=torch.float32))

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
        return logarithm(torch.clamp(ranges - self.edges, min=0.0))


class ArcClearance(RayClearance):
    """As RayClearance, and how far the robot can drive along some arcs, put before the rays.

    They are what the dynamic window approach looks at (Fox et al. 1997): the free ways along
    `arcs.ARCS`, with the exact footprint, as logarithms, too. A small network can't work out from
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

    images = arcs.IMAGES

    def __init__(
        self,
        observation_space: gymnasium.spaces.Box,
        robot: RobotSource = None,
        first: int | None = None,
    ) -> None:
        super().__init__(observation_space, robot, first)
        config = RobotConfig.of(robot)
        self._features_dim += len(arcs.ARCS)
        table = logarithm(torch.tensor(arcs.free_ways(config), dtype=torch.float32))
        rays, cells, ways = table.shape
        self._cell, self._last_cell = arcs.cell(config), cells - 1
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


def logarithm(lengths: torch.Tensor) -> torch.Tensor:
    """0.5 log(length + 0.05) + 0.4, which tells small lengths apart."""
    return SCALE * torch.log(lengths + MARGIN) + OFFSET
