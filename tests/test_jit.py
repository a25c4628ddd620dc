"""Compiled code: its cache is unused when any source has changed; what takes long is announced."""

from __future__ import annotations

import itertools
import logging
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from acsar_gym import jit as compiled
from acsar_gym.tasks import PointGoal
from acsar_gym.tools import warm_up
from acsar_gym.vector.kernel import task as kernel


def test_the_fingerprint_is_that_of_names_and_contents_of_all_sources(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    caller, called = tmp_path / "caller.py", tmp_path / "deep" / "called.py"
    caller.write_text("x = 1")
    called.write_text("y = 1")
    before = compiled.hash_sources(tmp_path)
    os.utime(caller, (100.0, 100.0))
    (tmp_path / "notes.txt").touch()
    assert compiled.hash_sources(tmp_path) == before
    called.write_text("y = 2")
    os.utime(called, (100.0, 100.0))  # older than any cached code
    after = compiled.hash_sources(tmp_path)
    called.rename(tmp_path / "deep" / "other.py")
    assert len({before, after, compiled.hash_sources(tmp_path)}) == 3


def plus_one(x: float) -> float:
    return x + 1.0


def test_cached_code_is_used_until_any_source_changes_wherever_numba_keeps_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))

    def hits() -> int:
        function: Any = compiled.loop(plus_one)
        assert function(1.0) == 2.0
        assert Path(function.stats.cache_path).parent == tmp_path
        return sum(function.stats.cache_hits.values())

    assert [hits(), hits()] == [0, 1]
    monkeypatch.setattr(compiled, "FINGERPRINT", "of an edited package")
    assert [hits(), hits()] == [0, 1]


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda content: b"",
    "cut": lambda content: content[: len(content) // 2],
    "one byte": lambda content: content[:-200] + bytes([content[-200] ^ 1]) + content[-199:],
}
TOTAL = ("empty", "cut")
"""Damages that an index without a checksum shows, too."""


@pytest.mark.parametrize(
    ("damage", "kind"), [*itertools.product(DAMAGES, [".nbc"]), *itertools.product(TOTAL, [".nbi"])]
)
def test_damaged_code_is_compiled_anew(
    damage: str,
    kind: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compiled, "GIVEN_WARNINGS", set())

    def hits() -> int:
        function: Any = compiled.loop(plus_one)
        assert function(1.0) == 2.0
        return sum(function.stats.cache_hits.values())

    assert [hits(), hits()] == [0, 1]
    (path,) = tmp_path.rglob(f"*{kind}")
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    assert [hits(), hits()] == [0, 1]
    (told,) = caplog.messages
    assert "is damaged, so it is compiled anew" in told
    assert path.name in told


def test_where_no_cache_can_be_written_functions_are_compiled_without(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("numba.core.caching.CacheImpl._locator_classes", [])
    monkeypatch.setattr(compiled, "GIVEN_WARNINGS", set())
    assert compiled.loop(plus_one)(1.0) == 2.0
    assert callable(kernel.bind_task(PointGoal()))
    assert len(caplog.messages) == 1
    assert "set NUMBA_CACHE_DIR to a folder that can be written" in caplog.messages[0]


COMPILE = """
import sys
from acsar_gym import kinematics
from acsar_gym import jit as compiled
from acsar_gym.vector.kernel import layout
compiled.loop(kinematics.compute_twist)(*range(1, 8))
print("small", file=sys.stderr)
compiled.loop(layout.robots_of_block)(0, 1)
compiled.GIVEN_WARNINGS.clear()
compiled.loop(layout.robots_of_block)(0, 1)  # as in the next process: from the cache
print("again", *compiled.NEWLY_COMPILED, file=sys.stderr)
"""


def test_compiling_a_batch_is_announced_before_and_only_where_the_cache_has_none(
    tmp_path: Path,
) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", COMPILE]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    small, said, again = done.stderr.splitlines()
    assert small == "small"
    assert said.startswith("acsar_gym: compiling the loops of batches")
    assert (
        again
        == "again acsar_gym.kinematics.compute_twist acsar_gym.vector.kernel.layout.robots_of_block"
    )


@pytest.mark.parametrize("name", warm_up.ENV_NAMES)
def test_warming_up_leaves_nothing_to_compile(name: str, caplog: pytest.LogCaptureFixture) -> None:
    worlds = {
        "barn": "barn:1",
        "obstacle_goal": "open:2",
        "crowd": "crowd:2",
        "dyna_barn": "dynabarn:2",
        "path_follow": "smooth_path:2",
    }.get(name)
    options = {"worlds": worlds} if worlds else {}
    done = warm_up.warm_env(name, options=options)
    assert done.worlds == {"point_goal": 0, "barn": 1}.get(name, 2)
    assert caplog.records == []
    assert warm_up.warm_env(name, options=options).functions == 0
    assert compiled.LOG.level == logging.NOTSET
