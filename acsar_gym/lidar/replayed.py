"""A LiDAR that plays the revolutions of a recording."""

from __future__ import annotations

import numpy as np

from acsar_gym.errors import LidarError
from acsar_gym.lidar.scan import Floats, Revolution
from acsar_gym.lidar.simulated import OLDEST_SIMULATED, draw_episode
from acsar_gym.links.base import Link, RecordedScans
from acsar_gym.worlds import Scene


class ReplayedLidar:
    """Plays the revolutions of a recording together with the bytes of its wire.

    Attributes:
        oldest: Largest age that a measurement of a simulated LiDAR reaches in the episode [s].
    """

    oldest = 0.0

    def __init__(self, tape: RecordedScans, link: Link) -> None:
        self._tape = tape
        self._link = link
        self._measured: Floats | None = None
        self._newest: Revolution | None = None

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Start an episode."""
        self._newest = None
        if self._link.truth is not None:
            draw_episode(rng)  # as the simulated LiDAR did in the recording
            self.oldest = OLDEST_SIMULATED

    def scan(self) -> Revolution:
        """Return the revolution that was the newest. LidarError if none was recorded."""
        newest = self._tape.revolution()
        if newest is None:
            raise LidarError(
                "the recording has no revolutions of a LiDAR",
                "it was made without a LiDAR, or by a version that kept only the scans: record "
                "again",
            )
        # The same revolution object, as long as the recording has no newer one.
        stamp, measured = newest
        if self._newest is None or measured is not self._measured:
            self._measured = measured
            self._newest = Revolution(measured[0], measured[1], measured[2], stamp=stamp)
        return self._newest

    def close(self) -> None:
        """Do nothing, because there is no device."""
