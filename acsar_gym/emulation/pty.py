"""A pseudo-terminal that can be unplugged, and plugged in again under another device name."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from acsar_gym.config import BAUD_RATES
from acsar_gym.errors import ConfigError

try:
    import pty
    import termios
    import tty
except ImportError:
    raise ConfigError("this operating system has no pseudo-terminals to emulate on") from None

CHUNK = 4096
BAUD_CODES = {getattr(termios, f"B{rate}"): rate for rate in BAUD_RATES}


class Cable:
    """The emulated cable of a board.

    Args:
        baud_rate: baud rate of the board.
        name: symbolic link that always points to the current device, as udev maintains in
            /dev/serial/by-id; None for no link.

    Attributes:
        device: path of the device; empty while unplugged.

    Raises:
        ConfigError: the symbolic link can't be created.
    """

    def __init__(self, baud_rate: int, name: Path | None = None) -> None:
        self.device = ""
        self._baud_rate = baud_rate
        self._name = name
        self._descriptors: tuple[int, ...] = ()
        self.plug()

    def plug(self) -> None:
        """Create the device: raw mode, with the board's baud rate until a client sets another one.

        Idempotent.
        """
        if self._descriptors:
            return
        self._master, self._slave = self._descriptors = pty.openpty()
        tty.setraw(self._slave)
        attributes = termios.tcgetattr(self._slave)
        attributes[4] = attributes[5] = getattr(termios, f"B{self._baud_rate}")
        termios.tcsetattr(self._slave, termios.TCSANOW, attributes)
        os.set_blocking(self._master, False)
        self.device = os.ttyname(self._slave)
        self._link()

    def _link(self) -> None:
        """Let the symbolic link point to the device."""
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
    def sound(self) -> bool:
        """Whether client and board have the same baud rate."""
        return BAUD_CODES.get(termios.tcgetattr(self._slave)[4]) == self._baud_rate

    def read(self) -> bytes:
        """Read what the client has sent; nothing while unplugged."""
        with contextlib.suppress(BlockingIOError):
            return os.read(self._master, CHUNK) if self._descriptors else b""
        return b""

    def write(self, data: bytes) -> None:
        """Send to the client; data that nobody reads is lost, as on a UART."""
        if self._descriptors:
            with contextlib.suppress(BlockingIOError):
                os.write(self._master, data)
