"""Standard streams of a command: closed, full, or read by nobody any more.

A service may have closed them, `| head` reads one line, a disk is full. Each command ends in the
same way then, with its robot stopped, because what goes wrong is an exception like any other.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Callable
from typing import Any, TextIO

CLOSED_PIPE_CODE = 128 + 13
"""Exit code of a program whose output nobody reads any more, as the shell knows it: SIGPIPE."""
FULL_CODE = 2
"""Exit code where standard output can't be written for another reason."""
STREAMS = {"stdin": "r", "stdout": "w", "stderr": "w"}
"""Names in `sys`, by descriptor, and their modes."""


class OutputError(OSError):
    """Standard output or standard error can't be written."""

    @property
    def is_closed_pipe(self) -> bool:
        """Whether nobody reads it any more; Windows says EINVAL then."""
        return self.errno == errno.EPIPE or (os.name == "nt" and self.errno == errno.EINVAL)


class CheckedStream:
    """A text stream that tells its own errors, OutputError, from those of other files."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write text. Raises OutputError."""
        try:
            return self._stream.write(text)
        except OSError as error:
            raise OutputError(error.errno, error.strerror) from error

    def flush(self) -> None:
        """Write what is buffered. Raises OutputError."""
        try:
            self._stream.flush()
        except OSError as error:
            raise OutputError(error.errno, error.strerror) from error

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def open_streams() -> None:
    """Open the standard streams that are closed, as /dev/null.

    Else the next file that is opened gets the free descriptor: a robot's port would be the standard
    output, also that of child processes.
    """
    for number in range(len(STREAMS)):
        try:
            os.fstat(number)
        except OSError:
            null = os.open(os.devnull, os.O_RDWR)  # the lowest that is free: this one
            os.set_inheritable(null, True)
    for name, mode in STREAMS.items():
        for attribute in (f"__{name}__", name):  # libraries use either
            if getattr(sys, attribute) is None:
                setattr(sys, attribute, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115


def print_error(text: str) -> None:
    """Print a line to standard error, if that can be written."""
    with contextlib.suppress(OSError):
        print(text, file=sys.stderr, flush=True)


def run_guarded(command: Callable[[], int]) -> int:
    """Run a command; returns its exit code, or what a lost output makes of it: 141, or 2."""
    open_streams()
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (CheckedStream(stream) for stream in before)
    try:
        code = command()
        try:
            sys.stdout.flush()
        except OutputError as error:
            lost = _explain_loss(error)
            code = code or lost
    except OutputError as error:
        code = _explain_loss(error)
    finally:
        sys.stdout, sys.stderr = before
        for stream in before:
            _let_go(stream)
    return code


def _explain_loss(error: OutputError) -> int:
    """Say why output was lost, unless nobody wants it; returns the exit code."""
    if error.is_closed_pipe:
        return CLOSED_PIPE_CODE
    print_error(f"acsar-gym: the output can't be written: {error.strerror}")
    return FULL_CODE


def _let_go(stream: TextIO) -> None:
    """Let what can't be written go nowhere, else Python tries again at its end, and complains."""
    try:
        stream.flush()
    except OSError:
        with contextlib.suppress(OSError, ValueError):
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, stream.fileno())
            os.close(null)
            stream.flush()
