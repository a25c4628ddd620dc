"""A pseudo-terminal that can be unplugged, and plugged in again under another device name."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from acsar_gym.errors import ConfigError

try:
    import pty
    import termios
    import tty
except ImportError:
    raise ConfigError("this operating system has no pseudo-terminals to emulate on") from None

READ_SIZE = 4096


class EmulatedCable:
    """The emulated cable of a board or sensor.

    Args:
        baud_rate: baud rate of the emulated device.
        name: symbolic link that always points to the current device, as udev maintains in
            /dev/serial/by-id; None for no link.

    Attributes:
        device: path of the device; empty while unplugged.

    Raises:
        ConfigError: no terminal knows the baud rate, or the symbolic link can't be created.
    """

    def __init__(self, baud_rate: int, name: Path | None = None) -> None:
        self.device = ""
        self._baud_code = getattr(termios, f"B{baud_rate}", None)
        if self._baud_code is None:
            raise ConfigError(
                f"baud = {baud_rate}: must be a rate that a terminal knows, as 115200"
            )
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
        attributes = termios.tcgetattr(self._slave)
        attributes[4] = attributes[5] = self._baud_code
        termios.tcsetattr(self._slave, termios.TCSANOW, attributes)
        os.set_blocking(self._master, False)
        self.device = os.ttyname(self._slave)
        if self._name is None:
            return
        try:
            if self._name.is_symlink():
                self._name.unlink()
            self._name.symlink_to(self.device)
        except FileExistsError:
            self.pull()
            raise ConfigError(
                f"{self._name}: exists and isn't a symbolic link: name another"
            ) from None
        except OSError as error:
            self.pull()
            raise ConfigError(f"{self._name}: can't be made a symbolic link: {error}") from None

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
        return bool(termios.tcgetattr(self._slave)[4] == self._baud_code)

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
