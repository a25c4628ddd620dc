"""Whatever file, name or number a user gives ends in one error line, soon and in little memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym.errors import ConfigError, escape_unprintable
from acsar_gym.tools.cli import main

Call = Callable[..., tuple[int, str, str]]
MERGES = "a0: &a0 {x: 1}\n" + "".join(
    f"a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}], k{i}: 1}}\n" for i in range(1, 25)
)
DIGITS = "9" * 400
ROBOTS = {
    "merges.yaml": (MERGES, "has an alias"),
    "digits.yaml": (
        f"encoder: {{counts_per_revolution: {DIGITS}}}",
        "counts_per_revolution = 9999",
    ),
    "many.yaml": ("[" + "[]," * 200_000 + "]", "too many values"),
    "unknown.yaml": ("\n".join(f"k{i}: 1" for i in range(5_000)), "unknown field 'k0'"),
    "params.urdf": (
        f"<r><ros2_control><hardware>{'<param/>' * 2_000}</hardware></ros2_control></r>",
        "2,000 params",
    ),
}
WORLD = '{{"name": {}, "start": {{"x": 0, "y": 0}}, "goal": {{"x": 4, "y": 0}}}}'


def assert_one_line(code: int, error: str, found: str) -> None:
    assert code == 2, error
    assert error.startswith("acsar-gym: ")
    assert error.count("\n") == 1
    assert found in error


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    def run(*arguments: str | Path) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["acsar-gym", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        assert isinstance(ended.value.code, int)
        return ended.value.code, *capsys.readouterr()

    return run


@pytest.mark.parametrize("name", ROBOTS)
def test_hostile_robots_are_one_line(name: str, tmp_path: Path, call: Call) -> None:
    text, found = ROBOTS[name]
    path = tmp_path / name
    path.write_text(text)
    code, _, error = call("run", "1", "0", "--link", "planar", "--robot", path)
    assert_one_line(code, error, found)


@pytest.mark.parametrize("name", ["\x1b]0;title\x07\x9b31m\r", "a\u202eb"])
def test_no_control_character_of_a_name_reaches_the_terminal(
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


def test_a_terminal_without_unicode_gets_what_it_can_show(tmp_path: Path) -> None:
    path = tmp_path / "world.json"
    path.write_text(WORLD.format('"\\u4e16"'))
    ascii_only = {**os.environ, "PYTHONIOENCODING": "ascii"}
    command = [sys.executable, "-m", "acsar_gym", "worlds", "check", str(path)]
    done = subprocess.run(command, env=ascii_only, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "\\u4e16" in done.stdout


@pytest.mark.parametrize(
    "arguments",
    [
        {"goal_distance": (10**400, 1)},
        {"view": np.zeros(2)},
        {"link": np.zeros((2, 2, 2))},
        {"faults": {"direction": np.zeros(2)}},
    ],
    ids=lambda arguments: next(iter(arguments)),
)
def test_arguments_of_any_kind_are_one_error(arguments: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as caught:
        gymnasium.make("acsar_gym/PointGoal-v0", **{"link": "planar", **arguments})
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300
