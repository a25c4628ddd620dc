"""The contract of links: what every link does, and what some of them can do in addition."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextvars import ContextVar
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from acsar_gym.physics.body import Camera
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Scene

if TYPE_CHECKING:
    from acsar_gym.links.ros2 import Ros2Link

WHILE_WAITING: ContextVar[Callable[[], None]] = ContextVar("while_waiting", default=lambda: None)
"""Called repeatedly while a reset waits for a port, a board, wheels or a LiDAR. An exception that
it raises ends the wait."""

Arrivals = Sequence[tuple[float, bytes]]
"""Pieces of feedback, each with the time at which its last byte arrived [s]."""


class RecordedScans(Protocol):
    """The LiDAR of a recording."""

    def revolution(self) -> tuple[float, NDArray[np.float64]] | None:
        """Return the newest revolution. None if there is none.

        Returns:
            Its end [s], and bearings [rad], distances [m] and times [s], of shape (3, n).
        """


class Link:
    """A connection to a robot, real or simulated. Time passes only in `advance`.

    A subclass overrides the methods, and the abilities that it has.

    Attributes:
        is_real: Whether its wheels can hurt people. A replay of a real drive isn't real.
        device: Name of the device, or the URL. Empty if the link has none.
        stamped: Whether `arrivals` are lines, each with the time at which the robot measured it.
            Odometry then integrates each line up to its own time, as the robot's driver does.
        lateness: Time from the newest period's deadline to its end [s]. None if time is simulated.
        metered: Set it to True to measure `work`, which takes time in every period.
        work: Mechanical work of the motors since the reset [J]. NaN if the link can't measure it.

    Example:
        A robot that never moves:

        >>> from acsar_gym import Link, Robot, protocol
        >>> class Parked(Link):
        ...     seconds = 0.0
        ...     def open(self): ...
        ...     def reset(self, scene): ...
        ...     def write(self, data): ...
        ...     def advance(self, period):
        ...         self.seconds += period
        ...         return protocol.encode(protocol.ZERO)
        ...     def now(self):
        ...         return self.seconds
        ...     def close(self): ...
        >>> with Robot(Parked()) as robot:
        ...     robot.drive(0.1, 0.0)
        ...     robot.odometry.pose
        (0.0, 0.0, 0.0)
    """

    is_real: bool = False
    device: str = ""
    stamped: bool = False
    lateness: float | None = None
    metered: bool = False
    work: float = float("nan")

    @property
    def truth(self) -> GroundTruth | None:
        """Ground truth of a simulation. None on hardware. Never part of an observation."""
        return None

    @property
    def arrivals(self) -> Arrivals:
        """Bytes of the newest period, with the time at which each piece arrived.

        The times are exact in simulation, and within 1 ms on a serial device, which notes them
        only in the period after each call. Empty if the link doesn't know them.
        """
        return ()

    @property
    def camera(self) -> Camera | None:
        """Draws pictures of a simulation. None if the link has no camera."""
        return None

    @property
    def scans(self) -> RecordedScans | None:
        """The LiDAR of a recording. None for any other link."""
        return None

    @property
    def ros(self) -> Ros2Link | None:
        """The link to ROS 2 that this link is, or wraps. None without ROS."""
        return None

    @property
    def commands_sides(self) -> bool:
        """Whether the robot takes only one speed for each of its sides. Known while open."""
        return False

    @property
    def unwatched(self) -> str:
        """Why no watchdog watches the open link. Empty if one does, or none is needed."""
        return ""

    def open(self) -> None:
        """Connect, so that commands can be sent on return. Idempotent.

        Raises:
            LinkError: The connection failed. Nothing stays open.
        """
        raise NotImplementedError

    def reset(self, scene: Scene) -> None:
        """Start an episode with the robot at rest.

        Args:
            scene: Start, goal, world and physics. Only simulated links use it.
        """
        raise NotImplementedError

    def write(self, data: bytes) -> None:
        """Send bytes to the robot.

        Args:
            data: Whole command lines.

        Raises:
            LinkLostError: The device is gone.
        """
        raise NotImplementedError

    def advance(self, period: float) -> bytes:
        """Let one control period pass.

        Args:
            period: Duration [s].

        Returns:
            The bytes that arrived during it.
        """
        raise NotImplementedError

    def now(self) -> float:
        """Return the time on the link's own clock [s]."""
        raise NotImplementedError

    def clock(self) -> float:
        """Return the link's time for a device that measures between periods [s].

        It differs from `now` only for recorded links, where `now` is still between periods.
        """
        return self.now()

    def close(self) -> None:
        """Stop the motors, then close the connection. Idempotent."""
        raise NotImplementedError


class LinkWrapper(Link):
    """A link around another link, which forwards whatever a subclass doesn't override.

    Attributes:
        inner: The wrapped link.
    """

    def __init__(self, inner: Link) -> None:
        self.inner = inner


def _forwarded(name: str) -> property:
    """A property that is the same attribute or method of the wrapped link."""

    def read(wrapper: LinkWrapper) -> object:
        return getattr(wrapper.inner, name)

    def write(wrapper: LinkWrapper, value: object) -> None:
        setattr(wrapper.inner, name, value)

    return property(read, write)


# A wrapper has each method and each ability that `Link` declares, also those of later versions.
for _name in vars(Link):
    if not _name.startswith("_"):
        setattr(LinkWrapper, _name, _forwarded(_name))
