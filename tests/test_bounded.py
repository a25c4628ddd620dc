"""Whatever file a user names ends in one error line, soon and in little memory."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from acsar_gym import bounded
from acsar_gym.errors import AcsarError, ConfigError, PolicyError


def test_a_file_within_the_limit_is_read(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    assert bounded.read(path, 5) == b"12345"


def test_a_file_over_the_limit_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    with pytest.raises(PolicyError, match=r"file: is larger than 4 bytes"):
        bounded.read(path, 4, PolicyError)
    os.truncate(path, 10**12)
    with pytest.raises(ConfigError, match="is larger than 8 MB"):
        bounded.read(path, 8_000_000)


def test_what_grows_while_it_is_read_is_refused() -> None:
    with pytest.raises(ConfigError, match="is larger than 2 bytes"):
        bounded.read(Path("/proc/self/status"), 2)  # its size is 0


def _special(tmp_path: Path) -> list[Path]:
    pipe, link = tmp_path / "pipe", tmp_path / "link"
    os.mkfifo(pipe)
    link.symlink_to("/dev/zero")
    return [pipe, link, tmp_path, Path("/dev/zero"), Path("/dev/full"), Path("/dev/tty")]


def test_only_regular_files_are_read(tmp_path: Path) -> None:
    for path in _special(tmp_path):
        with pytest.raises(ConfigError, match=f"^{path}: isn't a regular file$"):
            bounded.read(path, 100)


def test_a_path_that_cannot_be_is_one_error(tmp_path: Path) -> None:
    for name in ("missing", "a\0b", "x" * 5000, "\ud800"):
        with pytest.raises(AcsarError, match=r"there is no such file|can't be read"):
            bounded.read(tmp_path / name, 100)
