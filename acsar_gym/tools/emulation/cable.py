"""A pseudo-terminal that can be unplugged, and plugged in again under another device name."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path

from acsar_gym.errors import ConfigError

try:
    import pty
    import termios
    import tty
except ImportError as error:
    raise ConfigError("this operating system has no pseudo-terminals to emulate on") from error

DEVICE_PREFIXES = ("/dev/pts/", "/dev/ttys")
"""First characters of pseudo-terminals' paths, on Linux and macOS."""
READ_SIZE = 4096
UNNAMED_RATE = 0o010000
"""BOTHER: what `termios` on Linux reports for a baud rate that has no name, such as 256000."""


class EmulatedCable:
    """The emulated cable of a board or sensor.

    Args:
        baud_rate: Baud rate of the emulated device.
        name: Symbolic link that always points to the current device, as udev maintains it in
            /dev/serial/by-id. None for no link.

    Attributes:
        device: Path of the device. Empty while unplugged.

    Raises:
        ConfigError: The symbolic link can't be created, or is the link of another device.
    """

    def __init__(self, baud_rate: int, name: Path | None = None) -> None:
        self.device = ""
        # Rates without a name can't be set on a new terminal, but clients can set them.
        code = getattr(termios, f"B{baud_rate}", None)
        self._rates = (termios.B50, UNNAMED_RATE) if code is None else (code,)
        """Codes of the board's rate. The first is that of a new terminal."""
        self._name = name
        self._descriptors: tuple[int, ...] = ()
        if name is not None:
            _check_name(name)
        self.plug()

    def plug(self) -> None:
        """Create the device: raw mode, with the board's baud rate until a client sets another.

        Idempotent.
        """
        if self._descriptors:
            return
        # The other end stays open here, or the terminal would end with each client.
        self._master, self._slave = self._descriptors = pty.openpty()
        tty.setraw(self._slave)
        attributes = termios.tcgetattr(self._slave)

        # A client that sets no rate gets the board's.
        attributes[4] = attributes[5] = self._rates[0]
        termios.tcsetattr(self._slave, termios.TCSANOW, attributes)
        os.set_blocking(self._master, False)
        self.device = os.ttyname(self._slave)

        if self._name is not None:
            try:
                self._name.unlink(missing_ok=True)
                self._name.symlink_to(self.device)
            except OSError as error:
                self.pull()
                raise ConfigError(f"{self._name}: can't be a symbolic link: {error}") from error

    def pull(self) -> None:
        """Remove the device. Idempotent."""
        if self._name is not None and self._descriptors:
            with contextlib.suppress(OSError):  # it may be missing or not a symbolic link
                if str(self._name.readlink()) == self.device:
                    self._name.unlink()
        for descriptor in self._descriptors:
            os.close(descriptor)
        self._descriptors = ()
        self.device = ""

    def over_uart(self, data: bytes) -> bytes:
        """Return what arrives of bytes at the other end: garbled if the baud rates differ."""
        if termios.tcgetattr(self._slave)[5] in self._rates:
            return data
        return bytes((byte * 7 + 0x80) & 0xFF | 0x80 for byte in data)

    def read(self) -> bytes:
        """Read what the client has sent. Nothing while unplugged."""
        with contextlib.suppress(BlockingIOError):
            return os.read(self._master, READ_SIZE) if self._descriptors else b""
        return b""

    def write(self, data: bytes) -> None:
        """Send to the client. Data that nobody reads is lost, as on a UART."""
        if self._descriptors:
            with contextlib.suppress(BlockingIOError):
                os.write(self._master, data)


def _check_name(name: Path) -> None:
    """Check that a symbolic link destroys nothing."""
    if not name.is_symlink():
        if name.exists():
            raise ConfigError(f"{name}: exists and isn't a symbolic link: name another")
        return
    # A link of an emulator that was killed remains, and is replaced.
    device = name.readlink()
    if not str(device).startswith(DEVICE_PREFIXES):
        raise ConfigError(f"{name}: is a symbolic link to {device}: name another")
    if sys.platform == "linux" and device.exists():
        raise ConfigError(
            f"{name}: is the name of {device}, perhaps another emulator's: end that, or give "
            "another name"
        )
