"""Standard streams of a command that are closed, full, or no longer read."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Callable

CLOSED_PIPE_CODE = 128 + 13
"""Exit code of a program whose output isn't read to its end, as in a shell: that of SIGPIPE."""
FULL_CODE = 2
"""Exit code if standard output can't be written for another reason."""
FULL_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
"""These reasons: a full disk, a quota, `ulimit -f`, a broken disk or a terminal that was closed."""


def open_streams() -> None:
    """Open the standard streams that are closed, as those of a service, as /dev/null.

    Otherwise a robot's port would get the number of the standard output.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            null = os.open(os.devnull, os.O_RDWR)  # gets the lowest free number, the stream's
            os.set_inheritable(null, True)
            stream = open(number, "w" if number else "r", closefd=False, encoding="utf-8")  # noqa: SIM115
            setattr(sys, name, stream)
            setattr(sys, f"__{name}__", stream)


def print_error(text: str) -> None:
    """Print a line to standard error, if that can be written."""
    with contextlib.suppress(OSError):
        print(text, file=sys.stderr, flush=True)


def run_guarded(command: Callable[[], int]) -> int:
    """Run a command. Returns its exit code, or 141 or 2 if its output can't be written."""
    # An error of the command itself has precedence over one of its output.
    code = 0
    try:
        code = command()
        sys.stdout.flush()
    except OSError as error:
        if error.errno == errno.EPIPE:
            code = code or CLOSED_PIPE_CODE
        elif error.errno in FULL_ERRORS:
            print_error(f"acsar-gym: the output can't be written: {error.strerror}")
            code = code or FULL_CODE
        else:
            raise

    # Python flushes the streams again at its end, and would print an error.
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    return code
