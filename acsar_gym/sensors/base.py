"""The contract of a sensor, which a user's own one implements by a short subclass."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from acsar_gym.bodies.base import GroundTruth
from acsar_gym.config import RobotConfig
from acsar_gym.links.base import Link
from acsar_gym.worlds import Scene

Floats = NDArray[np.float64]
Numbers = NDArray[np.floating | np.integer | np.bool_]
Bound = float | Sequence[float] | Floats
"""One number for all numbers of a sensor, or one for each."""
LIDAR = "lidar"
"""Name of the LiDAR among a robot's sensors, in a task's `sensors`, and the first of every list."""


class Sensor(ABC):
    """Something that a robot senses, and that an observation tells as `size` numbers.

    A subclass says `name`, `size`, `low` and `high`, and how to `read`:

        class Heading(Sensor):
            name, size, low, high = "compass", 2, -1.0, 1.0

            def read(self, truth, now):
                theta = truth.pose[2] + self.rng.normal(0.0, 0.05)
                return np.array([math.cos(theta), math.sin(theta)])

    The class itself is a factory then, `Heading(link, config)`, for `RobotEnv(sensors=[Heading])`,
    the `sensors` of a Task, or `Robot(link, config, [Heading])`. A function `factory(link, config)`
    may choose another sensor where there is a real robot: `link.truth` is None there.

    Attributes:
        name: What errors call it; no two sensors of a robot have the same.
        size: How many numbers it adds to the observation.
        low: Their least values, as they stand in the observation: a number, or (size,).
        high: Their largest values.
        uses_truth: Whether `poll` and `read` use `truth`; without it a tick costs a little less.
        link: The wire to the robot.
        config: The robot's parameters.
        scene: The episode's world and start; set by `reset`.
        rng: The generator that all noise must come from; set by `reset`.
    """

    name: str
    size: int
    low: Bound = -math.inf
    high: Bound = math.inf
    uses_truth = True
    scene: Scene
    rng: np.random.Generator

    def __init__(self, link: Link, config: RobotConfig) -> None:
        self.link = link
        self.config = config

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Begin an episode; a sensor with a device opens it here, where it isn't open yet.

        Args:
            scene: The world, and the robot's start in it.
            rng: The env's generator: every random number of the sensor must come from it.

        Raises:
            LinkError: The device can't be opened, or doesn't measure.
        """
        self.scene, self.rng = scene, rng

    def poll(self, truth: GroundTruth | None, now: float) -> None:  # noqa: B027 - not all do
        """Take a measurement, if one is due: called at a reset and after every tick.

        For sensors with a clock of their own; the others measure in `read`.

        Args:
            truth: What only a simulator knows, in the scene's frame; None on hardware.
            now: Time on the link's clock [s].
        """

    @abstractmethod
    def read(self, truth: GroundTruth | None, now: float) -> Numbers:
        """The sensor's numbers as they stand in the observation: once a step, after its last tick.

        Args:
            truth: What only a simulator knows, in the scene's frame; None on hardware.
            now: Time on the link's clock [s].

        Returns:
            Finite numbers, of shape (size,).

        Raises:
            LinkError: The device is gone or silent. The robot is stopped then, as by any error.
        """

    def info(self, now: float) -> Mapping[str, float]:
        """Numbers for the env's info: the same keys at every step."""
        return {}

    def close(self) -> None:  # noqa: B027 - not all have
        """Let go of a device; idempotent."""

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """`low` and `high` as arrays of shape (size,)."""
        low, high = (np.asarray(bound, np.float64) for bound in (self.low, self.high))
        return np.broadcast_to(low, (self.size,)), np.broadcast_to(high, (self.size,))

    @property
    def layout(self) -> str:
        """Its numbers in words; a policy fits an env whose sensors say the same."""
        low, high = self.bounds
        return f"{self.name}[{self.size}] from {low.min():g} to {high.max():g}"


Factory = Callable[[Link, RobotConfig], Sensor]
"""Makes a robot's sensor; a subclass of Sensor is one."""
