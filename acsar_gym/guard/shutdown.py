"""Stops motors and closes ports however the process ends, as far as Python can notice.

When the main thread has ended, this is done before threads are joined and `atexit` handlers run,
which may take long. SIGTERM, SIGHUP, SIGQUIT and SIGBREAK (Windows) have a handler that closes the
ports and then lets the signal take its usual effect. SIGTSTP (Ctrl-Z) stops the motors before the
process is suspended. SIGINT needs no handler: KeyboardInterrupt unwinds the stack. A handler that
the program has installed itself is kept. Only the main thread can install handlers, so make the
first link there. A forked child closes its copies of the ports without sending anything.

Other threads may go on driving meanwhile, so links call `check_may_drive` before each command that
turns wheels. It refuses from the first zero command of the end on; and after a signal that asks the
program to end, whose handler may not have run yet: Python runs it when the main thread is back from
C code. But the interpreter at once writes the signal's number to `signal.set_wakeup_fd`, here a
pipe, which `check_may_drive` reads.

Event loops set that descriptor, too (asyncio's `add_signal_handler`, trio). So ours stays, and
`signal.set_wakeup_fd` is replaced by a function that has the numbers forwarded. Other ways don't
last: a handler of `faulthandler.register` goes with the next `signal.signal`, as in `asyncio.run`,
and `sigwait` needs signals that all threads block, those of libraries included.
"""

from __future__ import annotations

import atexit
import concurrent.futures.thread
import contextlib
import os
import select
import signal
import sys
import threading
import time
import weakref
from collections.abc import Callable
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


ENDING_SIGNALS = ("SIGTERM", "SIGHUP", "SIGQUIT", "SIGBREAK")
SUSPENDING_SIGNALS = ("SIGTSTP",)
ASKING_SIGNALS = ("SIGTERM", "SIGHUP", "SIGQUIT", "SIGINT")  # SIGHUP only without a handler
HANDLER_TIME = 0.1  # time of the program's own handler to end the driving of threads [s]

_open: weakref.WeakSet[Closable] = weakref.WeakSet()
_last: set[Callable[[], None]] = set()
_ending = [False]  # a plain flag; with an Event, the handler of a second signal could deadlock
_hooked = [False]  # whether the end of the main thread closes the links


def check_may_drive() -> None:
    """Call before wheels turn, and before that is made possible.

    After a signal that asks the program to end, only the main thread may drive: there its handler
    has run before, and the program goes on all the same. From then on, other threads may again.

    Raises:
        LinkError: the program is ending; or this isn't its main thread, and the program was asked
            to end, or its main thread has ended but for threads that it waits for.
    """
    if _ending[0]:
        raise LinkError("the program is about to end", "nothing drives any more: start it again")
    signals = _signals.read()
    if threading.current_thread() is threading.main_thread():
        signals.clear()
        return
    for number, deadline in list(signals.items()):
        if time.monotonic() >= deadline:
            raise LinkError(
                f"{signal.Signals(number).name} asked the program to end, and a thread drove on",
                "to go on, call activate() or env.reset() in the main thread",
            )
    if _is_main_thread_done():
        raise LinkError(
            "the main thread has ended but for this thread", "let the main thread wait for it"
        )


def _is_main_thread_done() -> bool:
    """Return whether the main thread only waits for threads before it ends.

    `asyncio.run` does so at its end, and the block of an executor that an exception leaves.
    """
    runners = sys.modules.get("asyncio.runners")
    frame = sys._current_frames().get(threading.main_thread().ident or 0)  # noqa: SLF001
    while frame is not None:
        if runners is not None and frame.f_code is runners.Runner.close.__code__:
            return True
        if frame.f_code is concurrent.futures.Executor.__exit__.__code__:
            return frame.f_locals["exc_type"] is not None
        frame = frame.f_back
    return False


def install_handlers() -> None:
    """Watch for the end of the program.

    Signals are handled if this is the main thread, and where the program has no handler.

    `atexit` alone is too late for the end of the main thread: threads that drive are joined before
    it, and other handlers may run first. The interpreter has no public way; this one is what
    `concurrent.futures` uses to join its threads: imported first, it is called last.
    """
    if not _hooked[0]:
        _hooked[0] = True
        try:
            threading._register_atexit(_close_links)  # type: ignore[attr-defined]  # noqa: SLF001
        except RuntimeError:  # the main thread has ended
            _ending[0] = True
    if threading.current_thread() is not threading.main_thread():
        return
    _signals.listen()
    for names, handler in ((ENDING_SIGNALS, _on_end), (SUSPENDING_SIGNALS, _on_suspend)):
        for name in names:
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, handler)


def close_at_exit(link: Closable) -> None:
    """Close `link` when the process ends."""
    _open.add(link)
    install_handlers()


def call_at_end(work: Callable[[], None]) -> None:
    """Call `work` when the process ends, after the links were closed; once for each function."""
    _last.add(work)


def forget_link(link: Closable) -> None:
    """Don't close `link` at exit, as it is closed."""
    _open.discard(link)


def _open_links() -> list[Closable]:
    while True:
        with contextlib.suppress(RuntimeError):  # another thread opened or closed one meanwhile
            return list(_open)


def close_all() -> None:
    """Stop all open links, then close them, and do what `call_at_end` was given.

    For the end of the program: wheels can't be turned afterwards.
    """
    with contextlib.ExitStack() as stack:
        for work in list(_last):
            stack.callback(work)
        _close_links()


def _close_links() -> None:
    """Stop all open links, then close them, even if some of that fails; nothing drives any more."""
    _ending[0] = True
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

    Where wheels turned, the watchdog trips meanwhile: nothing drives on before a reset.
    """
    with contextlib.ExitStack() as stack:
        for link in _open_links():
            stack.enter_context(link.held())
        signal.raise_signal(signal.SIGSTOP)  # sent to this thread, so that it takes effect at once


def _in_child() -> None:
    """Abandon the parent's links in a forked child, and remove the signal handlers."""
    _ending[0] = False
    _signals.abandon()
    for link in _open_links():
        link.abandon()
    for name in (*ENDING_SIGNALS, *SUSPENDING_SIGNALS):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) in (_on_end, _on_suspend):
            signal.signal(number, signal.SIG_DFL)


class _Signals:
    """Reads signal numbers from the pipe that the interpreter writes to."""

    def __init__(self) -> None:
        self._lock = threading.RLock()  # a signal handler may run while this thread holds it
        self._asked: dict[int, float] = {}
        self._pipe: tuple[int, int] | None = None
        self._theirs = -1
        self._forwards = False

    def listen(self) -> None:
        """Have the numbers of signals written to a pipe; in the main thread, and POSIX only."""
        if os.name != "posix":
            return
        if self._pipe is None:
            try:
                self._pipe = os.pipe()
            except OSError:  # too few descriptors: opening the link will say so
                return
            for end in self._pipe:
                os.set_blocking(end, False)
            signal.set_wakeup_fd = self._share
        before = _set_wakeup_fd(self._pipe[1], warn_on_full_buffer=False)
        if before not in (-1, self._pipe[1]):
            self._forward_to(before)

    def read(self) -> dict[int, float]:
        """Return which signals asked the program to end, and from when on threads must heed them.

        [s, monotonic clock]
        """
        with self._lock:
            if self._pipe is None:
                return self._asked
            try:
                numbers = os.read(self._pipe[0], 4096)
            except BlockingIOError:
                return self._asked
            if self._theirs != -1:
                with contextlib.suppress(OSError):
                    os.write(self._theirs, numbers)
            for name in ASKING_SIGNALS:
                number = getattr(signal, name)
                handler = signal.getsignal(number)
                if number not in numbers or handler is signal.SIG_IGN:
                    continue
                if handler is _on_end:
                    self._asked[number] = 0.0
                elif number != signal.SIGHUP:
                    self._asked.setdefault(number, time.monotonic() + HANDLER_TIME)
            return self._asked

    def _share(self, fd: int, /, *, warn_on_full_buffer: bool = True) -> int:
        """Set the descriptor to which numbers are forwarded, as `signal.set_wakeup_fd`."""
        before = _set_wakeup_fd(fd, warn_on_full_buffer=warn_on_full_buffer)  # raises as ever
        if self._pipe is None:
            return before
        before = self._forward_to(fd)
        _set_wakeup_fd(self._pipe[1], warn_on_full_buffer=False)
        return before

    def _forward_to(self, fd: int) -> int:
        """Forward all numbers to this descriptor; returns the one before."""
        with self._lock:
            before, self._theirs = self._theirs, fd
            if fd != -1 and not self._forwards and self._pipe is not None:
                self._forwards = True
                threading.Thread(target=self._forward, args=self._pipe[:1], daemon=True).start()
        return before

    def _forward(self, pipe: int) -> None:
        """Read, which forwards, while nobody drives, too."""
        while True:
            select.select([pipe], [], [])
            self.read()

    def abandon(self) -> None:
        """Leave the parent's pipe alone in a forked child."""
        if self._pipe is None:
            return
        try:
            _set_wakeup_fd(self._theirs)
        except (ValueError, OSError):  # it was closed
            _set_wakeup_fd(-1)
        for end in self._pipe:
            os.close(end)
        self.__init__()  # type: ignore[misc]


_set_wakeup_fd = signal.set_wakeup_fd
_signals = _Signals()
atexit.register(close_all)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_child)
