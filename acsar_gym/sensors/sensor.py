"""The base class of sensors, of which users write subclasses, and random numbers for them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError
from acsar_gym.jit import compilable, named_tuple
from acsar_gym.links.base import Link
from acsar_gym.odometry import Odometry
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Scene

Floats = NDArray[np.float64]
Numbers = NDArray[np.floating | np.integer | np.bool_]
Bound = float | Sequence[float] | Floats  # one bound for all numbers of a sensor, or one for each
MAP = "map"  # in a task's `sensors`, and of the sensor: the first of a robot's
MOVERS = "movers"  # likewise; after the map
LIDAR = "lidar"  # likewise; after map and movers, and before all others


def draw_uniform(rngs: Any, i: int) -> float:
    """Draw a number of [0, 1) from robot i's generator, the one of `Generator.random()`.

    Args:
        rngs: as `read_batch` and `reset_batch` get them.
        i: place of the robot in them.

    Returns:
        The number.
    """
    return float(rngs[i].random())


@compilable
def draw_normal(rngs: Any, i: int) -> float:
    """Draw a number of mean 0 and standard deviation 1 from robot i's generator.

    Made of two uniform ones as by Box and Muller (1958), so it isn't what `Generator.normal()`
    draws.

    Args:
        rngs: as `read_batch` and `reset_batch` get them.
        i: place of the robot in them.

    Returns:
        The number.
    """
    radius = math.sqrt(-2.0 * math.log(1.0 - draw_uniform(rngs, i)))
    return radius * math.cos(2.0 * math.pi * draw_uniform(rngs, i))


class Truths(NamedTuple):
    """The ground truth of some robots, one row each, in the frames of their worlds."""

    pose: Floats
    """(robots, 3): x [m], y [m], theta [rad]."""
    twist: Floats
    """(robots, 2): forward speed [m/s], yaw rate [rad/s]."""
    contact: NDArray[np.bool_]
    """(robots,): whether the robot has touched an obstacle since the reset."""


class Sensor:
    """Something that a robot senses, which adds `size` numbers to the observation.

    A subclass sets `name`, `size`, `low` and `high`, and implements `read`, or `read_batch`:

        class Heading(Sensor):
            name, size, low, high = "compass", 2, -1.0, 1.0

            def read(self, truth, now):
                theta = truth.pose[2] + self.rng.normal(0.0, 0.05)
                return np.array([math.cos(theta), math.sin(theta)])

    The class itself is then a factory, `Heading(link, config)`, for `RobotEnv(sensors=[Heading])`,
    the `sensors` of a Task, or `Robot(link, config, [Heading])`. A function `factory(link, config)`
    may choose another sensor where there is a real robot: `link.truth` is None there.

    For large batches, a sensor reads all robots at once. It has no `reset`, `read`, `poll` or
    `info` of its own, but:

        reset_batch(scenes, rngs, memory): begins episodes; only for those that remember something.
        read_batch(truths, scenes, now, rngs, out[, memory]): fills `out`, (robots, size). `truths`
            are `Truths`, `now` is (robots,) [s]; `scenes` and `rngs` have an item for each robot.

    `memory` is a named tuple of arrays (robots,), which a batch keeps for the sensor; the single
    env calls the same methods with one robot. Where `compiled` is True, numba compiles them for
    batches. `self` is then a named tuple of the sensor's numbers, as in a compiled Task, `scenes`
    is None, and random numbers come from `draw_uniform(rngs, i)` and `draw_normal(rngs, i)`.

    Attributes:
        memory: Name and first value of each number that an episode of such a sensor remembers.
        compiled: Whether numba compiles such a sensor for batches.
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
    memory: ClassVar[Mapping[str, float]] = {}
    compiled: ClassVar[bool] = False
    scene: Scene
    rng: np.random.Generator

    def __init__(self, link: Link, config: RobotConfig) -> None:
        self.link = link
        self.config = config

    def follow(self, odometry: Odometry) -> None:
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
        batch: Any = self
        if hasattr(self, "read_batch"):
            first = [[value] for value in self.memory.values()]
            self._memory = name_memory(self, np.array(first, np.float64))
            if hasattr(self, "reset_batch"):
                batch.reset_batch([scene], [rng], *self._memory)

    def poll(self, truth: GroundTruth | None, now: float) -> None:
        """Take a measurement, if one is due: called at a reset and after every tick.

        For sensors with a clock of their own; the others measure in `read`.

        Args:
            truth: What only a simulator knows, in the scene's frame; None on hardware.
            now: Time on the link's clock [s].
        """

    def read(self, truth: GroundTruth | None, now: float) -> Numbers:
        """Return the sensor's numbers for the observation; called once a step, after its last tick.

        Left out by a sensor that has `read_batch`.

        Args:
            truth: What only a simulator knows, in the scene's frame; None on hardware.
            now: Time on the link's clock [s].

        Returns:
            Finite numbers, of shape (size,).

        Raises:
            LinkError: The device is gone or silent. The robot is then stopped, as by any error.
            AcsarError: The sensor has `read_batch`, and the link has no truth.
        """
        if truth is None:
            raise AcsarError(
                f"sensor {self.name!r}: its read_batch needs the truth, which a real robot doesn't "
                "have: pass a factory that makes another sensor there"
            )
        batch: Any = self
        truths = Truths(*(np.array([part]) for part in (truth.pose, truth.twist, truth.contact)))
        out = np.full((1, self.size), np.nan)
        batch.read_batch(truths, [self.scene], np.array([now]), [self.rng], out, *self._memory)
        numbers: Floats = out[0]
        return numbers

    def info(self, now: float) -> Mapping[str, float]:
        """Return numbers for the env's info; the keys must be the same at every step.

        Args:
            now: Time on the link's clock [s].
        """
        return {}

    def close(self) -> None:
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


def name_memory(sensor: Sensor, rows: Floats) -> tuple[Any, ...]:
    """Make what `reset_batch` and `read_batch` get as `memory`: the rows by name.

    Args:
        sensor: declares the names.
        rows: (names, robots).

    Returns:
        The named tuple alone; nothing where the sensor remembers nothing.
    """
    if not sensor.memory:
        return ()
    return (named_tuple(type(sensor), "Memory", tuple(sensor.memory))(*rows),)


Factory = Callable[[Link, RobotConfig], Sensor]  # makes a robot's sensor, as a subclass does
