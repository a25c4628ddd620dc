"""The base class of sensors, of which users write subclasses."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.links.base import Link
from acsar_gym.odometry import Odometry
from acsar_gym.physics.body import GroundTruth
from acsar_gym.worlds import Scene

Floats = NDArray[np.float64]
Numbers = NDArray[np.floating | np.integer | np.bool_]
Bound = float | Sequence[float] | Floats
"""One bound for all numbers of a sensor, or one for each."""
LIDAR = "lidar"
"""Name of the LiDAR in a task's `sensors`, and of the sensor; it is the first of a robot's
sensors."""


class Sensor(ABC):
    """Something that a robot senses, which adds `size` numbers to the observation.

    A subclass sets `name`, `size`, `low` and `high`, and implements `read`:

        class Heading(Sensor):
            name, size, low, high = "compass", 2, -1.0, 1.0

            def read(self, truth, now):
                theta = truth.pose[2] + self.rng.normal(0.0, 0.05)
                return np.array([math.cos(theta), math.sin(theta)])

    The class itself is then a factory, `Heading(link, config)`, for `RobotEnv(sensors=[Heading])`,
    the `sensors` of a Task, or `Robot(link, config, [Heading])`. A function `factory(link, config)`
    may choose another sensor where there is a real robot: `link.truth` is None there.

    Attributes:
        name: Name in errors; no two sensors of a robot may have the same.
        size: How many numbers it adds to the observation.
        low: Their least values, as in the observation: a number, or (size,).
        high: Their largest values.
        uses_truth: Whether `poll` and `read` use `truth`; without it a tick costs a little less.
        link: The wire to the robot.
        config: The robot's parameters.
        scene: The episode's world and start; set by `reset`.
        rng: The generator that all noise must come from; set by `reset`.

    Args:
        link: The wire to the robot.
        config: The robot's parameters.
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

    def follow(self, odometry: Odometry) -> None:  # noqa: B027 - few sensors need it
        """Take over a robot's odometry, whose `pose` and `twist` change as it drives.

        Called once, when the robot is made; a batch doesn't call it.

        Args:
            odometry: of the robot.
        """

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Begin an episode; a sensor with a device opens it here, if it isn't open.

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
        """Return the sensor's numbers for the observation; called once a step, after its last tick.

        Args:
            truth: What only a simulator knows, in the scene's frame; None on hardware.
            now: Time on the link's clock [s].

        Returns:
            Finite numbers, of shape (size,).

        Raises:
            LinkError: The device is gone or silent. The robot is then stopped, as by any error.
        """

    def info(self, now: float) -> Mapping[str, float]:
        """Return numbers for the env's info; the keys must be the same at every step.

        Args:
            now: Time on the link's clock [s].
        """
        return {}

    def close(self) -> None:  # noqa: B027 - not all have
        """Close the device; idempotent."""

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """`low` and `high` as arrays of shape (size,)."""
        low, high = (np.asarray(bound, np.float64) for bound in (self.low, self.high))
        return np.broadcast_to(low, (self.size,)), np.broadcast_to(high, (self.size,))

    @property
    def layout(self) -> str:
        """Name, size and bounds in words; a policy fits an env whose sensors have the same."""
        low, high = self.bounds
        return f"{self.name}[{self.size}] from {low.min():g} to {high.max():g}"


Factory = Callable[[Link, RobotConfig], Sensor]
"""Makes a robot's sensor; a subclass of Sensor is one."""
