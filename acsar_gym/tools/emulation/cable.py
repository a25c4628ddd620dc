"""A pseudo-terminal that can be unplugged, and plugged in again under another device name."""

from __future__ import annotations

import contextlib
import os
import struct
import sys
from pathlib import Path

from acsar_gym.errors import ConfigError

try:
    import fcntl
    import pty
    import termios
    import tty
except ImportError as error:
    raise ConfigError("this operating system has no pseudo-terminals to emulate on") from error

PSEUDO_TERMINALS = Path("/dev/pts")
DEVICE_PREFIXES = ("/dev/pts/", "/dev/ttys")
"""Beginnings of pseudo-terminals' paths, on Linux and macOS."""
READ_SIZE = 4096
UNNAMED_RATES = (128000, 256000)
"""Baud rates that termios has no name for, and Linux's terminals have all the same."""
TCGETS2, TCSETS2, TERMIOS2 = 0x802C542A, 0x402C542B, struct.Struct("=4I20s2I")
"""Requests and structure with which Linux tells and sets any rate; see termios2 in its sources."""
CBAUD, BOTHER, CFLAG, SPEEDS = 0o010017, 0o010000, 2, slice(5, 7)


def read_baud_rate(descriptor: int) -> int:
    """Return the baud rate of a terminal, or on other systems than Linux what stands for it."""
    if sys.platform != "linux":
        return int(termios.tcgetattr(descriptor)[4])
    data = fcntl.ioctl(descriptor, TCGETS2, bytes(TERMIOS2.size))
    return int(TERMIOS2.unpack(data)[SPEEDS.start])


def set_baud_rate(descriptor: int, rate: int) -> None:
    """Set the baud rate of a terminal."""
    code = getattr(termios, f"B{rate}", None)
    if code is None:
        fields = list(TERMIOS2.unpack(fcntl.ioctl(descriptor, TCGETS2, bytes(TERMIOS2.size))))
        fields[CFLAG] = fields[CFLAG] & ~CBAUD | BOTHER
        fields[SPEEDS] = rate, rate
        fcntl.ioctl(descriptor, TCSETS2, TERMIOS2.pack(*fields))
        return
    attributes = termios.tcgetattr(descriptor)
    attributes[4] = attributes[5] = code
    termios.tcsetattr(descriptor, termios.TCSANOW, attributes)


class EmulatedCable:
    """The emulated cable of a board or sensor.

    Args:
        baud_rate: baud rate of the emulated device.
        name: symbolic link that always points to the current device, as udev maintains in
            /dev/serial/by-id; None for no link.

    Attributes:
        device: path of the device; empty while unplugged.

    Raises:
        ConfigError: no terminal knows the baud rate, or the symbolic link can't be created, or is
            that of another device.
    """

    def __init__(self, baud_rate: int, name: Path | None = None) -> None:
        self.device = ""
        self._baud_rate = baud_rate
        unnamed = UNNAMED_RATES if sys.platform == "linux" else ()
        if not hasattr(termios, f"B{baud_rate}") and baud_rate not in unnamed:
            raise ConfigError(
                f"baud = {baud_rate}: must be a rate that a terminal knows, as 115200"
            )
        other = name.readlink() if name is not None and name.is_symlink() else Path()
        if other.parent == PSEUDO_TERMINALS and other.exists():
            raise ConfigError(
                f"{name}: is the name of {other}, perhaps another emulator's: end that, or give "
                "another name"
            )
        if other != Path() and not str(other).startswith(DEVICE_PREFIXES):
            raise ConfigError(f"{name}: is a symbolic link to {other}: name another")
        self._name = name
        self._descriptors: tuple[int, ...] = ()
        self.plug()

    def plug(self) -> None:
        """Create the device: raw mode, with its own baud rate until a client sets another one.

        Idempotent.
        """
        if self._descriptors:
            return
        self._master, self._slave = self._descriptors = pty.openpty()
        tty.setraw(self._slave)
        set_baud_rate(self._slave, self._baud_rate)
        self._own_rate = read_baud_rate(self._slave)
        os.set_blocking(self._master, False)
        self.device = os.ttyname(self._slave)
        if self._name is None:
            return
        try:
            if self._name.is_symlink():
                self._name.unlink()
            self._name.symlink_to(self.device)
        except FileExistsError as error:
            self.pull()
            raise ConfigError(
                f"{self._name}: exists and isn't a symbolic link: name another"
            ) from error
        except OSError as error:
            self.pull()
            raise ConfigError(f"{self._name}: can't be made a symbolic link: {error}") from error

    def pull(self) -> None:
        """Remove the device. Idempotent."""
        descriptors, self._descriptors = self._descriptors, ()
        if self._name is not None and descriptors:
            with contextlib.suppress(OSError):  # it may be missing or not a symbolic link
                if str(self._name.readlink()) == self.device:
                    self._name.unlink()
        self.device = ""
        for descriptor in descriptors:
            os.close(descriptor)

    @property
    def has_equal_rates(self) -> bool:
        """Whether the client has set the device's baud rate."""
        return read_baud_rate(self._slave) == self._own_rate

    def over_uart(self, data: bytes) -> bytes:
        """Return what arrives of bytes at the other end: garbled if the baud rates differ."""
        if self.has_equal_rates:
            return data
        return bytes((byte * 7 + 0x80) & 0xFF | 0x80 for byte in data)

    def read(self) -> bytes:
        """Read what the client has sent; nothing while unplugged."""
        with contextlib.suppress(BlockingIOError):
            return os.read(self._master, READ_SIZE) if self._descriptors else b""
        return b""

    def write(self, data: bytes) -> None:
        """Send to the client; data that nobody reads is lost, as on a UART."""
        if self._descriptors:
            with contextlib.suppress(BlockingIOError):
                os.write(self._master, data)
