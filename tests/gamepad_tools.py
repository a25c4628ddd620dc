"""A gamepad whose events come over a pseudo-terminal, in the place of evdev's devices.

`python tests/gamepad_tools.py drive --gamepad PATH ...` runs the command line with such a pad.
"""

from __future__ import annotations

import errno
import fcntl
import os
import pty
import struct
import termios
import time
import tty
from collections.abc import Iterable, Iterator
from pathlib import Path

from evdev import AbsInfo, InputEvent, ecodes

from acsar_gym.tools import gamepad

RECORD = struct.Struct("@llHHi")
"""Seconds, microseconds, type, code and value, as the kernel packs them."""
BUTTONS = (ecodes.BTN_TL, ecodes.BTN_EAST, ecodes.BTN_START, ecodes.BTN_SELECT)
XPAD = {
    ecodes.ABS_X: AbsInfo(value=0, min=-32768, max=32767, fuzz=0, flat=0, resolution=0),
    ecodes.ABS_RX: AbsInfo(value=0, min=-32768, max=32767, fuzz=0, flat=0, resolution=0),
    ecodes.ABS_Z: AbsInfo(value=0, min=0, max=255, fuzz=0, flat=0, resolution=0),
    ecodes.ABS_RZ: AbsInfo(value=0, min=0, max=255, fuzz=0, flat=0, resolution=0),
}
"""The axes of the kernel's driver xpad, at rest."""


def event(kind: int, code: int, value: int) -> list[InputEvent]:
    """A change, and the end of its packet."""
    return [
        InputEvent(0, 0, kind, code, value),
        InputEvent(0, 0, ecodes.EV_SYN, ecodes.SYN_REPORT, 0),
    ]


LB = event(ecodes.EV_KEY, ecodes.BTN_TL, 1)
LET_GO = event(ecodes.EV_KEY, ecodes.BTN_TL, 0)
FULL = event(ecodes.EV_ABS, ecodes.ABS_RZ, 255)
HALF = event(ecodes.EV_ABS, ecodes.ABS_RZ, 128)
REST = event(ecodes.EV_ABS, ecodes.ABS_RZ, 0)
LEFT = event(ecodes.EV_ABS, ecodes.ABS_X, -32768)
STOP = event(ecodes.EV_KEY, ecodes.BTN_EAST, 1)
START = event(ecodes.EV_KEY, ecodes.BTN_START, 1)
QUIT = event(ecodes.EV_KEY, ecodes.BTN_SELECT, 1)


class PadDevice:
    """What `evdev.InputDevice` is for a real pad."""

    def __init__(self, path: str, *, readonly: bool = False) -> None:
        assert readonly
        self.name = path
        self._file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY)
        self._partial = b""

    def capabilities(self, *, absinfo: bool = True) -> dict[int, list[int]]:
        assert not absinfo
        return {ecodes.EV_KEY: list(BUTTONS), ecodes.EV_ABS: list(XPAD)}

    def absinfo(self, code: int) -> AbsInfo:
        return XPAD[code]

    def read(self) -> Iterator[InputEvent]:
        data = os.read(self._file, 1 << 16)
        if not data:
            raise OSError(errno.ENODEV, "No such device")
        data = self._partial + data
        length = len(data) - len(data) % RECORD.size
        self._partial = data[length:]
        return (InputEvent(*record) for record in RECORD.iter_unpack(data[:length]))

    def close(self) -> None:
        os.close(self._file)


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

    def send(self, events: Iterable[InputEvent]) -> None:
        os.write(self._master, _pack(events))

    def deliver(self, events: Iterable[InputEvent]) -> None:
        """Send what this process will read, and wait until the terminal has passed it on."""
        data = _pack(events)
        expected = self._count_waiting() + len(data)
        os.write(self._master, data)
        while self._count_waiting() < expected:
            time.sleep(0.001)

    def _count_waiting(self) -> int:
        """How many bytes wait to be read."""
        answer = fcntl.ioctl(self._slave, termios.FIONREAD, bytes(4))
        return int(struct.unpack("@i", answer)[0])


def _pack(events: Iterable[InputEvent]) -> bytes:
    return b"".join(
        RECORD.pack(event.sec, event.usec, event.type, event.code, event.value) for event in events
    )


def install() -> None:
    """Let this process's gamepads be emulated ones."""
    setattr(gamepad, "InputDevice", PadDevice)  # noqa: B010 - a name that it only imports


if __name__ == "__main__":
    from acsar_gym.tools.cli import main

    install()
    main()
