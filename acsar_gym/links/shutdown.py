"""Stops motors and closes ports however the process ends, as far as Python can notice.

At the exit of the interpreter this is done by `atexit`. SIGTERM, SIGHUP, SIGQUIT and SIGBREAK
(Windows) have a handler that closes the ports and then lets the signal take its usual effect.
SIGTSTP (Ctrl-Z) stops the motors before the process is suspended. SIGINT needs no handler:
KeyboardInterrupt unwinds the stack. A handler that the program has installed itself is kept. Only
the main thread can install handlers, so make the first link there. A forked child closes its copies
of the ports without sending anything.

Other threads may go on driving meanwhile. From the first zero command on, links refuse commands
that turn wheels: see `is_ending`.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
import weakref
from collections.abc import Callable
from types import FrameType
from typing import Protocol


class Closable(Protocol):
    """An object to be closed before the process ends."""

    def held(self) -> contextlib.AbstractContextManager[None]:
        """Command zero, and lock out commands of other threads, as a context manager."""

    def close(self) -> None:
        """Stop the motors and close. Idempotent."""

    def abandon(self) -> None:
        """Close without sending anything."""


ENDING = ("SIGTERM", "SIGHUP", "SIGQUIT", "SIGBREAK")
SUSPENDING = ("SIGTSTP",)

_open: weakref.WeakSet[Closable] = weakref.WeakSet()
_last: set[Callable[[], None]] = set()
_ending = [False]
"""A plain flag; with an Event, the handler of a second signal could deadlock."""


def is_ending() -> bool:
    """Return whether the program is ending, so that wheels must not turn any more."""
    return _ending[0]


def install() -> None:
    """Install the signal handlers, in the main thread and where the program has none."""
    if threading.current_thread() is not threading.main_thread():
        return
    for names, handler in ((ENDING, _on_end), (SUSPENDING, _on_suspend)):
        for name in names:
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, handler)


def close_at_exit(link: Closable) -> None:
    """Close `link` when the process ends."""
    _open.add(link)
    install()


def at_end(work: Callable[[], None]) -> None:
    """Call `work` when the process ends, after the links were closed; once for each function."""
    _last.add(work)


def forget(link: Closable) -> None:
    """Don't close `link` at exit, as it is closed."""
    _open.discard(link)


def _links() -> list[Closable]:
    """Return the open links."""
    while True:
        with contextlib.suppress(RuntimeError):  # another thread opened or closed one meanwhile
            return list(_open)


def close_all() -> None:
    """Stop all open links, then close them, even if some of that fails.

    For the end of the program: wheels can't be turned afterwards.
    """
    _ending[0] = True
    with contextlib.ExitStack() as stack:
        for work in list(_last):
            stack.callback(work)
        for link in _links():
            stack.callback(link.close)
            stack.enter_context(link.held())


def _on_end(number: int, frame: FrameType | None) -> None:
    """Handle a signal that ends the program."""
    try:
        close_all()
    finally:
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
        _exit(128 + number)


def _exit(status: int) -> None:
    """Exit now; a PID 1, as in a container, isn't ended by signals that it sends to itself."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):
            stream.flush()
    os._exit(status)


def _on_suspend(number: int, frame: FrameType | None) -> None:
    """Stop the motors, then suspend this process."""
    with contextlib.ExitStack() as stack:
        for link in _links():
            stack.enter_context(link.held())
        signal.raise_signal(signal.SIGSTOP)  # sent to this thread, so that it takes effect at once


def _in_child() -> None:
    """Abandon the parent's links in a forked child, and remove the signal handlers."""
    _ending[0] = False
    for link in _links():
        link.abandon()
    for name in (*ENDING, *SUSPENDING):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) in (_on_end, _on_suspend):
            signal.signal(number, signal.SIG_DFL)


atexit.register(close_all)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_child)
