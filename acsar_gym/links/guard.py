"""Open ports are closed, motors first, on any way out of the process that Python can see.

Interpreter exit runs `atexit`; SIGTERM, SIGHUP, SIGQUIT and Windows' SIGBREAK run a handler that
closes the ports and then lets the signal have its usual effect; SIGTSTP (Ctrl-Z) stops the motors
before the process is suspended. SIGINT needs none: KeyboardInterrupt unwinds the stack. A handler
that the program has installed itself is left alone. Only the main thread can install handlers: make
the first link there. A forked child closes its copies of the ports without a word: they are its
parent's.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import threading
import weakref
from types import FrameType
from typing import Protocol


class Closable(Protocol):
    """Whatever has to be closed before the process ends."""

    def stop(self) -> None:
        """Command zero and stay open."""

    def close(self) -> None:
        """Stop the motors and close; twice is once."""

    def abandon(self) -> None:
        """Close without a word."""


ENDING = ("SIGTERM", "SIGHUP", "SIGQUIT", "SIGBREAK")
SUSPENDING = ("SIGTSTP",)

_open: weakref.WeakSet[Closable] = weakref.WeakSet()


def install() -> None:
    """Install the signal handlers, where this is the main thread and the program has none."""
    if threading.current_thread() is not threading.main_thread():
        return
    for names, handler in ((ENDING, _on_end), (SUSPENDING, _on_suspend)):
        for name in names:
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, handler)


def guard(link: Closable) -> None:
    """Close `link` when the process ends."""
    _open.add(link)
    install()


def unguard(link: Closable) -> None:
    """The link is closed; forget it."""
    _open.discard(link)


def close_all() -> None:
    """Stop every guarded link, then close them, whatever goes wrong with one of them."""
    with contextlib.ExitStack() as stack:
        for link in list(_open):
            stack.callback(link.close)
        for link in list(_open):
            link.stop()


def _on_end(number: int, frame: FrameType | None) -> None:
    try:
        close_all()
    finally:
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)


def _on_suspend(number: int, frame: FrameType | None) -> None:
    for link in list(_open):
        link.stop()
    os.kill(os.getpid(), signal.SIGSTOP)


def _in_child() -> None:
    for link in list(_open):
        link.abandon()
    for name in (*ENDING, *SUSPENDING):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) in (_on_end, _on_suspend):
            signal.signal(number, signal.SIG_DFL)


atexit.register(close_all)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_child)
