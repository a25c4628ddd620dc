"""LiDARs: scans of ranges around the robot, simulated by analytic rays or from a real device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from acsar_gym.worlds import Scene


@dataclass(frozen=True, eq=False, slots=True)
class Scan:
    """One turn of the sensor."""

    ranges: NDArray[np.float64]
    """(rays,): range in each direction [m], within min_range to max_range, counter-clockwise from
    -field_of_view / 2 of the robot's x axis; max_range where nothing was measured."""
    stamp: float
    """When the turn ended, on the link's clock [s]."""


class Lidar(Protocol):
    """A range sensor, simulated or real. Its scans are stamped on the clock of the robot's link."""

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Begin an episode; opens a closed device. Raises LidarError, which says what to do."""

    def scan(self) -> Scan:
        """The newest scan; waits for nothing. Raises LidarError where it is older than the
        configured time-out, or the device is gone."""

    def close(self) -> None:
        """Stop the motor and let go of the device; twice is once."""
