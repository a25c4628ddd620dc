"""Files that users name are read here, so that none can hang the program or fill its memory.

Only regular files are read, never a pipe, a device or a folder, and only up to a number of bytes.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

from acsar_gym.errors import AcsarError, ConfigError, shortened

FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
"""A pipe that takes the file's place between check and opening doesn't block either."""
CHUNK = 1 << 20
"""Bytes of one system call."""


def read(path: Path, limit: int, error: type[AcsarError] = ConfigError) -> bytes:
    """The content of a regular file of at most `limit` bytes.

    Raises `error`, whose one line begins with the path, for what isn't a regular file, is larger,
    or can't be read.
    """
    try:
        return content(path, limit, error)
    except error as problem:
        raise error(f"{shortened(str(path))}: {problem}") from None


def content(path: Path, limit: int, error: type[AcsarError] = ConfigError) -> bytes:
    """The same; the message doesn't name the path."""
    try:
        _check(os.stat(path), limit, error)  # noqa: PTH116 - before opening: that resets some boards
        file = os.open(path, FLAGS)
        try:
            _check(os.fstat(file), limit, error)
            data = _chunks(file, limit)
        finally:
            os.close(file)
    except FileNotFoundError:
        raise error("there is no such file") from None
    except (OSError, ValueError) as problem:
        raise error(f"can't be read: {reason(problem)}") from None
    if len(data) > limit:
        raise error(_too_large(limit))
    return data


def write(path: Path, data: bytes, error: type[AcsarError] = ConfigError) -> None:
    """Write a file. Raises `error` where that can't be done, or nobody reads a pipe."""
    try:
        with open(path, "wb", opener=opener) as file:
            file.write(data)
    except (OSError, ValueError) as problem:
        raise error(f"{shortened(str(path))}: can't be written: {reason(problem)}") from None


def opener(path: str, flags: int) -> int:
    """For `open`: opening a pipe that nobody reads or writes is an error and doesn't block."""
    blocking = getattr(os, "O_NONBLOCK", 0)
    file = os.open(path, flags | blocking, 0o666)
    if blocking:
        os.set_blocking(file, True)
    return file


def reason(problem: Exception) -> str:
    """What an exception says, in one short line."""
    return getattr(problem, "strerror", None) or " ".join(str(problem).split())[:200]


def _check(status: os.stat_result, limit: int, error: type[AcsarError]) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise error("isn't a regular file")
    if status.st_size > limit:
        raise error(_too_large(limit))


def _chunks(file: int, limit: int) -> bytes:
    """Up to one byte more than the limit: the size may be unknown, as in /proc, or grow."""
    data = bytearray()
    while len(data) <= limit:
        chunk = os.read(file, min(CHUNK, limit + 1 - len(data)))
        if not chunk:
            break
        data += chunk
    return bytes(data)


def _too_large(limit: int) -> str:
    size = f"{limit / 1e6:g} MB" if limit >= 100_000 else f"{limit:,} bytes"
    return f"is larger than {size}, the most that is read"
