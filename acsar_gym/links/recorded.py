"""A link whose bytes are recorded, to a file or in memory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.guard import shutdown
from acsar_gym.links.base import Arrivals, ForwardingLink, Link, arrivals_of, is_stamped
from acsar_gym.recording.encoder import Event, Exchange, Moved, Written
from acsar_gym.recording.recorder import Recorder, close_recorders
from acsar_gym.recording.types import WireLog
from acsar_gym.worlds import Scene


class RecordedLink(ForwardingLink):
    """Forwards to another link, and hands its bytes to a recorder.

    Its clock stands still between resets, writes and periods, so that a replay shows the same.
    """

    def __init__(self, link: Link, recorder: Recorder, config: RobotConfig) -> None:
        super().__init__(link)
        self._recorder = recorder
        self._config = config
        self._sent: Arrivals = []
        self._now = 0.0
        shutdown.call_at_end(close_recorders)

    def open(self) -> None:
        """Open the link, then the recorder: a link that doesn't open costs no older recording.

        Raises:
            ConfigError: the recording can't be written, or would replace what it must not.
            LinkError: as for the link.
        """
        replayed, inner = None, self.link
        while replayed is None and inner is not None:
            path = getattr(inner, "replays", None)
            replayed = path if isinstance(path, Path) else None
            inner = getattr(inner, "link", None)  # type: ignore[assignment]
        self._recorder.check(replayed)
        self.link.open()
        try:
            self._recorder.open(self._config)
        except BaseException:
            self.link.close()
            raise
        arrivals_of(self.link)  # from now on, it notes when bytes arrive

    def reset(self, scene: Scene) -> None:
        """Begin an episode."""
        self._recorder.open(self._config)
        self._record_writes()
        self.link.reset(scene)
        self._now = self.link.now()
        self._recorder.begin(
            self._now, simulated=self.link.lateness is None, stamped=is_stamped(self.link)
        )

    def write(self, data: bytes) -> None:
        """Send bytes to the link."""
        self.link.write(data)
        if self.link.lateness is not None:
            self._now = round(self.link.now() * 1e9) / 1e9  # as it is recorded
        self._sent.append((self._now, data))

    def advance(self, period: float) -> bytes:
        """Advance the link and record the period."""
        link, sent = self.link, tuple(self._sent)
        got = link.advance(period)
        self._sent = []
        self._now = stamp = link.now()
        pieces = tuple(arrivals_of(link))
        if b"".join([piece for _, piece in pieces]) != got:
            pieces = ((stamp, got),)
        number, truth = self._recorder.number, link.truth
        self._recorder.add_exchange(Exchange(number, stamp, sent, pieces, link.lateness, truth))
        if truth is not None and (crowd := truth.crowd) is not None:
            movers = crowd.copy_states()
            self._recorder.add(Moved(number, stamp, crowd.hit, crowd.intrusions, movers))
        return got

    def now(self) -> float:
        """Return the time of the newest reset, write or period, on the link's clock [s]."""
        return self._now

    def clock(self) -> float:
        """Return the link's time as it goes on, for what has a thread of its own [s]."""
        return self.link.now()

    @property
    def device(self) -> str:
        """Device of the link; empty if it has none."""
        return str(getattr(self.link, "device", ""))

    def __reduce__(self) -> tuple[Callable[[Link], Link], tuple[Link]]:
        """Copies aren't recorded: two robots can't write one file."""
        return unwrap_link, (self.link,)

    def close(self) -> None:
        """Close the link; the recording goes on with the next reset."""
        try:
            self.link.close()
        finally:
            self._record_writes()

    def _record_writes(self) -> None:
        """Record what was sent since the last period of the episode."""
        sent, self._sent = tuple(self._sent), []
        if sent and self._recorder.has_begun:
            self._recorder.add(Written(sent))


class WireTape(Recorder):
    """Keeps the wire of the newest episode in memory; for a `RecordedLink`."""

    def __init__(self) -> None:
        super().__init__(None)
        self._sent: list[tuple[float, bytes]] = []
        self._got: list[tuple[float, bytes]] = []
        self._stamped = False

    def open(self, config: RobotConfig) -> None:
        """Nothing to open."""

    def begin(self, stamp: float, *, simulated: bool, stamped: bool = False) -> None:
        """Begin a new log."""
        self.number = 0
        self.has_begun = True
        self._stamped = stamped
        self._sent.clear()
        self._got.clear()

    def add(self, event: Event) -> None:
        """Keep what was sent and heard."""
        if isinstance(event, Exchange | Written):
            self._sent += event.sent
        if isinstance(event, Exchange):
            self._got += event.received

    @property
    def log(self) -> WireLog:
        """What passed since the newest reset."""
        return WireLog(
            np.array([stamp for stamp, _ in self._sent], np.float64),
            tuple(data for _, data in self._sent),
            np.array([stamp for stamp, _ in self._got], np.float64),
            tuple(data for _, data in self._got),
            stamped=self._stamped,
        )


def unwrap_link(link: Link) -> Link:
    """Return the link itself."""
    return link


def record_link(link: Link, recorder: Recorder | None, config: RobotConfig) -> Link:
    """Return the link, recorded if there is a recorder."""
    return link if recorder is None else RecordedLink(link, recorder, config)
