"""Every file, name or number that a user gives ends in one error line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym.errors import ConfigError, escape_unprintable
from acsar_gym.tools.cli import main

WORLD = '{{"name": {}, "start": {{"x": 0, "y": 0}}, "goal": {{"x": 4, "y": 0}}}}'


class Call:
    """Runs a command in this process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self.monkeypatch = monkeypatch
        self.capsys = capsys

    def __call__(self, *arguments: str | Path) -> tuple[int, str, str]:
        """Return the exit code and what was printed."""
        self.monkeypatch.setattr(sys, "argv", ["acsar-gym", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        assert isinstance(ended.value.code, int)
        return ended.value.code, *self.capsys.readouterr()


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    return Call(monkeypatch, capsys)


def test_robot_file_that_is_hostile_is_one_line(tmp_path: Path, call: Call) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text("[" + "[]," * 20_000 + "]")
    code, _, error = call("run", "1", "0", f"--robot={path}")
    assert code == 2, error
    assert error.startswith("acsar-gym: ")
    assert error.count("\n") == 1
    assert "must be a mapping" in error


@pytest.mark.parametrize("name", ["\x1b]0;title\x07\x9b31m\r", "a\u202eb"])
def test_names_reach_the_terminal_without_control_characters(
    name: str, tmp_path: Path, call: Call
) -> None:
    path = tmp_path / "world.json"
    path.write_text(WORLD.format(json.dumps(name)))
    code, out, _ = call("worlds", "check", path)
    assert code == 0
    assert escape_unprintable(name) in out
    assert all(c.isprintable() or c == "\n" for c in out)

    _, _, error = call("run", "1", "0", "--link", f"\x1b[31m{name}")
    assert error.startswith("acsar-gym: unknown link '\\x1b[31m")
    assert all(c.isprintable() or c == "\n" for c in error)


def test_names_are_escaped_on_a_terminal_without_unicode(tmp_path: Path) -> None:
    path = tmp_path / "world.json"
    path.write_text(WORLD.format('"\\u4e16"'))
    command = [sys.executable, "-m", "acsar_gym", "worlds", "check", str(path)]
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "\\u4e16" in done.stdout


@pytest.mark.parametrize(
    "arguments",
    [{"goal_distance": (10**400, 1)}, {"view": np.zeros(2)}, {"link": np.zeros((2, 2, 2))}],
    ids=lambda arguments: next(iter(arguments)),
)
def test_make_refuses_arguments_of_any_kind_in_one_error(arguments: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as caught:
        gymnasium.make("acsar_gym/PointGoal-v0", **{"link": "planar", **arguments})
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300
