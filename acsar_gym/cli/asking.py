"""The countdown before wheels of a real robot turn."""

from __future__ import annotations

import contextlib
import select
import sys
import time
from collections.abc import Callable, Iterator

from acsar_gym.errors import CancelledError, ConfigError, printable

SECONDS = 3.0
"""Usual length of a countdown [s]."""


def countdown(what: str, seconds: float = SECONDS, *, yes: bool = False) -> None:
    """Say what is about to move, and count down; any key ends it.

    Args:
        what: what will move, and what the user should have done, such as "the wheels of
            /dev/ttyUSB0 will turn: lift the robot".
        seconds: length of the countdown [s].
        yes: don't wait and don't ask, for scripts.

    Raises:
        CancelledError: a key was pressed; nothing has moved.
        ConfigError: standard input is no terminal, so nobody could press a key.
    """
    if yes:
        return
    if not sys.stdin.isatty():
        raise ConfigError(f"{what}: no terminal to ask on; add --yes if that is safe")
    print(f"{printable(what)}. Any key cancels.", flush=True)
    _count(seconds)


def ask(question: str) -> str:
    """Ask on the terminal; CancelledError where it ends."""
    try:
        return input(printable(question))
    except EOFError:
        raise CancelledError("cancelled: no answer") from None


def _count(seconds: float) -> None:
    """Count down once a second; CancelledError at any key."""
    left = seconds
    with _keys() as pressed:
        while left > 0.0:
            print(f"\r{left:.0f} ", end="", flush=True)
            if pressed(min(left, 1.0)):
                raise CancelledError("cancelled by a key; nothing has moved")
            left -= 1.0


@contextlib.contextmanager
def _keys() -> Iterator[Callable[[float], bool]]:
    """Read single keys; yields a function that waits so long [s] and says whether one came.

    Whether standard output is a terminal doesn't matter: it may be piped into a file.
    """
    try:
        import termios  # noqa: PLC0415
        import tty  # noqa: PLC0415
    except ImportError:
        yield _windows_key
        return
    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)
    try:
        tty.setcbreak(number, termios.TCSANOW)
        yield lambda wait: bool(select.select([number], [], [], wait)[0])
    finally:
        termios.tcsetattr(number, termios.TCSAFLUSH, before)  # the key isn't for the shell
        print(flush=True)


def _windows_key(wait: float) -> bool:
    """Wait for a key on Windows [s]."""
    import msvcrt  # noqa: PLC0415

    pressed: Callable[[], bool] = getattr(msvcrt, "kbhit")  # noqa: B009 - unknown on Linux
    deadline = time.monotonic() + wait
    while not pressed() and time.monotonic() < deadline:
        time.sleep(0.02)
    return pressed()
