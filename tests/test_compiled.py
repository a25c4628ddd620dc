"""The cache of compiled code goes when any source is newer."""

from __future__ import annotations

import os
from pathlib import Path

from acsar_gym.compiled import forget_stale


def touch(path: Path, time: float) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    os.utime(path, (time, time))
    return path


def test_indices_older_than_any_source_are_dropped(tmp_path: Path) -> None:
    touch(tmp_path / "called.py", 200.0)
    touch(tmp_path / "caller.py", 100.0)
    old = touch(tmp_path / "__pycache__" / "caller.nbi", 150.0)
    new = touch(tmp_path / "deep" / "__pycache__" / "other.nbi", 250.0)
    assert forget_stale(tmp_path) == [old]
    assert not old.exists()
    assert new.exists()
    assert forget_stale(tmp_path) == []
