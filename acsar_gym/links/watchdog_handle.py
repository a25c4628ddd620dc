"""Manages the watchdog of one link, if it has one."""

from __future__ import annotations

import math

from acsar_gym.config import RobotConfig
from acsar_gym.links import watchdog
from acsar_gym.links.open_port import OpenPort
from acsar_gym.links.ports import Location
from acsar_gym.links.watchdog import Watchdog


class WatchdogHandle:
    """Starts, signals and ends the watchdog, if it is configured and the port can be shared.

    Callers prevent concurrent calls from several threads, except for `wait`.

    Attributes:
        watchdog: the watchdog; None if there is none.
        nap: longest sleep of the link between two `beat` calls [s].
    """

    def __init__(self, config: RobotConfig, location: Location, zeros: bytes) -> None:
        self._timeout = config.watchdog_timeout
        self._location = location
        self._zeros = zeros
        self.watchdog: Watchdog | None = None
        self.nap = math.inf

    def start(self, port: OpenPort) -> None:
        """Start the watchdog; LinkError if that fails."""
        descriptor = port.fileno()
        if self._timeout is None or not watchdog.AVAILABLE or descriptor is None:
            return
        name = self._location.path if self._location.path and self._location.lasts else ""
        self.watchdog = Watchdog(descriptor, self._zeros, self._timeout, name)
        self.nap = self._timeout / 3.0

    def renew(self, port: OpenPort) -> bool:
        """Restart a watchdog that doesn't run any more; returns whether that was necessary."""
        running = self.watchdog
        if running is None or running.alive:
            return False
        self.watchdog = None
        running.close()
        self.start(port)
        return True

    def wait(self) -> None:
        """Wait until the watchdog is ready; LinkError if that fails."""
        if (running := self.watchdog) is not None:
            running.wait()

    @property
    def alive(self) -> bool:
        """Whether there is a watchdog and it runs."""
        return (running := self.watchdog) is not None and running.alive

    @property
    def pid(self) -> int | None:
        """PID of the watchdog; None if there is none."""
        return None if (running := self.watchdog) is None else running.pid

    def rearm(self) -> None:
        """Allow driving again after the watchdog stopped the robot."""
        if (running := self.watchdog) is not None:
            running.rearm()

    def beat(self) -> None:
        """Signal that the program runs."""
        if (running := self.watchdog) is not None:
            running.beat()

    def stand(self) -> None:
        """Note that a zero command was sent."""
        if (running := self.watchdog) is not None:
            running.stand()

    def drive(self) -> None:
        """Call before a command that turns wheels; LinkError if the watchdog doesn't run."""
        if (running := self.watchdog) is not None:
            running.drive()

    def driven(self) -> None:
        """Call after a command that turns wheels; LinkError if the robot was stopped meanwhile."""
        if (running := self.watchdog) is not None:
            running.driven()

    def end(self, *, lost: bool) -> None:
        """End the watchdog; if the port is lost, it continues to search for it."""
        running, self.watchdog = self.watchdog, None
        if running is not None and lost:
            running.search(self._name)
        elif running is not None:
            running.close()

    def end_search(self) -> None:
        """End a former search for the port; call once the port is there."""
        watchdog.call_back(self._name)

    def abandon(self) -> None:
        """Release the watchdog without ending it, for a forked child."""
        running, self.watchdog = self.watchdog, None
        if running is not None:
            running.abandon()

    @property
    def _name(self) -> str:
        return self._location.path or self._location.name
