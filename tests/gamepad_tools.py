"""A gamepad whose events come over a pseudo-terminal, as the kernel's records."""

from __future__ import annotations

import fcntl
import os
import pty
import struct
import termios
import time
import tty
from pathlib import Path

from acsar_gym.tools.gamepad import EV_SYN, EVENT, SYN_REPORT


def event(kind: int, code: int, value: int) -> bytes:
    """A change, and the end of its packet."""
    return EVENT.pack(0, 0, kind, code, value) + EVENT.pack(0, 0, EV_SYN, SYN_REPORT, 0)


class EmulatedPad:
    """A pad that can be pulled: `path` is its name, as in /dev/input/by-id."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.plug()

    def plug(self) -> None:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.path.symlink_to(os.ttyname(self._slave))

    def pull(self) -> None:
        """The device and its name vanish."""
        if self.path.is_symlink():
            self.path.unlink()
            os.close(self._slave)
            os.close(self._master)

    def let_go(self) -> None:
        """Close both ends in a forked process, which opens `path` by itself."""
        os.close(self._slave)
        os.close(self._master)

    def send(self, data: bytes) -> None:
        os.write(self._master, data)

    def deliver(self, data: bytes) -> None:
        """Send what this process will read; the terminal takes a moment to pass it on."""
        before = self._waiting()
        self.send(data)
        while self._waiting() < before + len(data):
            time.sleep(0.001)

    def _waiting(self) -> int:
        """How many bytes wait to be read."""
        answer = fcntl.ioctl(self._slave, termios.FIONREAD, bytes(4))
        return int(struct.unpack("@i", answer)[0])
