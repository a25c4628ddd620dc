"""The LiDAR of a simulated robot: rays in the world, with noise and drop-outs."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import LidarConfig, RobotConfig
from acsar_gym.jit import loop
from acsar_gym.lidars.base import Scan, ray_spec
from acsar_gym.links.base import Link
from acsar_gym.worlds import Scene
from acsar_gym.worlds.geometry import Obstacles, cast, surroundings


class SimulatedLidar:
    """Exact rays from the true pose of a simulated robot, with noise and drop-outs.

    A scan is taken at the reset and then at the first tick of every period of the LiDAR. All rays
    of
    a scan start from the same pose.
    """

    def __init__(self, link: Link, config: RobotConfig) -> None:
        self._link = link
        self._config = config
        self._settings = config.lidar
        self._around = surroundings(Obstacles(), ray_spec(config), 1, config)
        self._rng = np.random.default_rng(0)
        self._scan = Scan(np.full(config.lidar.rays, config.lidar.max_range), 0.0)
        self._first, self._taken = 0.0, 0

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Take over the scene's obstacles, and the generator for the noise."""
        world = scene.world
        obstacles = Obstacles() if world is None else Obstacles(world.circles, world.segments)
        self._around = surroundings(obstacles, ray_spec(self._config), 1, self._config)
        self._rng = rng
        self._first, self._taken = self._link.now(), 0

    def scan(self) -> Scan:
        """Return the newest scan; takes one where it is due."""
        now = self._link.now()
        if now - self._first > self._taken / self._settings.rate - 1e-9:
            self._taken = 1 + math.floor((now - self._first) * self._settings.rate + 1e-9)
            self._scan = Scan(self._ranges(), now)
        return self._scan

    def _ranges(self) -> NDArray[np.float64]:
        """Ranges of a scan at the robot's true pose [m]."""
        truth = self._link.truth
        x, y, theta = truth.pose if truth else (0.0, 0.0, 0.0)
        ranges = np.empty(self._settings.rays)
        cast(x, y, math.cos(theta), math.sin(theta), 0, self._around, ranges)
        if draws(self._settings):
            uniforms = self._rng.random(draws(self._settings))
            measure(ranges, uniforms, *measured(self._settings))
        else:
            np.maximum(ranges, self._settings.min_range, out=ranges)
        return ranges

    def close(self) -> None:
        """Do nothing: there is no device."""


def draws(lidar: LidarConfig) -> int:
    """How many uniform samples one noisy scan consumes."""
    pairs = (lidar.rays + 1) // 2 if lidar.noise > 0.0 else 0
    return 2 * pairs + (lidar.rays if lidar.dropouts > 0.0 else 0)


def measured(lidar: LidarConfig) -> tuple[float, float, float, float]:
    """Noise [m], drop-out share, and least and longest range [m], as `measure` takes them."""
    return lidar.noise, lidar.dropouts, lidar.min_range, lidar.max_range


@loop
def measure(
    ranges: NDArray[np.float64],
    uniforms: NDArray[np.float64],
    noise: float,
    dropouts: float,
    nearest: float,
    farthest: float,
) -> None:
    """Apply noise, drop-outs and limits to true ranges, in place.

    Args:
        ranges: (rays,), true ranges [m]; changed.
        uniforms: samples of [0, 1), as many as `draws` says: two for each pair of rays (Box and
            Muller 1958), then one for each ray that may drop out.
        noise: standard deviation of ranges that meet something [m].
        dropouts: share of rays that measure nothing, which read `farthest`.
        nearest: least range [m].
        farthest: longest range [m].
    """
    rays, used = len(ranges), 0
    if noise > 0.0:
        for pair in range((rays + 1) // 2):
            radius = noise * math.sqrt(-2.0 * math.log(1.0 - uniforms[2 * pair]))
            angle = 2.0 * math.pi * uniforms[2 * pair + 1]
            for k in range(2 * pair, min(2 * pair + 2, rays)):
                if ranges[k] < farthest:
                    turned = math.cos(angle) if k == 2 * pair else math.sin(angle)
                    ranges[k] += radius * turned
        used = 2 * ((rays + 1) // 2)
    for k in range(rays):
        ranges[k] = min(max(ranges[k], nearest), farthest)
        if dropouts > 0.0 and uniforms[used + k] < dropouts:
            ranges[k] = farthest
