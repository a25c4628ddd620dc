"""A serial port that is open: bytes out and in without waiting, in one kind of error or in none."""

from __future__ import annotations

import contextlib
import os
import time

from acsar_gym.links.ports import PORT_ERRORS, Port, put, translated

CHUNK = 4096
"""Most bytes taken from the port at once."""
MOST_CHUNKS = 256
"""Chunks taken in one go, at most: what lies in any driver's buffer, and no endless stream."""
DRAIN = 0.05
"""What was sent has so long to leave the port when it is closed [s]."""


class OpenPort:
    """pyserial's open port of a device.

    `put`, `read` and `drop_input` raise LinkLostError where the device is gone; `says`, `is_quiet`
    and `close` raise nothing, for whoever must stop now.
    """

    def __init__(self, port: Port, device: str) -> None:
        self._port = port
        self._device = device

    def put(self, data: bytes) -> None:
        """Send all of these bytes."""
        with translated(self._device):
            put(self._port, data)

    def read(self) -> bytes:
        """What has arrived; waits for nothing."""
        data = b""
        with translated(self._device):
            for _ in range(MOST_CHUNKS):
                chunk = self._port.read(CHUNK)
                data += chunk
                if not chunk:
                    break
        return data

    def drop_input(self) -> None:
        """Drop what has arrived and wasn't read."""
        with translated(self._device):
            self._port.reset_input_buffer()

    def drop_output(self) -> None:
        """Drop what hasn't left the port yet."""
        with translated(self._device):
            self._port.reset_output_buffer()

    def fileno(self) -> int | None:
        """Its descriptor; None where it has none that can be shared, as with rfc2217."""
        try:
            return int(self._port.fileno())
        except OSError:
            return None

    def says(self, data: bytes) -> bool:
        """Send, and whether the port took it."""
        with contextlib.suppress(*PORT_ERRORS):
            put(self._port, data)
            return True
        return False

    def is_drained(self) -> bool:
        """Whether the port has sent everything soon.

        What a board doesn't take is dropped, for it would hold up whoever closes the port.
        """
        deadline = time.monotonic() + DRAIN
        with contextlib.suppress(*PORT_ERRORS):
            while getattr(self._port, "out_waiting", 0):
                if time.monotonic() > deadline:
                    self._port.reset_output_buffer()
                    return False
                time.sleep(0.001)
            return True
        return False

    def is_quiet(self) -> bool:
        """Whether nothing has arrived, or the device is gone."""
        with contextlib.suppress(*PORT_ERRORS):
            return not self._port.in_waiting
        return True

    def close(self) -> None:
        """Close it, in whatever state it is."""
        with contextlib.suppress(*PORT_ERRORS):
            self._port.close()

    def detach(self) -> None:
        """Let go of a parent's connection, which `close` would end."""
        own = getattr(self._port, "_socket", None)
        if own is not None:
            os.close(own.detach())
            self._port.is_open = False
