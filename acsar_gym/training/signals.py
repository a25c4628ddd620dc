"""Handles Ctrl-C and SIGTERM during training, so that the model is saved first."""

from __future__ import annotations

import signal
import threading
from types import FrameType, TracebackType
from typing import Any, Self

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopRequest:
    """A context in which SIGINT and SIGTERM set `number` instead of ending the program.

    This starts with `defer()`; before, there is nothing to save, and a signal ends the program at
    once. So does a second signal. Signals that were ignored stay ignored, such as SIGINT in a
    background process of a shell without job control. Outside the main thread, which can't set
    handlers, signals aren't changed.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        """The signal that arrived; None before."""
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
        """From now on, only record the first signal."""
        self._deferred = True

    @property
    def exit_code(self) -> int:
        """Exit code for shells: 128 plus the signal number, or 0 without a signal."""
        return 0 if self.number is None else 128 + self.number

    def _note(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal: record the first one after defer(), end the program otherwise."""
        first, self.number = self.number is None, number
        if self._deferred and first:
            return
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(self.exit_code)
