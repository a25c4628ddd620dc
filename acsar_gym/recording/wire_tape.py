"""A recorder that keeps the wire of the newest episode in memory."""

from __future__ import annotations

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.recording.events import Event, Exchange, Written
from acsar_gym.recording.recorder import Recorder
from acsar_gym.recording.types import WireLog


class WireTape(Recorder):
    """Keeps the wire of the newest episode in memory, for a `RecordedLink`."""

    def __init__(self) -> None:
        super().__init__(None)
        self._sent: list[tuple[float, bytes]] = []
        self._received: list[tuple[float, bytes]] = []
        self._is_stamped = False

    def open(self, config: RobotConfig) -> None:
        """Do nothing: there is no file."""

    def begin(self, stamp: float, *, simulated: bool, stamped: bool = False) -> None:
        """Start a new log."""
        self.number = 0
        self.has_begun = True
        self._is_stamped = stamped
        self._sent.clear()
        self._received.clear()

    def add(self, event: Event) -> None:
        """Keep what was sent and received."""
        if isinstance(event, Exchange | Written):
            self._sent += event.sent
        if isinstance(event, Exchange):
            self._received += event.received

    @property
    def log(self) -> WireLog:
        """What passed over the wire since the newest reset."""
        return WireLog(
            sent_stamps=np.array([stamp for stamp, _ in self._sent], np.float64),
            sent=tuple(data for _, data in self._sent),
            got_stamps=np.array([stamp for stamp, _ in self._received], np.float64),
            got=tuple(data for _, data in self._received),
            stamped=self._is_stamped,
        )
