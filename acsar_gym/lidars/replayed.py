"""The LiDAR of a recording: the scans that were recorded, each at its time."""

from __future__ import annotations

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LidarError
from acsar_gym.lidars.base import Scan
from acsar_gym.lidars.simulated import draws
from acsar_gym.links.base import Link, ScannedLink
from acsar_gym.worlds import Scene


class ReplayedLidar:
    """Plays the scans of a recording, beside the bytes of its wire.

    Args:
        tape: the link that replays it.
        link: the robot's link, with the recorded ground truth where the recording was a simulation.
        config: of the robot.
    """

    def __init__(self, tape: ScannedLink, link: Link, config: RobotConfig) -> None:
        self._tape = tape
        self._link = link
        self._config = config
        self._rng = np.random.default_rng(0)
        self._scan: Scan | None = None

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Begin an episode."""
        self._rng = rng
        self._scan = None

    def scan(self) -> Scan:
        """Return the scan that was the newest one; LidarError where none was recorded."""
        found = self._tape.scan()
        if found is None:
            raise LidarError("the recording has no scan", "was it made with a LiDAR?")
        stamp, ranges = found
        rays = self._config.lidar.rays
        if len(ranges) != rays:
            raise LidarError(
                f"the recording's scans have {len(ranges)} rays, the robot's LiDAR {rays}",
                "replay it with the robot that was recorded",
            )
        if self._scan is None or stamp != self._scan.stamp:
            self._scan = Scan(ranges, stamp)
            if self._link.truth is not None:  # a simulated LiDAR drew noise here
                self._rng.random(draws(self._config.lidar))
        return self._scan

    def close(self) -> None:
        """Do nothing: there is no device."""
