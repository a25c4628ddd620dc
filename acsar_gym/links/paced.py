"""A simulated link held to real time, for windows and people at the keyboard."""

from __future__ import annotations

import time

from acsar_gym.bodies.base import Camera, GroundTruth
from acsar_gym.links.base import Link, camera_of
from acsar_gym.worlds import Scene


class PacedLink:
    """Passes everything on; `advance` returns no sooner than its absolute deadline.

    The clock and the bytes stay those of the link behind it.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self._deadline = time.monotonic()

    def open(self) -> None:
        """Open the link."""
        self._link.open()

    def reset(self, scene: Scene) -> None:
        """Reset the link and begin a new row of deadlines."""
        self._link.reset(scene)
        self._deadline = time.monotonic()

    def write(self, data: bytes) -> None:
        """Pass on."""
        self._link.write(data)

    def advance(self, period: float) -> bytes:
        """Advance the link, then wait for the deadline; one that is long gone is forgotten."""
        got = self._link.advance(period)
        self._deadline = max(self._deadline + period, time.monotonic() - period)
        time.sleep(max(0.0, self._deadline - time.monotonic()))
        return got

    def now(self) -> float:
        """The link's clock."""
        return self._link.now()

    @property
    def truth(self) -> GroundTruth | None:
        """The link's truth."""
        return self._link.truth

    @property
    def lateness(self) -> float | None:
        """The link's lateness: its time stays simulated, however long it is held up."""
        return self._link.lateness

    @property
    def camera(self) -> Camera | None:
        """The link's camera."""
        return camera_of(self._link)

    def close(self) -> None:
        """Close the link."""
        self._link.close()
