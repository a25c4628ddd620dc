"""Stops motors and closes ports however the process ends, as far as Python can notice.

When the main thread has ended, this is done before threads are joined and `atexit` handlers run,
which may take long. These signals have handlers from the first link on, unless the program has
installed its own. Only the main thread can install handlers, so create the first link there.

- SIGTERM, SIGHUP, SIGQUIT and SIGBREAK (Windows): the ports are closed, then the signal takes its
  usual effect.
- SIGTSTP (Ctrl-Z): the motors are stopped, then the process is suspended.
- SIGINT (Ctrl-C): the motors are stopped, then KeyboardInterrupt is raised.

Python swallows a KeyboardInterrupt that is raised inside a `__del__` or a callback of C code. So
links call `check_may_drive` before each command that turns wheels, and it raises the exception
again until a link is opened or reset on purpose. Other threads are refused from the first zero
command on. A forked child closes its copies of the ports without sending anything.
"""

from __future__ import annotations

import atexit
import concurrent.futures.thread  # noqa: F401 - adds its hook before ours, see below
import contextlib
import os
import signal
import sys
import threading
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from types import FrameType
from typing import Protocol

from acsar_gym.errors import LinkError


class Closable(Protocol):
    """An object to be closed before the process ends."""

    def held(self) -> contextlib.AbstractContextManager[None]:
        """Command zero, and lock out commands of other threads, as a context manager."""

    def close(self) -> None:
        """Stop the motors and close. Idempotent."""

    def abandon(self) -> None:
        """Close without sending anything."""


@dataclass
class _State:
    """What forbids driving. Plain values, as a signal handler that takes a lock can deadlock.

    Attributes:
        is_ending: Whether the program ends: nothing drives any more.
        is_interrupted: Whether Ctrl-C was pressed, and the main thread hasn't started again.
        is_delivered: Whether code that ends the drive has seen the KeyboardInterrupt of it.
    """

    is_ending: bool = False
    is_interrupted: bool = False
    is_delivered: bool = False


_state = _State()
_open: dict[int, weakref.ref[Closable]] = {}  # links by id()
_last: set[Callable[[], None]] = set()


def check_may_start() -> None:
    """Call when a link is opened or reset, before wheels can turn.

    After Ctrl-C, this lets the robot drive again if it is called in the main thread. If the
    KeyboardInterrupt may have been swallowed, as no link was closed by it, it is raised again.

    Raises:
        LinkError: The program may not drive, see `check_may_drive`.
    """
    install_handlers()
    if _state.is_interrupted and _is_main_thread():
        _note_delivery()
        if not _state.is_delivered:
            _state.is_delivered = True
            raise KeyboardInterrupt
        _state.is_interrupted = False
    check_may_drive()


def check_may_drive() -> None:
    """Call before each command that turns wheels.

    Raises:
        KeyboardInterrupt: This is the main thread, and the exception was swallowed after Ctrl-C.
        LinkError: The program is ending, or this is another thread and Ctrl-C was pressed.
    """
    if _state.is_ending:
        raise LinkError("the program is about to end", "nothing drives any more: start it again")
    if not _state.is_interrupted:
        return
    if _is_main_thread():
        raise KeyboardInterrupt
    raise LinkError(
        "SIGINT asked the program to end, and a thread drove on",
        "to go on, call activate() or env.reset() in the main thread",
    )


def _is_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _note_delivery() -> None:
    if isinstance(sys.exception(), KeyboardInterrupt):
        _state.is_delivered = True


def install_handlers() -> None:
    """Handle signals for which the program has no handler, if this is the main thread."""
    if not _is_main_thread():
        return
    for name, handler in _HANDLERS.items():
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is _get_default(number):
            signal.signal(number, handler)


def _get_default(number: int) -> signal.Handlers | Callable[[int, FrameType | None], None]:
    return signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL


def close_at_exit(link: Closable) -> None:
    """Close `link` when the process ends."""
    _open[id(link)] = weakref.ref(link)
    install_handlers()


def call_at_end(work: Callable[[], None]) -> None:
    """Call `work` when the process ends, after the links were closed. Once for each function."""
    _last.add(work)


def forget_link(link: Closable) -> None:
    """Don't close `link` at exit, as it is closed."""
    _open.pop(id(link), None)
    _note_delivery()


def _open_links() -> list[Closable]:
    return [link for reference in list(_open.values()) if (link := reference()) is not None]


def close_all() -> None:
    """Stop all open links, then close them, and do what `call_at_end` was given.

    For the end of the program: wheels can't be turned afterwards.
    """
    with contextlib.ExitStack() as stack:
        for work in list(_last):
            stack.callback(work)
        _close_links()


def _close_links() -> None:
    """Stop all open links, then close them, even if some of that fails. Nothing drives any more."""
    _state.is_ending = True
    with contextlib.ExitStack() as stack:
        for link in _open_links():
            stack.callback(link.close)
            stack.enter_context(link.held())


def _on_end(number: int, frame: FrameType | None) -> None:
    try:
        close_all()
    finally:
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
        # A PID 1, as in a container, isn't ended by signals that it sends to itself.
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(Exception):
                stream.flush()
        os._exit(128 + number)


def _on_suspend(number: int, frame: FrameType | None) -> None:
    """Stop the motors, then suspend this process.

    If wheels turned, the watchdog trips meanwhile: nothing drives on before a reset.
    """
    with contextlib.ExitStack() as stack:
        for link in _open_links():
            stack.enter_context(link.held())
        signal.raise_signal(signal.SIGSTOP)  # sent to this thread, so that it takes effect at once


def _on_interrupt(number: int, frame: FrameType | None) -> None:
    """Stop the motors, then raise KeyboardInterrupt."""
    links = _open_links()
    if links:
        _state.is_delivered = False
        _state.is_interrupted = True
    try:
        for link in links:
            with link.held():
                pass
    finally:
        raise KeyboardInterrupt


_HANDLERS = {
    "SIGTERM": _on_end,
    "SIGHUP": _on_end,
    "SIGQUIT": _on_end,
    "SIGBREAK": _on_end,
    "SIGTSTP": _on_suspend,
    "SIGINT": _on_interrupt,
}


def _in_child() -> None:
    """Abandon the parent's links in a forked child, and remove the signal handlers."""
    _state.is_ending = False
    _state.is_interrupted = False
    for link in _open_links():
        link.abandon()
    for name, handler in _HANDLERS.items():
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is handler:
            signal.signal(number, _get_default(number))


atexit.register(close_all)
# `atexit` is too late for the end of the main thread: threads that drive are joined before it.
# There is no public hook. This is the hook with which `concurrent.futures` joins its threads. It is
# imported first, as the function that was added last is called first.
threading._register_atexit(_close_links)  # type: ignore[attr-defined]  # noqa: SLF001
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_child)
