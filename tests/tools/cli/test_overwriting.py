"""No command replaces a file that another program wrote."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from cli_tools import assert_one_line
from policy_tools import save
from recording_tools import drive

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.tools.emulation.cable import EmulatedCable

pytestmark = pytest.mark.usefixtures("deadline")

WRITES = [
    "benchmark --html mine.html",
    "calibrate planar straight --json mine.json",
    "emulate --log mine.log",
    "evaluate --link planar --html mine.html",
    "gap tape.mcap --robot acsar --json mine.json",
    "identify planar --json mine.json",
    "policy model.zip --out mine.onnx --trust --env point_goal",
    "run 1 0 --link planar --json mine.json",
    "view tape.mcap --save mine.rrd",
    "worlds convert clutter:7-7 mine.yaml",
    "worlds show open:1 --out mine.png",
]
"""Commands that write a file that the user names, before they do anything else."""


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    drive(tmp_path / "tape.mcap", RobotConfig.of(None), 150)
    save(tmp_path / "model.zip")
    return tmp_path


@pytest.mark.parametrize("line", WRITES)
def test_a_users_file_is_refused_before_the_work(line: str, call: Any, place: Path) -> None:
    name = next(word for word in line.split() if word.startswith("mine."))
    (place / name).write_text("mine")
    code, out, error = call(line)
    assert (code, out) == (2, "")
    assert_one_line(error, f"{name}: exists")
    assert (place / name).read_text() == "mine"


@pytest.mark.parametrize(
    "line",
    [
        "policy point_goal --json out.json",
        "view tape.mcap --save out.rrd",
        "worlds show open:1 --out out.png",
    ],
)
def test_a_commands_result_is_replaced_by_the_same_command_only(
    line: str, place: Path, call: Any
) -> None:
    """An empty file, as of mktemp, is replaced as well."""
    name = line.rpartition(" ")[2]
    (place / name).touch()
    for _ in range(2):
        call.succeed(line)
    assert (place / name).stat().st_size
    call.refuse(
        f"{name}: exists and wasn't written by 'acsar-gym doctor': ", f"doctor --json {name}"
    )


def test_worlds_convert_accepts_its_own_unchanged_file(call: Any, place: Path) -> None:
    for _ in range(2):
        call.succeed("worlds convert clutter:7-7 out.yaml")
    with (place / "out.yaml").open("a", encoding="utf-8") as file:
        file.write("# edited\n")
    call.refuse("out.yaml: exists", "worlds convert clutter:7-7 out.yaml")


def test_emulate_replaces_no_users_link(place: Path) -> None:
    (place / "rob").symlink_to("/dev/ttyUSB0")
    with pytest.raises(ConfigError, match="rob: is a symbolic link to /dev/ttyUSB0: name another"):
        EmulatedCable(115200, place / "rob")
    assert (place / "rob").is_symlink()
