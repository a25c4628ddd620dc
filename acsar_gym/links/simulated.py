"""Links to a simulated robot: emulated firmware on a body, as fast as possible or in real time."""

from __future__ import annotations

import time
from collections.abc import Callable

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LinkLostError
from acsar_gym.links.base import Arrivals, Link, LinkWrapper
from acsar_gym.physics.body import Body, Camera
from acsar_gym.physics.firmware import Firmware
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Scene
from acsar_gym.worlds.crowd import Crowd

WHOLE_PERIOD = 0.999
"""Share of a control period that counts as a whole period: times are sums of periods, and an
emulated board is advanced by shorter ones."""


class SimulatedLink(Link):
    """Runs firmware and physics as fast as possible. Its clock is 0 at every reset.

    Attributes:
        body: The physics. None while the link is closed.
    """

    def __init__(self, config: RobotConfig, make_body: Callable[[], Body]) -> None:
        self.body: Body | None = None
        self.work = 0.0
        self._config = config
        self._make_body = make_body
        self._firmware: Firmware | None = None
        self._crowd: Crowd | None = None
        self._now = 0.0

    def open(self) -> None:
        """Make the body and start the firmware."""
        if self.body is None:
            self.body = self._make_body()
            self._firmware = Firmware(self._config, self.body)

    def reset(self, scene: Scene) -> None:
        """Put the robot at rest at the scene's start, with the scene's world and physics."""
        self.open()
        if self.body is None or self._firmware is None:
            raise _closed_error()
        self.body.reset(scene)
        # After the body, because the encoders start at its wheels' angles.
        self._firmware.reset(scene.physics)

        self._crowd = None
        if scene.world is not None and scene.world.movers:
            self._crowd = Crowd(scene.world, self._config, scene.key)
            self.body.place_movers(self._crowd)
        self._now = 0.0
        self.work = 0.0

    def write(self, data: bytes) -> None:
        """Send bytes over the simulated UART. LinkLostError if the link is closed."""
        if self._firmware is None:
            raise _closed_error()
        self._firmware.receive(data)

    def advance(self, period: float) -> bytes:
        """Simulate one period [s]. Returns the bytes that arrived during it."""
        body = self.body
        if body is None or self._firmware is None:
            raise _closed_error()
        # Firmware and body first: movers meet the robot where it is now.
        self._now += period
        data = self._firmware.advance(period)

        if self._crowd is not None:
            self._advance_crowd(body, self._crowd)
        body.feel()
        if self.metered:
            self.work += body.power * period
        return data

    def _advance_crowd(self, body: Body, crowd: Crowd) -> None:
        """Move the crowd once per control period, however short the link's periods are."""
        while self._now - crowd.now > WHOLE_PERIOD * self._config.period:
            truth = body.truth
            crowd.advance(truth.pose, truth.twist)
            body.place_movers(crowd)

    def now(self) -> float:
        """Return the simulated time since the reset [s]."""
        return self._now

    @property
    def arrivals(self) -> Arrivals:
        """When the lines of the newest period arrived [s], exactly."""
        return self._firmware.arrived if self._firmware else ()

    @property
    def truth(self) -> GroundTruth:
        """State of the body and the movers. The origin before the link is opened."""
        truth = self.body.truth if self.body else GroundTruth()
        crowd = self._crowd
        # A mover that hits the robot is a contact, even if the body didn't feel it.
        if crowd is None:
            return truth
        return GroundTruth(truth.pose, truth.twist, truth.contact or crowd.hit > 0.0, crowd)

    @property
    def camera(self) -> Camera | None:
        """Camera of the body. None if it has none, or the link is closed."""
        return self.body if isinstance(self.body, Camera) else None

    def __reduce__(self) -> tuple[type[SimulatedLink], tuple[RobotConfig, Callable[[], Body]]]:
        """Copy as a closed link with its own robot."""
        return SimulatedLink, (self._config, self._make_body)

    def close(self) -> None:
        """Free the body. Idempotent."""
        if self.body is not None:
            self.body.close()
            self.body = None
            self._firmware = None
            self._crowd = None


def _closed_error() -> LinkLostError:
    return LinkLostError("the simulated link is closed", "call open() or env.reset() first")


class PacedLink(LinkWrapper):
    """A simulated link in real time, for windows and keyboard control.

    `advance` doesn't return before its absolute deadline. Clock and bytes are those of the
    simulated link.

    Args:
        inner: The simulated link.
        speed: How fast its time passes, as a multiple of real time.
    """

    def __init__(self, inner: Link, speed: float = 1.0) -> None:
        super().__init__(inner)
        self._speed = speed
        self._deadline = time.monotonic()

    def reset(self, scene: Scene) -> None:
        """Reset the link and restart the deadlines."""
        super().reset(scene)
        self._deadline = time.monotonic()

    def advance(self, period: float) -> bytes:
        """Advance the link, then wait for the deadline. Missed deadlines are skipped."""
        data = super().advance(period)
        real_period = period / self._speed
        # After a pause the deadlines start again, instead of catching up.
        self._deadline = max(self._deadline + real_period, time.monotonic() - real_period)
        time.sleep(max(0.0, self._deadline - time.monotonic()))
        return data
