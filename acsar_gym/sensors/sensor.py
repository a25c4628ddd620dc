"""The base class of sensors, of which users write subclasses, and random numbers for them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.jit import compilable, named_tuple
from acsar_gym.links.base import Link
from acsar_gym.odometry import Odometry
from acsar_gym.truth import GroundTruth

Floats = NDArray[np.float64]
Bound = float | Sequence[float] | Floats
"""A bound for all numbers of a sensor, or one for each."""
MAP = "map"
MOVERS = "movers"
LIDAR = "lidar"


def draw_uniform(rngs: Any, i: int) -> float:
    """Draw a number of [0, 1) from robot i's generator, as `Generator.random()` does.

    Args:
        rngs: Generators, as in `SensorInput`.
        i: Place of the robot among them.

    Returns:
        The number.
    """
    return float(rngs[i].random())


@compilable
def draw_normal(rngs: Any, i: int) -> float:
    """Draw a number of mean 0 and standard deviation 1 from robot i's generator.

    It is made of two uniform numbers as by Box and Muller (1958), so it isn't what
    `Generator.normal()` draws.

    Args:
        rngs: Generators, as in `SensorInput`.
        i: Place of the robot among them.

    Returns:
        The number.
    """
    # 1 - u is never 0, so the logarithm is finite.
    radius = math.sqrt(-2.0 * math.log(1.0 - draw_uniform(rngs, i)))
    return radius * math.cos(2.0 * math.pi * draw_uniform(rngs, i))


class SensorInput(NamedTuple):
    """What a sensor may know of the n robots that it reads, a row or an item for each robot."""

    pose: Floats
    """(n, 3): True pose in the frame of the world: x [m], y [m], theta [rad]. NaN on hardware."""
    twist: Floats
    """(n, 2): True forward speed [m/s] and yaw rate [rad/s]. NaN on hardware."""
    contact: NDArray[np.bool_]
    """(n,): Whether the robot has touched an obstacle since the reset. NaN on hardware."""
    now: Floats
    """(n,): Time on the link's clock [s]."""
    scenes: Any
    """n `Scene` objects: worlds, starts and goals. None for a compiled sensor in a batch."""
    rngs: Any
    """n generators, from which all random numbers of the sensor must come. A compiled sensor draws
    with `draw_uniform(rngs, i)` and `draw_normal(rngs, i)`."""
    memory: Any
    """The sensor's `memory` by name, each (n,). The items can be changed."""


class Sensor:
    """Something that a robot senses, which adds `size` numbers to the observation.

    A subclass sets `name`, `size`, `low` and `high`, and implements `read`, which reads n robots at
    once. The single env calls it with one robot, a batch with all its robots. The class itself is a
    factory, `Compass(link, config)`, for `RobotEnv(sensors=[Compass])`, the `sensors` of a Task, or
    `Robot(link, config, [Compass])`. A function `factory(link, config)` may choose another sensor
    for a real robot, for which `link.truth` is None.

    If `compiled` is True, numba compiles `reset` and `read` for batches, by the rules of a compiled
    task: `self` is then a named tuple of the sensor's numbers.

    Attributes:
        name: Name in errors. No two sensors of a robot may have the same.
        size: How many numbers it adds to the observation.
        low: Their least values, as in the observation: a number, or (size,).
        high: Their largest values.
        needs: Names of the robot's sensors that this sensor uses, which are then in `needed`.
        memory: Name and first value of each number that an episode remembers.
        compiled: Whether numba compiles the sensor for batches.
        link: The wire to the robot. In a batch, the closed link of a simulated robot.
        config: The robot's parameters. In a fleet, those of the first robot.
        odometry: The robot's odometry. Its `pose` and `twist` change as it drives. Not in a batch.
        needed: The sensors that `needs` names. Not in a batch.

    Args:
        link: The wire to the robot.
        config: The robot's parameters.

    Example:
        >>> import numpy as np
        >>> from acsar_gym import Robot, Sensor, open_link
        >>> class Compass(Sensor):
        ...     name, size, low, high = "compass", 2, -1.0, 1.0
        ...
        ...     def read(self, robots, out):
        ...         theta = robots.pose[:, 2]
        ...         out[:] = np.column_stack([np.cos(theta), np.sin(theta)])
        >>> with Robot(open_link("planar"), sensors=[Compass]) as robot:
        ...     robot.read().tolist()
        [1.0, 0.0]
    """

    name: str
    size: int
    low: Bound = -math.inf
    high: Bound = math.inf
    needs: ClassVar[tuple[str, ...]] = ()
    memory: ClassVar[Mapping[str, float]] = {}
    compiled: ClassVar[bool] = False
    odometry: Odometry
    needed: Mapping[str, Sensor]

    def __init__(self, link: Link, config: RobotConfig) -> None:
        self.link = link
        self.config = config

    def connect(self, odometry: Odometry, needed: Mapping[str, Sensor]) -> None:
        """Take over what changes as a robot drives. Called once, when the robot is made.

        Args:
            odometry: Odometry of the robot.
            needed: The sensors that `needs` names.
        """
        self.odometry = odometry
        self.needed = needed

    def reset(self, robots: SensorInput) -> None:
        """Start episodes. A sensor with a device opens it here, if it isn't open.

        Args:
            robots: Robots that start an episode. Their memory has the first values.

        Raises:
            LinkError: The device can't be opened, or doesn't measure.
        """

    def poll(self, truth: GroundTruth | None, now: float) -> None:
        """Take a measurement, if one is due. Called at a reset and after every tick.

        It is for devices with a clock of their own, and only for single robots.

        Args:
            truth: What only a simulator knows, in the scene's frame. None on hardware.
            now: Time on the link's clock [s].
        """

    def read(self, robots: SensorInput, out: Floats) -> None:
        """Read the sensor's numbers for the observation, once a step, after its last tick.

        Args:
            robots: What is known of the robots.
            out: (n, size): To be filled with finite numbers.

        Raises:
            LinkError: The device is gone or silent. The robot is then stopped, as by any error.
        """
        raise NotImplementedError

    def info(self, robots: SensorInput) -> Mapping[str, Any]:
        """Return numbers for the env's info, each (n,). The keys must be the same at every step.

        Args:
            robots: What is known of the robots.
        """
        return {}

    def close(self) -> None:
        """Close the device. Idempotent."""

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """`low` and `high` as arrays of shape (size,)."""
        low = np.asarray(self.low, np.float64)
        high = np.asarray(self.high, np.float64)
        return np.broadcast_to(low, (self.size,)), np.broadcast_to(high, (self.size,))

    @property
    def layout(self) -> str:
        """Name, size and bounds in words. A policy fits an env whose sensors have the same."""
        low, high = self.bounds
        return f"{self.name}[{self.size}] from {low.min():g} to {high.max():g}"


SENSOR_METHODS = ("reset", "read")
"""The methods that a batch compiles if a sensor is compiled."""


def find_sensor(sensors: Iterable[Sensor], name: str) -> Any:
    """The sensor with this name. None if there is none."""
    return next((sensor for sensor in sensors if sensor.name == name), None)


def new_memory(sensor: Sensor, robots: int) -> Floats:
    """Make the memory of some robots, (names, robots), with the first values."""
    # A row for each number, so that a number of all robots is contiguous.
    first = np.array(list(sensor.memory.values()), np.float64)
    return first.reshape(-1, 1).repeat(robots, axis=1)


def name_memory(sensor: Sensor, rows: Floats) -> Any:
    """Make the named tuple of a memory's rows. None if the sensor remembers nothing."""
    if not sensor.memory:
        return None
    return named_tuple(type(sensor), "Memory", tuple(sensor.memory))(*rows)


Factory = Callable[[Link, RobotConfig], Sensor]
"""Makes a robot's sensor, as a subclass does."""
