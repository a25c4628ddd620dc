"""A simulated link in real time, for windows and keyboard control."""

from __future__ import annotations

import time

from acsar_gym.bodies.base import Camera, GroundTruth
from acsar_gym.links.base import Arrivals, Link, arrivals_of, camera_of
from acsar_gym.worlds import Scene


class PacedLink:
    """Forwards to another link; `advance` doesn't return before its absolute deadline.

    Clock and bytes are those of the inner link.

    Args:
        link: the inner link.
    """

    def __init__(self, link: Link) -> None:
        self.link = link
        self._deadline = time.monotonic()

    def open(self) -> None:
        """Open the link."""
        self.link.open()

    def reset(self, scene: Scene) -> None:
        """Reset the link and restart the deadlines."""
        self.link.reset(scene)
        self._deadline = time.monotonic()

    def write(self, data: bytes) -> None:
        """Send bytes to the link."""
        self.link.write(data)

    def advance(self, period: float) -> bytes:
        """Advance the link, then wait for the deadline; missed deadlines are skipped."""
        got = self.link.advance(period)
        self._deadline = max(self._deadline + period, time.monotonic() - period)
        time.sleep(max(0.0, self._deadline - time.monotonic()))
        return got

    def now(self) -> float:
        """Return the time on the link's clock [s]."""
        return self.link.now()

    @property
    def truth(self) -> GroundTruth | None:
        """Ground truth of the link."""
        return self.link.truth

    @property
    def lateness(self) -> float | None:
        """Lateness of the link, which is None, as its time is simulated."""
        return self.link.lateness

    @property
    def arrivals(self) -> Arrivals:
        """When the bytes of the newest period arrived, on the link's clock [s]."""
        return arrivals_of(self.link)

    @property
    def camera(self) -> Camera | None:
        """Camera of the link."""
        return camera_of(self.link)

    def close(self) -> None:
        """Close the link."""
        self.link.close()
