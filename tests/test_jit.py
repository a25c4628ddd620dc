"""Compiled code: its cache goes when any source is newer; what takes long is announced."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest

from acsar_gym import cli
from acsar_gym import jit as compiled
from acsar_gym.envs import warm_up
from acsar_gym.errors import MissingExtraError
from acsar_gym.jit import forget_stale

needs_numba = pytest.mark.skipif(not compiled.COMPILED, reason="nothing is compiled")


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


COMPILE = """
import sys
import numpy as np
from acsar_gym import kinematics
from acsar_gym import jit as compiled
from acsar_gym.vector.kernel import layout
compiled.jit(kinematics.twist)(*range(1, 7))
print("small", file=sys.stderr)
state = np.zeros((layout.ROWS, 1))
layout.to_world(state, 0, 1.0, 2.0)
compiled.announcer.said = False
compiled.jit(layout.to_world.py_func)(state, 0, 1.0, 2.0)  # as in the next process: from the cache
print("again", *compiled.NEW, file=sys.stderr)
"""


@needs_numba
def test_compiling_a_batch_is_announced_before_and_only_where_the_cache_has_none(
    tmp_path: Path,
) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", COMPILE]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    small, said, again = done.stderr.splitlines()
    assert small == "small"
    assert said.startswith("acsar_gym: compiling the loops of batches")
    assert again == "again acsar_gym.kinematics.twist acsar_gym.vector.kernel.layout.to_world"


@needs_numba
@pytest.mark.parametrize("name", warm_up.NAMES)
def test_warming_up_leaves_nothing_to_compile(name: str, caplog: pytest.LogCaptureFixture) -> None:
    worlds = {"Barn": "barn:1", "ObstacleGoal": "open:2", "PathFollow": "smooth_path:2"}.get(name)
    options = {"worlds": worlds} if worlds else {}
    done = warm_up.run(name, options=options)
    assert done.worlds == {"PointGoal": 0, "Barn": 1}.get(name, 2)
    assert caplog.records == []
    assert warm_up.run(name, options=options).functions == 0
    assert compiled.LOG.level == logging.NOTSET


@needs_numba
def test_the_command_says_what_it_did(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(warm_up, "NAMES", ("PointGoal",))
    warm_up.run("PointGoal")
    assert cli.COMMANDS["warm-up"]() == 0
    done, ready = capsys.readouterr().out.splitlines()
    assert done.startswith("PointGoal: 0 functions compiled, ")
    assert ready.endswith("everything had been compiled before")


def test_without_numba_there_is_nothing_to_warm_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "COMPILED", False)
    with pytest.raises(MissingExtraError, match="fast"):
        warm_up.run("PointGoal")
