"""The contract of everything that can stand on the other side of the wire."""

from __future__ import annotations

from typing import Protocol

from acsar_gym.bodies.base import GroundTruth, Image
from acsar_gym.worlds import Scene


class Link(Protocol):
    """A wire to a robot, real or simulated. `advance` is the only place in which time passes.

    A link on which that is the wall clock's time also has `lateness`: how long after its deadline
    the newest period ended [s].
    """

    @property
    def late_ticks(self) -> int:
        """Periods that ended over a millisecond after their deadline; always 0 in simulation."""

    @property
    def truth(self) -> GroundTruth | None:
        """What only a simulator knows; None on hardware. Never feeds an observation."""

    def open(self) -> None:
        """Ready for commands when it returns; opening an open link does nothing.

        Raises LinkError, which says what to do, and leaves no half-open port behind.
        """

    def reset(self, scene: Scene) -> None:
        """Begin an episode at rest; a simulated link also builds the scene."""

    def write(self, data: bytes) -> None:
        """Put bytes on the wire. Raises LinkLostError where the device is gone."""

    def advance(self, period: float) -> bytes:
        """Let one control period [s] pass; return the bytes that arrived in it."""

    def now(self) -> float:
        """Seconds on the link's own clock."""

    def image(self, width: int, height: int) -> Image | None:
        """A camera's picture of the scene, height x width x 3; None where there is no camera."""

    def close(self) -> None:
        """Stop the motors, then close; twice is once."""
