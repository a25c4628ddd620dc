"""The file that a recording is written to: what it may replace, and that nobody else writes it."""

from __future__ import annotations

import contextlib
import itertools
import os
from pathlib import Path

from acsar_gym import reading
from acsar_gym.errors import ConfigError
from acsar_gym.recording.reader import MCAP_MAGIC

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]


def check_target(path: Path, source: Path | None = None) -> None:
    """Check that a recording may be written here; writes nothing.

    Args:
        path: of the recording.
        source: file that is replayed meanwhile.

    Raises:
        ConfigError: its folder is missing, it is a file of another kind, or it is `source`.
    """
    try:
        if path.is_dir() or not path.parent.is_dir():
            raise ConfigError(f"{path}: can't be written: must be a file in a folder of yours")
        if source is not None and path.exists() and source.exists() and path.samefile(source):
            raise ConfigError(f"{path}: is being replayed: record to another file")
        if path.is_file() and not _is_recording(path):
            raise ConfigError(f"{path}: isn't a recording, so it isn't replaced: name another file")
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: can't be written: {reading.explain_error(error)}") from None


def _is_recording(path: Path) -> bool:
    """Whether a file is an MCAP file, or empty."""
    with path.open("rb") as file:
        return file.read(len(MCAP_MAGIC)) in (b"", MCAP_MAGIC)


def open_exclusively(path: str, flags: int) -> int:
    """Open a file for one recorder only, for `open(opener=...)`; an older recording is kept."""
    file = _open_locked(path, flags)
    if not os.fstat(file).st_size:
        return file
    try:
        Path(path).rename(_free(Path(path)))
        return _open_locked(path, flags)
    finally:
        os.close(file)


def _open_locked(path: str, flags: int) -> int:
    """Open and lock a file; it isn't emptied."""
    file = reading.open_nonblocking(path, flags & ~os.O_TRUNC)
    try:
        _lock_file(file)
    except OSError:
        os.close(file)
        raise
    return file


def _free(path: Path) -> Path:
    """Return the first name of drive.1.mcap, drive.2.mcap, ... that no file has."""
    numbered = (path.with_suffix(f".{number}{path.suffix}") for number in itertools.count(1))
    return next(name for name in numbered if not name.exists())


def _lock_file(file: int) -> None:
    """Lock a file, where the file system can; OSError where another recorder holds it."""
    if fcntl is None:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise OSError(0, "another recorder writes it: name a file for each") from None
    except OSError:
        return


def unlock_file(file: int) -> None:
    """Unlock a file before it is closed, also for processes that were forked meanwhile."""
    if fcntl is not None:
        with contextlib.suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_UN)
