"""The interface of links."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from acsar_gym.bodies.base import Camera, GroundTruth
from acsar_gym.worlds import Scene


class Link(Protocol):
    """A connection to a robot, real or simulated. Time passes only in `advance`."""

    @property
    def lateness(self) -> float | None:
        """Time from the newest period's deadline to its end [s]; None if time is simulated."""

    @property
    def truth(self) -> GroundTruth | None:
        """Ground truth of a simulation; None on hardware. Never part of an observation."""

    def open(self) -> None:
        """Connect, so that commands can be sent on return. Idempotent.

        Raises:
            LinkError: the connection failed; nothing stays open then.
        """

    def reset(self, scene: Scene) -> None:
        """Start an episode with the robot at rest.

        Args:
            scene: start, goal, world and physics; used by simulated links only.
        """

    def write(self, data: bytes) -> None:
        """Send bytes to the robot.

        Raises:
            LinkLostError: the device is gone.
        """

    def advance(self, period: float) -> bytes:
        """Let one control period pass.

        Args:
            period: duration [s].

        Returns:
            The bytes that arrived during it.
        """

    def now(self) -> float:
        """Return the time on the link's own clock [s]."""

    def close(self) -> None:
        """Stop the motors, then close the connection. Idempotent."""


@runtime_checkable
class CameraLink(Protocol):
    """A link that may have a camera: a simulated one, or a wrapper around one."""

    @property
    def camera(self) -> Camera | None:
        """The camera; None if there is none."""


def camera_of(link: Link) -> Camera | None:
    """Return the camera of a link; None if it has none, as on hardware."""
    return link.camera if isinstance(link, CameraLink) else None
