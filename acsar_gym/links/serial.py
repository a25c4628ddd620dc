"""A link to a real board on a serial device, with absolute deadlines."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence

from acsar_gym.config import RobotConfig
from acsar_gym.links.base import Arrivals
from acsar_gym.links.guarded import GuardedLink
from acsar_gym.links.handshake import check_no_echo, wait_for_board
from acsar_gym.links.ports import OpenPort, PortLocation
from acsar_gym.protocol import ECHO_PROBE, ZERO, encode

LOG = logging.getLogger("acsar_gym.wire")
"""Logs what `Wire` doesn't see: stops, and what arrives while the board is waited for."""

EMPTY_READ_PAUSE = 0.001  # pause if a port reports bytes and has none [s]


class SerialLink(GuardedLink):
    """A board on a serial device: 8N1, no flow control, opened exclusively.

    A port that was lost has `reconnect_timeout` to reappear, under the persistent name of its
    adapter. During a drive no call takes longer than a period.

    Args:
        device: Path, URL, or USB serial number such as "usb:A50285BI".
        config: Robot configuration.
        zeros: Zero commands in all formats that the board may take. None for the config's format.
    """

    def __init__(
        self, device: str, config: RobotConfig, zeros: Sequence[bytes] | None = None
    ) -> None:
        zeros = zeros or [encode(ZERO, trailing_comma=config.trailing_comma)]
        self._zeros = tuple(zeros)
        self._stop_lines = b"\r\n" + b"".join(zeros)  # the line end ends a truncated command
        self._port: OpenPort | None = None
        self._location = PortLocation(device)
        self._keeps_arrivals = False
        self._arrivals: list[tuple[float, bytes]] = []
        super().__init__(device, config, self._stop_lines)

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._port is not None

    @property
    def port(self) -> OpenPort:
        """The open port. LinkLostError if it is closed."""
        if self._port is None:
            raise self._closed_error()
        return self._port

    def _connect(self) -> None:
        config = self._config
        self._port = self._location.open(config.baud_rate, config.reconnect_timeout)

    def _start_watchdog(self) -> None:
        self.watchdog.start(self.port.fileno())

    def _wait_for_feedback(self) -> None:
        # What waited in the driver is of an earlier program.
        self.port.drop_input()
        self.port.drop_output()
        # The dropped output may have held the first zeros, so they are sent again.
        self.stop()
        wait_for_board(self._read_reply, self.device, self._config)
        check_no_echo(self.write, self._read_reply, self.device, self._config)

    def _read_reply(self) -> bytes:
        """Read what arrives before the first episode."""
        data = self.read_now()
        if data:
            LOG.debug("%.4f received %r", self.now(), data)
        return data

    def _forget_feedback(self) -> None:
        self.port.drop_input()

    def _is_stop(self, data: bytes) -> bool:
        return data.endswith(self._zeros) or ECHO_PROBE in data

    def _send(self, data: bytes) -> None:
        self.port.write(data)

    def _send_stop(self) -> bool:
        is_sent = self._port is not None and self._port.try_write(self._stop_lines)
        LOG.debug("%.4f sent %r", self.now(), self._stop_lines)  # last, as a handler may fail
        return is_sent

    def _drain(self) -> bool:
        return self._port is not None and self._port.drain()

    def _disconnect(self, *, lost: bool) -> None:
        port = self.port
        self._port = None
        if lost:
            self._location.note_loss(port)
        port.close()

    def _detach(self) -> None:
        port = self.port
        self._port = None
        port.detach()
        port.close()

    def advance(self, period: float) -> bytes:
        """Sleep until the absolute deadline of the period [s]. Return what has arrived.

        After a delay of more than a period, the deadlines restart from now.
        """
        self._deadline += period
        keeps_arrivals = self._keeps_arrivals
        # Times of arrival cost many short waits, so they are noted only if a caller reads them.
        self._keeps_arrivals = False
        self._arrivals = []

        while (remaining := self._deadline - self.now()) > 0.0:
            # A period may be longer than the watchdog waits for a sign of life.
            pause = min(remaining, self.watchdog.beat_interval)
            if keeps_arrivals:
                self._wait_for_piece(pause)
            else:
                # Another thread may have closed the link during the last pause.
                self._require_open()
                time.sleep(pause)
            self._beat()

        self.lateness = self.now() - self._deadline
        if self.lateness > period:  # it can't be made up for
            self._deadline = self.now()
        return self._take_pieces(keeps_arrivals=keeps_arrivals)

    def _wait_for_piece(self, pause: float) -> None:
        """Wait for bytes, and keep them with the time of their arrival."""
        if self.port.wait_for_bytes(pause):
            data = self.port.read()
            # A port that was unplugged reports bytes and has none, over and over.
            if data:
                self._arrivals.append((self.now(), data))
            else:
                time.sleep(min(EMPTY_READ_PAUSE, pause))

    def _take_pieces(self, *, keeps_arrivals: bool) -> bytes:
        """Return what arrived in the period."""
        data = self.read_now()
        if not keeps_arrivals:
            return data
        if data:
            self._arrivals.append((self.now(), data))
        return b"".join([piece for _, piece in self._arrivals])

    @property
    def arrivals(self) -> Arrivals:
        """When the bytes of the newest period arrived [s], noted in the period after each call."""
        self._keeps_arrivals = True
        return self._arrivals

    def read_now(self) -> bytes:
        """Return what has arrived, without waiting."""
        self._beat()
        return self.port.read()

    def now(self) -> float:
        """Return the monotonic clock [s]."""
        return time.monotonic()

    def __reduce__(self) -> tuple[type[SerialLink], tuple[object, ...]]:
        """Copy and pickle as a closed link to the same device. A port can't be shared."""
        return type(self), (self.device, self._config, self._zeros)
