"""The contract of everything that can stand on the other side of the wire."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from acsar_gym.bodies.base import Camera, GroundTruth
from acsar_gym.worlds import Scene


class Link(Protocol):
    """A wire to a robot, real or simulated. `advance` is the only place in which time passes."""

    @property
    def lateness(self) -> float | None:
        """How long after its deadline the newest period ended [s]; None where time is simulated."""

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

    def close(self) -> None:
        """Stop the motors, then close; idempotent."""


@runtime_checkable
class CameraLink(Protocol):
    """A link behind which a camera may stand: a simulated one, or one that passes on to it."""

    @property
    def camera(self) -> Camera | None:
        """The camera; None where there is none."""


def camera_of(link: Link) -> Camera | None:
    """The camera that sees the robot behind a link; None where there is none, as on hardware."""
    return link.camera if isinstance(link, CameraLink) else None
