"""Ctrl-C and SIGTERM end a training in order: what it has learned is saved."""

from __future__ import annotations

import signal
import threading
from types import FrameType, TracebackType
from typing import Any, Self

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopRequest:
    """While this context is open, SIGINT and SIGTERM set `number` instead of ending the program.

    That holds from `defer()` on: before it there is nothing to save, and the program ends at once,
    as it does with the second signal. A signal that was ignored stays ignored, as SIGINT is where a
    shell without job control has put the program into the background. Only the main thread can
    have handlers; elsewhere the signals keep their effect.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        """The signal that has come."""
        self._deferred = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for each in SIGNALS:
                if signal.getsignal(each) is not signal.SIG_IGN:
                    self._before[each] = signal.signal(each, self._note)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for each, handler in self._before.items():
            signal.signal(each, handler)

    def defer(self) -> None:
        """From now on the first signal is only noted."""
        self._deferred = True

    @property
    def exit_code(self) -> int:
        """128 and the number of the signal, as shells say it; 0 without one."""
        return 0 if self.number is None else 128 + self.number

    def _note(self, number: int, frame: FrameType | None) -> None:
        first, self.number = self.number is None, number
        if self._deferred and first:
            return
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(self.exit_code)
