"""What a sensor of a batch is told of its robot: the truth, the time and the scene, but no wire."""

from __future__ import annotations

from typing import NamedTuple, NoReturn, Protocol

import numpy as np
from numpy.typing import NDArray

from acsar_gym.bodies.base import GroundTruth
from acsar_gym.errors import LinkError
from acsar_gym.vector.pcg import Generators
from acsar_gym.worlds import Scene

Floats = NDArray[np.float64]
Robots = NDArray[np.int64]
"""Numbers of robots."""


class Truths(NamedTuple):
    """The ground truth of some robots, one row each, in the frames of their worlds."""

    pose: Floats
    """(robots, 3): x [m], y [m], theta [rad]."""
    twist: Floats
    """(robots, 2): forward speed [m/s], yaw rate [rad/s]."""
    contact: NDArray[np.bool_]
    """(robots,): whether the robot has touched an obstacle since the reset."""


class Source(Protocol):
    """What sensors need of a batch."""

    random: Generators

    def truths(self, robots: Robots) -> Truths:
        """Of these robots."""

    def now(self, robots: Robots) -> Floats:
        """Time on their links' clocks [s], (robots,)."""

    def scenes(self, robots: Robots) -> list[Scene]:
        """The worlds of their episodes, and their starts in them."""


class RobotLink:
    """What a sensor in a batch knows of its robot's link: the truth and the time, but no wire."""

    lateness: float | None = None

    def __init__(self, source: Source, robot: int) -> None:
        self._source = source
        self._robots = np.array([robot])

    @property
    def truth(self) -> GroundTruth:
        """Where the robot is now."""
        (x, y, theta), (forward, rate), contact = (
            array[0].tolist() for array in self._source.truths(self._robots)
        )
        return GroundTruth((x, y, theta), (forward, rate), contact)

    def now(self) -> float:
        """Seconds of simulated time since the reset."""
        return float(self._source.now(self._robots)[0])

    def open(self) -> None:
        """Nothing to open."""

    def reset(self, scene: Scene) -> None:
        """The batch resets its robots."""

    def close(self) -> None:
        """Nothing to close."""

    def write(self, data: bytes) -> NoReturn:
        """There is no wire."""
        raise LinkError("a robot of a batch has no wire", "use the single env")

    def advance(self, period: float) -> NoReturn:
        """There is no wire."""
        raise LinkError("a robot of a batch has no wire", "use the single env")
