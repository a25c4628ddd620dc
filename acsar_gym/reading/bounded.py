"""Reads and writes files named by users, without blocking or filling the memory.

Only regular files are read, no pipes, devices or folders, and only up to a given size.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from acsar_gym.errors import AcsarError, ConfigError, shortened

FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
"""Flags for opening; non-blocking, as a pipe may replace the file after it was checked."""
CHUNK = 1 << 20
"""Bytes read by one system call."""
STREAMS = ("/dev/std", "/dev/fd/", "/proc/")
"""Names of what the program has open already: the shell's "> FILE" must not be replaced."""


def read(path: Path, limit: int, error: type[AcsarError] = ConfigError) -> bytes:
    """Read a regular file.

    Args:
        path: the file.
        limit: largest accepted size [bytes].
        error: class of the exception.

    Raises:
        AcsarError: as `error`, if the file isn't regular, too large, or can't be read. The
            message begins with the path.
    """
    try:
        return content(path, limit, error)
    except error as problem:
        raise error(f"{shortened(str(path))}: {problem}") from None


def content(path: Path, limit: int, error: type[AcsarError] = ConfigError) -> bytes:
    """Read as `read` does; error messages don't contain the path."""
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


@contextlib.contextmanager
def opened(path: Path, limit: int, error: type[AcsarError] = ConfigError) -> Iterator[IO[bytes]]:
    """Open a regular file to read it piece by piece, as a context manager.

    Args:
        path: the file.
        limit: largest accepted size [bytes].
        error: class of the exception.

    Raises:
        AcsarError: as `error`, as by `read`; also for errors inside the block.
    """
    try:
        _check(os.stat(path), limit, error)  # noqa: PTH116 - as in `content`
        with os.fdopen(os.open(path, FLAGS), "rb") as file:
            _check(os.fstat(file.fileno()), limit, error)
            yield file
    except error as problem:
        raise error(f"{shortened(str(path))}: {problem}") from None
    except FileNotFoundError:
        raise error(f"{shortened(str(path))}: there is no such file") from None
    except (OSError, ValueError) as problem:
        raise error(f"{shortened(str(path))}: can't be read: {reason(problem)}") from None


def write_atomically(path: Path, data: bytes, error: type[AcsarError] = ConfigError) -> None:
    """Write a file so that it is either whole, or what it was before; see `replacing`.

    Args:
        path: the file.
        data: its content.
        error: class of the exception.

    Raises:
        AcsarError: as `error`, if it can't be written, or is a pipe that nobody reads.
    """
    try:
        with replacing(path) as new, open(new, "wb", opener=opener) as file:
            file.write(data)
    except (OSError, ValueError) as problem:
        raise error(f"{shortened(str(path))}: can't be written: {reason(problem)}") from None


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Replace a file atomically, as a context manager: the old one stays until the block ends.

    So a full disk, a signal or a power failure leaves the old file or the new one, never half of
    it. The new file keeps the old one's permissions and, where the system allows it, its owner.
    Links stay links to it. Devices and pipes can't be replaced: they are written in place.

    Args:
        path: the file.

    Yields:
        The path to write to: an empty file in the same folder, of the same kind by its suffix.

    Raises:
        OSError: it can't be replaced, as it is write-protected or its folder can't be written.
    """
    try:
        before = os.stat(path)  # noqa: PTH116 - follows links without resolving them
    except FileNotFoundError:
        before = None
    if before and (not stat.S_ISREG(before.st_mode) or str(path).startswith(STREAMS)):
        yield path
        return
    place = Path(os.path.realpath(path))
    if before:
        os.close(os.open(place, os.O_WRONLY))  # raises where it is write-protected
    new = place.with_name(f".{place.stem[:32]}-{secrets.token_hex(4)}{place.suffix}")
    os.close(os.open(new, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    try:
        if before:
            with contextlib.suppress(PermissionError, AttributeError):  # Windows has no owners
                shutil.chown(new, before.st_uid, before.st_gid)
            new.chmod(stat.S_IMODE(before.st_mode))
        yield new
        with new.open("ab") as file:
            os.fsync(file.fileno())
        new.replace(place)
    finally:
        new.unlink(missing_ok=True)


def opener(path: str, flags: int) -> int:
    """Open without blocking, for `open(opener=...)`; a pipe without a peer is an error."""
    blocking = getattr(os, "O_NONBLOCK", 0)
    file = os.open(path, flags | blocking, 0o666)
    if blocking:
        os.set_blocking(file, True)
    return file


def reason(problem: Exception) -> str:
    """Return the message of an exception as one short line."""
    return getattr(problem, "strerror", None) or " ".join(str(problem).split())[:200]


def _check(status: os.stat_result, limit: int, error: type[AcsarError]) -> None:
    """Raise `error` unless it is a regular file within the limit."""
    if not stat.S_ISREG(status.st_mode):
        raise error("isn't a regular file")
    if status.st_size > limit:
        raise error(_too_large(limit))


def _chunks(file: int, limit: int) -> bytes:
    """Read up to limit + 1 bytes; the size may be unknown, as in /proc, or grow."""
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
