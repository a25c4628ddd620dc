"""A simulated link in real time, for windows and keyboard control."""

from __future__ import annotations

import time

from acsar_gym.links.base import Link
from acsar_gym.links.forwarding import ForwardingLink
from acsar_gym.worlds import Scene


class PacedLink(ForwardingLink):
    """Forwards to another link; `advance` doesn't return before its absolute deadline.

    Clock and bytes are those of the inner link.

    Args:
        link: the inner link.
    """

    def __init__(self, link: Link) -> None:
        super().__init__(link)
        self._deadline = time.monotonic()

    def reset(self, scene: Scene) -> None:
        """Reset the link and restart the deadlines."""
        super().reset(scene)
        self._deadline = time.monotonic()

    def advance(self, period: float) -> bytes:
        """Advance the link, then wait for the deadline; missed deadlines are skipped."""
        got = super().advance(period)
        self._deadline = max(self._deadline + period, time.monotonic() - period)
        time.sleep(max(0.0, self._deadline - time.monotonic()))
        return got
