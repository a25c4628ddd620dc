"""The watchdog of one link, from its opening to its closing, or none."""

from __future__ import annotations

import math

from acsar_gym.config import RobotConfig
from acsar_gym.links import watchdog
from acsar_gym.links.open_port import OpenPort
from acsar_gym.links.ports import Location
from acsar_gym.links.watchdog import Watchdog


class WatchdogHandle:
    """Starts, tells and ends the watchdog that a config wants, where a port can be shared.

    Whoever calls sees to it that no two threads do so at once, but for `wait`. `watchdog` is the
    watchdog, None where there is none; `nap` how long its link may sleep between beats [s].
    """

    def __init__(self, config: RobotConfig, location: Location, zeros: bytes) -> None:
        self._timeout = config.watchdog_timeout
        self._location = location
        self._zeros = zeros
        self.watchdog: Watchdog | None = None
        self.nap = math.inf

    def start(self, port: OpenPort) -> None:
        """Start the watchdog; LinkError where that fails."""
        descriptor = port.fileno()
        if self._timeout is None or not watchdog.AVAILABLE or descriptor is None:
            return
        name = self._location.path if self._location.path and self._location.lasts else ""
        self.watchdog = Watchdog(descriptor, self._zeros, self._timeout, name)
        self.nap = self._timeout / 3.0

    def renew(self, port: OpenPort) -> bool:
        """Start another one in place of one that doesn't run any more; whether it was so."""
        running = self.watchdog
        if running is None or running.alive:
            return False
        self.watchdog = None
        running.close()
        self.start(port)
        return True

    def wait(self) -> None:
        """Return when it watches; LinkError where it doesn't come to that."""
        if (running := self.watchdog) is not None:
            running.wait()

    @property
    def alive(self) -> bool:
        """Whether there is one, and it runs."""
        return (running := self.watchdog) is not None and running.alive

    @property
    def pid(self) -> int | None:
        """Its process; None where there is none."""
        return None if (running := self.watchdog) is None else running.pid

    def rearm(self) -> None:
        """Let a robot that it stopped drive again."""
        if (running := self.watchdog) is not None:
            running.rearm()

    def beat(self) -> None:
        """The program is alive."""
        if (running := self.watchdog) is not None:
            running.beat()

    def stand(self) -> None:
        """A zero command went out."""
        if (running := self.watchdog) is not None:
            running.stand()

    def drive(self) -> None:
        """A command that turns wheels goes out now. LinkError where nobody watches any more."""
        if (running := self.watchdog) is not None:
            running.drive()

    def driven(self) -> None:
        """A command that turns wheels went out. LinkError where the robot was stopped meanwhile."""
        if (running := self.watchdog) is not None:
            running.driven()

    def end(self, *, lost: bool) -> None:
        """End it; where the port is lost it goes on commanding zero when that is there again."""
        running, self.watchdog = self.watchdog, None
        if running is not None and lost:
            running.search(self._name)
        elif running is not None:
            running.close()

    def end_search(self) -> None:
        """End a search of before: not before the port is there, for it may stay lost."""
        watchdog.call_back(self._name)

    def abandon(self) -> None:
        """Let go without a word, as a forked child must do."""
        running, self.watchdog = self.watchdog, None
        if running is not None:
            running.abandon()

    @property
    def _name(self) -> str:
        return self._location.path or self._location.name
