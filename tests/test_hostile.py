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
from cli_tools import assert_one_line
from serial_tools import cli

from acsar_gym.errors import ConfigError, escape_unprintable

WORLD = '{{"name": {}, "start": {{"x": 0, "y": 0}}, "goal": {{"x": 4, "y": 0}}}}'


def test_robot_file_that_is_hostile_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text("[" + "[]," * 20_000 + "]")
    done = cli("run", "1", "0", f"--robot={path}")
    assert done.returncode == 2
    assert_one_line(done.stderr, "must be a mapping")


@pytest.mark.parametrize("name", ["\x1b]0;title\x07\x9b31m\r", "a\u202eb"])
def test_names_reach_the_terminal_without_control_characters(name: str, tmp_path: Path) -> None:
    path = tmp_path / "world.json"
    path.write_text(WORLD.format(json.dumps(name)))
    shown = cli("worlds", "check", path)
    assert shown.returncode == 0
    assert escape_unprintable(name) in shown.stdout
    refused = cli("run", "1", "0", "--link", f"\x1b[31m{name}")
    assert refused.stderr.startswith("acsar-gym: unknown link '\\x1b[31m")
    assert all(c.isprintable() or c == "\n" for c in shown.stdout + refused.stderr)


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
