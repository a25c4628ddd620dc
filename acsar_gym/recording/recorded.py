"""A link whose bytes are recorded."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acsar_gym.config import RobotConfig
from acsar_gym.links.base import Arrivals, Link, LinkWrapper
from acsar_gym.wire import round_stamp
from acsar_gym.worlds import Scene

if TYPE_CHECKING:
    from acsar_gym.recording.recorder import Recorder

UNKNOWN_TRUTH = ((math.nan,) * 3, (math.nan,) * 2, math.nan)
REPLAY = "replay:"  # prefix of the device of a link that replays a file


class RecordedLink(LinkWrapper):
    """Passes the bytes of another link to a recorder.

    Its clock is still between resets, writes and periods, so that a replay shows the same times.
    """

    def __init__(self, inner: Link, recorder: Recorder, config: RobotConfig) -> None:
        super().__init__(inner)
        self._recorder = recorder
        self._config = config
        self._writes: list[tuple[float, bytes]] = []
        self._now = 0.0

    def open(self) -> None:
        """Open the link, then the recorder: a link that doesn't open replaces no older recording.

        Raises:
            ConfigError: The recording can't be written, or must not replace an existing file.
            LinkError: As for the link.
        """
        device = self.inner.device
        replayed = Path(device.removeprefix(REPLAY)) if device.startswith(REPLAY) else None
        self._recorder.check(replayed)
        self.inner.open()
        try:
            self._recorder.open(self._config)
        except BaseException:
            self.inner.close()
            raise
        _ = self.inner.arrivals  # from now on the link notes when bytes arrive

    def reset(self, scene: Scene) -> None:
        """Start an episode."""
        self._recorder.open(self._config)
        self._record_last_writes()
        self.inner.reset(scene)
        self._now = self.inner.now()
        self._recorder.begin(
            self._now, simulated=self.inner.lateness is None, stamped=self.inner.stamped
        )

    def write(self, data: bytes) -> None:
        """Send bytes to the link."""
        self.inner.write(data)
        if self.inner.lateness is not None:  # time goes on meanwhile
            self._now = round_stamp(self.inner.now())
        self._writes.append((self._now, data))

    def advance(self, period: float) -> bytes:
        """Advance the link and record the period."""
        link = self.inner
        data = link.advance(period)
        self._now = now = link.now()
        # Links that don't know when their bytes arrived report nothing.
        pieces: Arrivals = tuple(link.arrivals)
        if b"".join([piece for _, piece in pieces]) != data:
            pieces = ((now, data),)

        truth = link.truth
        true_state = UNKNOWN_TRUTH if truth is None else (truth.pose, truth.twist, truth.contact)
        # All rows of a period are one event, which is recorded as a whole or dropped.
        number = self._recorder.number
        counts = (len(self._writes), len(pieces))
        rows: dict[str, Any] = {
            "exchanges": (number, now, *counts, link.lateness, *true_state),
            "sent": self._writes,
            "received": pieces,
        }
        if truth is not None and truth.crowd is not None:
            rows["movers"] = (number, now, truth.crowd.hit, truth.crowd.intrusions)
            rows["mover_states"] = truth.crowd.copy_states()

        self._writes = []
        self._recorder.add_period(now, rows)
        return data

    def now(self) -> float:
        """Return the time of the newest reset, write or period, on the link's clock [s]."""
        return self._now

    def close(self) -> None:
        """Close the link. The recording goes on with the next reset."""
        try:
            self.inner.close()
        finally:
            self._record_last_writes()

    def _record_last_writes(self) -> None:
        """Record what was sent since the last period of the episode."""
        if self._writes:
            self._recorder.add({"sent": self._writes})
        self._writes = []

    def __reduce__(self) -> tuple[Callable[[Link], Link], tuple[Link]]:
        """Copies aren't recorded: two robots can't write one file."""
        return _unwrapped, (self.inner,)


def _unwrapped(link: Link) -> Link:
    return link
