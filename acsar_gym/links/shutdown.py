"""Open ports are closed, motors first, on any way out of the process that Python can see.

Interpreter exit runs `atexit`; SIGTERM, SIGHUP, SIGQUIT and Windows' SIGBREAK run a handler that
closes the ports and then lets the signal have its usual effect; SIGTSTP (Ctrl-Z) stops the motors
before the process is suspended. SIGINT needs none: KeyboardInterrupt unwinds the stack. A handler
that the program has installed itself is left alone. Only the main thread can install handlers: make
the first link there. A forked child closes its copies of the ports without a word: they are its
parent's.

Other threads may go on driving while this happens. From the first zero command on, links refuse
whatever turns wheels: `is_ending` says so.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
import weakref
from types import FrameType
from typing import Protocol


class Closable(Protocol):
    """Whatever has to be closed before the process ends."""

    def held(self) -> contextlib.AbstractContextManager[None]:
        """Command zero; inside the block no other thread commands anything else."""

    def close(self) -> None:
        """Stop the motors and close; idempotent."""

    def abandon(self) -> None:
        """Close without a word."""


ENDING = ("SIGTERM", "SIGHUP", "SIGQUIT", "SIGBREAK")
SUSPENDING = ("SIGTSTP",)

_open: weakref.WeakSet[Closable] = weakref.WeakSet()
_ending = [False]
"""A plain flag: the handler of a second signal would wait for an Event's lock forever."""


def is_ending() -> bool:
    """Whether the program is about to end, so that nothing may turn wheels any more."""
    return _ending[0]


def install() -> None:
    """Install the signal handlers, where this is the main thread and the program has none."""
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


def forget(link: Closable) -> None:
    """The link is closed; forget it."""
    _open.discard(link)


def _links() -> list[Closable]:
    while True:
        with contextlib.suppress(RuntimeError):  # another thread opened or closed one meanwhile
            return list(_open)


def close_all() -> None:
    """Stop every open link, then close them, whatever goes wrong with one of them.

    For the end of the program: nothing can turn wheels afterwards.
    """
    _ending[0] = True
    with contextlib.ExitStack() as stack:
        for link in _links():
            stack.callback(link.close)
            stack.enter_context(link.held())


def _on_end(number: int, frame: FrameType | None) -> None:
    try:
        close_all()
    finally:
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
        _exit(128 + number)


def _exit(status: int) -> None:
    """End at once: the kernel spares PID 1, as in a container, the signals that it sends itself."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):
            stream.flush()
    os._exit(status)


def _on_suspend(number: int, frame: FrameType | None) -> None:
    with contextlib.ExitStack() as stack:
        for link in _links():
            stack.enter_context(link.held())
        signal.raise_signal(signal.SIGSTOP)  # to this thread, so that no other one runs after it


def _in_child() -> None:
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
