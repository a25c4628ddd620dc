"""Text files that are written line by line."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import IO

from acsar_gym.errors import ConfigError
from acsar_gym.reading import bounded


def opened(path: Path) -> IO[str]:
    """Open a text file for writing line by line; ConfigError if that fails."""
    try:
        return open(path, "w", buffering=1, encoding="ascii", opener=bounded.opener)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: can't be written: {bounded.reason(error)}") from None


def written(file: IO[str], line: str) -> None:
    """Write a line; ConfigError if that fails, as on a full disk."""
    try:
        file.write(line)
    except OSError as error:
        with contextlib.suppress(OSError):
            file.close()
        raise ConfigError(f"{file.name}: can't be written: {error.strerror}") from None
