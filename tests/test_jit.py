"""Compiled code: its cache is unused when any source has changed, and never stops a program."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from disk_tools import full_disk
from warm_kernels import warm

from acsar_gym import jit as compiled
from acsar_gym.resources import hash_sources
from acsar_gym.tools import warm_up


def plus_one(x: float) -> float:
    return x + 1.0


plus_one.__module__ = "acsar_gym.plus_one"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of this test's compiled code."""
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))
    compiled._warn_once.cache_clear()
    return tmp_path


def count_hits() -> int:
    """Call a newly decorated function. Return how often the cache had its code."""
    function: Any = compiled.loop(plus_one)
    assert function(1.0) == 2.0
    return sum(function.stats.cache_hits.values())


def test_hash_sources_covers_names_and_contents(tmp_path: Path) -> None:
    hashes: set[str] = set()
    for name, content in (("one.py", "y = 1"), ("one.py", "y = 2"), ("two.py", "y = 2")):
        folder = tmp_path / str(len(hashes))
        folder.mkdir()
        (folder / name).write_text(content)
        hashes.add(hash_sources(folder))
        assert len(hashes) == int(folder.name) + 1


def test_loop_uses_cached_code_until_a_source_changes(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert [count_hits(), count_hits()] == [0, 1]
    monkeypatch.setattr(compiled, "FINGERPRINT", "of an edited package")
    assert [count_hits(), count_hits()] == [0, 1]


def test_loop_deletes_old_versions_of_compiled_code(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(2 * compiled.KEPT_FOLDERS):
        monkeypatch.setattr(compiled, "FINGERPRINT", f"edit {number}")
        count_hits()
    assert len(list(folder.iterdir())) == compiled.KEPT_FOLDERS
    assert count_hits() == 1


@pytest.mark.parametrize("kind", ["*.nbc", "*.nbi"])
def test_loop_compiles_damaged_code_again(kind: str, folder: Path) -> None:
    assert [count_hits(), count_hits()] == [0, 1]
    (path,) = folder.rglob(kind)
    os.truncate(path, path.stat().st_size // 2)
    assert count_hits() == 0


def test_loop_survives_a_full_disk(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    count_hits()  # numba itself is imported and cached
    for path in folder.rglob("*.nb?"):
        path.unlink()
    with full_disk(50):
        assert count_hits() == 0
    assert caplog.messages == [compiled.CANNOT_CACHE]


def test_loop_works_without_a_cache(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("numba.config.CACHE_DIR", "/dev/null")
    monkeypatch.setattr(compiled, "PACKAGE", Path(os.devnull))
    monkeypatch.setenv("ACSAR_GYM_CACHE", "off")
    assert [count_hits(), count_hits()] == [0, 0]
    assert caplog.messages == [compiled.CANNOT_CACHE]


COMPILE = """
from acsar_gym import jit
from acsar_gym.vector.kernel import layout
jit.loop(layout.robots_of_block)(0, 1)
"""


def test_loop_announces_a_long_compilation(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", COMPILE]
    messages = [
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stderr
        for _ in range(2)
    ]
    assert messages == [f"{compiled.SLOW_TO_COMPILE}\n", ""]


@pytest.mark.parametrize("name", warm_up.ENV_NAMES)
def test_warm_up_leaves_nothing_to_compile(name: str, caplog: pytest.LogCaptureFixture) -> None:
    done = warm(name)
    assert done.worlds == {"point_goal": 0, "barn": 1}.get(name, 2)
    assert caplog.records == []
    assert warm(name).functions == 0
