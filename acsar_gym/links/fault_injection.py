"""A link with faults: of lines, encoders, wheels, the board, its supply and the cable.

Bytes from driver to board pass these stages; bytes of the board pass them in the opposite order:

    driver -> cable (plugged in?) -> wire (lines, garbage) -> board (running?) -> wheels -> link
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from acsar_gym.errors import ConfigError, LinkLostError, PortNotFoundError
from acsar_gym.links.base import WHILE_WAITING, Arrivals, Link
from acsar_gym.links.faults import EPSILON, Faults, WheelEditor, WheelFaults
from acsar_gym.links.faulty_wire import Event, FaultyWire
from acsar_gym.links.forwarding import ForwardingLink
from acsar_gym.links.lots import EPISODE, lot
from acsar_gym.protocol import ZERO, Decoder, encode
from acsar_gym.worlds import Scene

WAIT = 0.01
"""Steps in which `open` waits for a cable to be plugged in again [s]."""
STOP = b"\r\n" + encode(ZERO)
"""Command that stops the motors while the board isn't running; the line end ends a half command
that the board may have received before."""
Seed = int | np.integer[Any] | np.random.Generator | None


class FaultyLink(ForwardingLink):
    """Passes bytes to and from another link, with faults; without faults it changes nothing.

    `reset` draws the faults of the episode; before the first reset there are none. The same seed,
    resets and input give the same bytes. Times are those of the link's own clock, so a simulation
    isn't slowed down.

    While the cable is out, `write` and `advance` raise LinkLostError until the link is opened
    again: `open` waits for the rest of `replug_time`, or raises PortNotFoundError where the cable
    stays out. The device then has another name.

    Args:
        link: the link behind this one.
        faults: a mapping, Faults, or None.
        seed: a whole number, a generator, or None for a random one.
        relink: makes the link for the device that appears after a replug, where it has another
            name (two emulators, two boards).

    Attributes: `faults`; `injected`, how often each fault has happened since the last reset, by
    name; `wheels`, the wheels that fail in this episode; `device`; `link`, the link behind it.
    """

    def __init__(
        self,
        link: Link,
        faults: Mapping[str, Any] | Faults | None,
        seed: Seed = None,
        relink: Callable[[], Link] | None = None,
    ) -> None:
        super().__init__(link)
        self.faults = Faults.of(faults)
        self.injected: Counter[str] = Counter()
        self.wheels = WheelFaults()
        self._relink = relink
        self._first_seed = seed
        self._replugs = 0
        self._back_at: float | None = None
        self._episode: _Episode | None = None
        self.seed(seed)

    def seed(self, seed: Seed) -> None:
        """Set what the next resets draw from.

        Args:
            seed: a whole number or None; of a generator one number is taken, and no more.

        Raises:
            ConfigError: for anything else.
        """
        if isinstance(seed, np.random.Generator):
            self._key = float(seed.random())
            self._rng = _generator(self._key)
            return
        if seed is not None and (not isinstance(seed, int | np.integer) or seed < 0):
            raise ConfigError(f"seed = {seed!r}: must be a whole number, 0 or more")
        self._rng = np.random.default_rng(seed)
        self._key = float(self._rng.random())

    @property
    def device(self) -> str:
        """Name of the device; links without one are called robot0, and after a replug robot1."""
        return str(getattr(self.link, "device", f"robot{self._replugs}"))

    def open(self) -> None:
        """Open the link; where the cable was pulled, wait until it is plugged in again.

        Raises:
            PortNotFoundError: the cable stays out.
        """
        if self._back_at is None:
            self.link.open()
            return
        wait = self._back_at - self.link.now()
        if wait == math.inf:
            raise PortNotFoundError(f"{self.device}: no such device", "plug the cable in again")
        if self._relink is not None:
            self.link = self._relink()
        try:
            self.link.open()
            for _ in range(math.ceil(wait / WAIT - EPSILON)):
                WHILE_WAITING.get()()
                self.link.advance(WAIT)
        except BaseException:
            self.link.close()
            raise
        self._back_at = None
        self._replugs += 1

    def reset(self, scene: Scene) -> None:
        """Reset the link, end the faults of the last episode and draw those of the new one."""
        self._check_cable()
        self.link.reset(scene)
        self.injected.clear()
        self.wheels, self._episode = WheelFaults(), None
        key, self._key = self._key, float(self._rng.random())
        if self.faults.possible and lot(key, EPISODE, 0.0, 0) < self.faults.episodes:
            generators = _generator(key).spawn(3)
            self.wheels = WheelFaults.drawn(self.faults, generators[-1])
            self._episode = _Episode(self, key, generators)

    def write(self, data: bytes) -> None:
        """Send bytes; faults may change or lose them."""
        if self._episode is not None:
            self._episode.watch(data, self.link.now())
        self._check_cable()
        if self._episode is not None:
            data = self._episode.sent(data, self.link.now())
        if data or self._episode is None:
            self.link.write(data)

    def advance(self, period: float) -> bytes:
        """Let a period pass, and return the feedback bytes after all faults.

        Args:
            period: [s].
        """
        self._check_cable()
        episode = self._episode
        if episode is None:
            return self.link.advance(period)
        due = episode.due(self.link.now(), period)
        if due:
            self.link.write(due)
        data = self.link.advance(period)
        return episode.heard(data, self.link.now(), period)

    def _check_cable(self) -> None:
        """Raise LinkLostError where the cable is out.

        When it is pulled, the link behind is closed.
        """
        if self._episode is not None and self._episode.unplugged(self.link.now()):
            self._back_at = self.link.now() + self.faults.replug_time
            self.close()
        if self._back_at is not None:
            raise LinkLostError(
                f"{self.device}: lost while in use (unplugged)",
                "check the cable, then open the link again, or reset",
            )

    @property
    def arrivals(self) -> Arrivals:
        """Nothing: faults change the bytes that arrived."""
        return []

    def __reduce__(self) -> tuple[type[FaultyLink], tuple[object, ...]]:
        """Copies and pickles have a link of their own and begin with the first seed."""
        return FaultyLink, (self.link, self.faults, self._first_seed, self._relink)

    def close(self) -> None:
        """Close the link. Faults end until the next reset, but a pulled cable stays out."""
        self._episode = None
        self.link.close()


def _generator(key: float) -> np.random.Generator:
    """The generator of all faults except those that `lot` draws; `key` is a number of [0, 1)."""
    return np.random.default_rng(int(key * 2**53))


class _Episode:
    """The faults between two resets; feedback, commands and events have generators of their own."""

    def __init__(self, link: FaultyLink, key: float, generators: list[np.random.Generator]) -> None:
        faults, count = link.faults, link.injected
        feedback, commands, events = generators
        self._feedback = FaultyWire(faults, "feedback", key, feedback, count)
        self._commands = FaultyWire(faults, "commands", key, commands, count)
        self._wheels = WheelEditor(link.wheels, math.inf if faults.wheel_faults_at else -math.inf)
        self._wheels_fail_after = faults.wheel_faults_at
        self._outages = (
            Event("board_reset", faults.reset_time, faults, count, events),
            Event("brown_out", faults.brown_out_time, faults, count, events),
        )
        self._unplug = Event("unplug", math.inf, faults, count, events)
        self._waiting: Decoder | None = Decoder()

    def watch(self, data: bytes, now: float) -> None:
        """Start the clock of events with the first command of the driver that turns wheels."""
        if self._waiting is None or all(r.speeds == ZERO for r in self._waiting.feed(data)):
            return
        self._waiting = None
        self._wheels.at = now + self._wheels_fail_after
        for event in (*self._outages, self._unplug):
            event.start(now)

    def unplugged(self, now: float) -> bool:
        """Whether the cable is out now."""
        return self._unplug.going(now)

    def _down(self, now: float) -> bool:
        """Whether the board isn't running now.

        It then forgets incomplete lines in both directions.
        """
        reset, brown_out = (outage.going(now) for outage in self._outages)
        if reset or brown_out:
            for stream in (self._feedback, self._commands, self._wheels):
                stream.cut_off()
        return reset or brown_out

    def sent(self, data: bytes, now: float) -> bytes:
        """Bytes that reach the motors now, when the driver writes `data` now."""
        arrived = self._commands.carry(data, now)
        return b"" if self._down(now) else self._wheels.commanded(arrived, now)

    def due(self, now: float, period: float) -> bytes:
        """Other bytes that reach the motors in a period: late lines and garbage."""
        arrived = self._commands.noisy(self._commands.carry(b"", now), period)
        return STOP if self._down(now) else self._wheels.commanded(arrived, now)

    def heard(self, data: bytes, now: float, period: float) -> bytes:
        """Bytes that reach the driver, when the board sent `data` in the period that ends now."""
        said = b"" if self._down(now) else self._wheels.felt(data, now)
        return self._feedback.noisy(self._feedback.carry(said, now), period)
