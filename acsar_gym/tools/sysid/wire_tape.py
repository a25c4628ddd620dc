"""A recorder that keeps the wire of the newest episode in memory."""

from __future__ import annotations

from acsar_gym.config import RobotConfig
from acsar_gym.recording.events import Rows
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

    def add(self, rows: Rows) -> None:
        """Keep what was sent and received."""
        self._sent += rows.get("sent", ())
        self._received += rows.get("received", ())

    @property
    def log(self) -> WireLog:
        """What passed over the wire since the newest reset."""
        return WireLog.of(self._sent, self._received, stamped=self._is_stamped)
