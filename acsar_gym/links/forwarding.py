"""A link around another one."""

from __future__ import annotations

from acsar_gym.bodies.base import Camera, GroundTruth
from acsar_gym.links.base import Arrivals, Link, arrivals_of, camera_of
from acsar_gym.worlds import Scene


class ForwardingLink:
    """Forwards everything to the link inside; subclasses override what they change.

    Args:
        link: the link inside.

    Attributes: `link`, the one inside.
    """

    def __init__(self, link: Link) -> None:
        self.link = link

    def open(self) -> None:
        """Open the link."""
        self.link.open()

    def reset(self, scene: Scene) -> None:
        """Begin an episode."""
        self.link.reset(scene)

    def write(self, data: bytes) -> None:
        """Send bytes to the link."""
        self.link.write(data)

    def advance(self, period: float) -> bytes:
        """Let a period pass [s]; returns the bytes that arrived in it."""
        return self.link.advance(period)

    def now(self) -> float:
        """Return the time on the link's clock [s]."""
        return self.link.now()

    def close(self) -> None:
        """Close the link."""
        self.link.close()

    @property
    def arrivals(self) -> Arrivals:
        """When the bytes of the newest period arrived, on the link's clock [s]."""
        return arrivals_of(self.link)

    @property
    def truth(self) -> GroundTruth | None:
        """Ground truth of the link."""
        return self.link.truth

    @property
    def lateness(self) -> float | None:
        """Lateness of the link's newest period [s]; None where time is simulated."""
        return self.link.lateness

    @property
    def camera(self) -> Camera | None:
        """Camera of the link."""
        return camera_of(self.link)
