"""An open serial port with non-blocking reads and writes, and exceptions of this package."""

from __future__ import annotations

import contextlib
import os
import select
import time

from acsar_gym.links.ports import PORT_ERRORS, Port, put, translated

CHUNK = 4096
"""Bytes read from the port by one call."""
MOST_CHUNKS = 256
"""Most chunks per read: enough to empty a driver's buffer, but not an endless stream."""
DRAIN = 0.05
"""Longest wait for sent bytes to leave the port when it is closed [s]."""


class OpenPort:
    """An open port of pyserial.

    `put`, `read` and `drop_input` raise LinkLostError if the device is gone. `says`, `is_quiet` and
    `close` raise nothing, so that stopping can't fail halfway.

    Args:
        port: pyserial's port.
        device: its name, for messages.
    """

    def __init__(self, port: Port, device: str) -> None:
        self._port = port
        self._device = device

    def put(self, data: bytes) -> None:
        """Send all of the bytes; LinkLostError if the device is gone."""
        with translated(self._device):
            put(self._port, data)

    def read(self) -> bytes:
        """Return what has arrived, without waiting; LinkLostError if the device is gone."""
        data = b""
        with translated(self._device):
            for _ in range(MOST_CHUNKS):
                chunk = self._port.read(CHUNK)
                data += chunk
                if not chunk:
                    break
        return data

    def wait(self, seconds: float) -> bool:
        """Wait for bytes for a time at most [s].

        Returns whether some arrived, or the device is gone. Ports without a descriptor that can be
        waited for, as on Windows, just wait.
        """
        try:
            return bool(select.select([self._port], [], [], seconds)[0])
        except ValueError:
            time.sleep(seconds)
        except PORT_ERRORS:
            time.sleep(seconds)
        return False

    def drop_input(self) -> None:
        """Discard what has arrived and wasn't read."""
        with translated(self._device):
            self._port.reset_input_buffer()

    def drop_output(self) -> None:
        """Discard what hasn't left the port yet."""
        with translated(self._device):
            self._port.reset_output_buffer()

    def fileno(self) -> int | None:
        """Return the file descriptor; None if it can't be shared, as on Windows."""
        try:
            return int(self._port.fileno())
        except OSError:
            return None

    def says(self, data: bytes) -> bool:
        """Send bytes; returns whether the port accepted them."""
        with contextlib.suppress(*PORT_ERRORS):
            put(self._port, data)
            return True
        return False

    def is_drained(self) -> bool:
        """Wait up to DRAIN; returns whether all bytes have been sent.

        The rest is discarded, as it would delay the closing of the port.
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
        """Return whether nothing has arrived, or the device is gone."""
        with contextlib.suppress(*PORT_ERRORS):
            return not self._port.in_waiting
        return True

    def close(self) -> None:
        """Close the port, in any state."""
        with contextlib.suppress(*PORT_ERRORS):
            self._port.close()

    def detach(self) -> None:
        """Close this process's copy of a socket, without ending the parent's connection."""
        own = getattr(self._port, "_socket", None)
        if own is not None:
            os.close(own.detach())
            self._port.is_open = False
