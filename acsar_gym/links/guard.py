"""Open ports are closed, motors first, on any way out of the process that Python can see.

Interpreter exit runs `atexit`; SIGTERM and SIGHUP run a handler that closes the ports and then lets
the signal have its usual effect. SIGINT needs none: KeyboardInterrupt unwinds the stack. A handler
that the program has installed itself is left alone.
"""

from __future__ import annotations

import atexit
import os
import signal
import threading
import weakref
from types import FrameType
from typing import Protocol


class Closable(Protocol):
    """Whatever has to be closed before the process ends."""

    def close(self) -> None:
        """Stop the motors and close; twice is once."""


SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))

_open: weakref.WeakSet[Closable] = weakref.WeakSet()


def guard(link: Closable) -> None:
    """Close `link` when the process ends."""
    _open.add(link)
    if threading.current_thread() is threading.main_thread():
        for number in SIGNALS:
            if signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, _on_signal)


def unguard(link: Closable) -> None:
    """The link is closed; forget it."""
    _open.discard(link)


def close_all() -> None:
    """Close every guarded link."""
    for link in list(_open):
        link.close()


def _on_signal(number: int, frame: FrameType | None) -> None:
    close_all()
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


atexit.register(close_all)
