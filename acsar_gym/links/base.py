"""The contract of links, what some of them can do besides, and a link around another one."""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from acsar_gym.physics.body import Camera
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Scene

WHILE_WAITING: ContextVar[Callable[[], None]] = ContextVar("while_waiting", default=lambda: None)
"""Called again and again while a reset waits for a port, board, standing wheels or LiDAR; what it
raises ends the wait."""

Arrivals = list[tuple[float, bytes]]  # pieces, and when the last byte of each arrived [s]


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

        Args:
            data: whole command lines.

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


class ScannedLink(Protocol):
    """A link that has the revolutions of a LiDAR: a recording."""

    def revolution(self) -> tuple[float, NDArray[np.float64]] | None:
        """End [s], and bearings [rad], distances [m] and times [s], (3, n), of the newest one.

        None if there is none.
        """

    def oldest_measurement(self) -> float:
        """Age that one of its measurements reaches while its revolution is the newest one [s]."""


class MeteredLink(Protocol):
    """A simulated link, which can measure the work of the robot's motors."""

    metered: bool
    """Whether the work is measured; False at first, because it takes time in every period."""
    work: float
    """Mechanical work of the motors since the reset [J]: the power at the end of every period,
    see `Body.power`, times the period."""


def camera_of(link: Link) -> Camera | None:
    """Return the camera of a link; None if it has none, as on hardware."""
    camera: Camera | None = getattr(link, "camera", None)
    return camera


def arrivals_of(link: Link) -> Arrivals:
    """When the bytes of the newest period arrived, noted in the period after each call.

    To 1 ms or better on a serial device, exactly in simulation, nothing for links that don't know.
    """
    pieces: Arrivals = getattr(link, "arrivals", [])
    return pieces


def echoes_of(link: Link) -> bool | None:
    """Return whether the board behind a link sends every command back; None where none is real."""
    echoes: bool | None = getattr(link, "echoes", None)
    return echoes


def commands_sides(link: Link) -> bool:
    """Return whether the robot behind an open link takes one speed for each of its sides alone."""
    return bool(getattr(link, "commands_sides", False))


def tape_of(link: Link) -> ScannedLink | None:
    """Return the link, or the one that it wraps, that has the scans of a recording; or None."""
    tape: ScannedLink | None = _find_inner(link, "revolution")
    return tape


def is_stamped(link: Link) -> bool:
    """Return whether a link's `arrivals` are lines, and the times at which the robot measured them.

    Odometry then integrates each line up to its own time, as the robot's own driver does.
    """
    return bool(getattr(link, "stamped", False))


def ros_link_of(link: Link) -> Any:
    """Return the `links.ros2.Ros2Link`, or the one that a link wraps; None where there is none."""
    return _find_inner(link, "epoch")


def clock_of(link: Link) -> Callable[[], float]:
    """Return the clock of a link as it goes on between periods, for a device that measures [s].

    `link.now` itself stands still there where the link is recorded.
    """
    recorded = _find_inner(link, "clock")
    clock: Callable[[], float] = link.now if recorded is None else recorded.clock
    return clock


def meter_of(link: Link) -> MeteredLink | None:
    """Return the link, or the one that it wraps, that can measure work; None on hardware."""
    meter: MeteredLink | None = _find_inner(link, "metered")
    return meter


def _find_inner(link: Any, attribute: str) -> Any:
    """The link, or the outermost one that it wraps, with an attribute; None where none has it."""
    while link is not None and not hasattr(link, attribute):
        link = getattr(link, "link", None)
    return link


class ForwardingLink:
    """Forwards everything to the link inside; subclasses override what they change.

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
    def stamped(self) -> bool:
        """Whether `arrivals` tells when each line was measured."""
        return is_stamped(self.link)

    @property
    def commands_sides(self) -> bool:
        """Whether the link's robot takes speeds of its sides alone."""
        return commands_sides(self.link)

    @property
    def echoes(self) -> bool | None:
        """Whether the board of the link echoes."""
        return echoes_of(self.link)

    @property
    def truth(self) -> GroundTruth | None:
        """Ground truth of the link."""
        return self.link.truth

    @property
    def lateness(self) -> float | None:
        """Lateness of the link's newest period [s]; None where time is simulated."""
        return self.link.lateness

    @property
    def unwatched(self) -> str:
        """Why no watchdog watches the link; empty where one does, or where it needs none."""
        return str(getattr(self.link, "unwatched", ""))

    @property
    def camera(self) -> Camera | None:
        """Camera of the link."""
        return camera_of(self.link)
