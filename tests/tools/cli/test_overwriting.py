"""No command replaces a file that somebody else made, unless --force says so."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_tools import Call, assert_one_line
from recording_tools import drive
from zip_tools import save

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.tools.emulation.cable import EmulatedCable

pytestmark = pytest.mark.usefixtures("deadline")

MINE = '{"mine": "I wrote this on a Sunday"}\n'
WRITES = [
    "benchmark --json mine.json",
    "benchmark --html mine.html",
    "calibrate planar straight --json mine.json",
    "demo --json mine.json",
    "doctor --json mine.json",
    "emulate --log mine.log",
    "evaluate --link planar --json mine.json",
    "evaluate --link planar --html mine.html",
    "gap tape.mcap --robot acsar --json mine.json",
    "identify planar --json mine.json",
    "policy point_goal --json mine.json",
    "policy model.zip --out mine.onnx --trust --env point_goal",
    "record info tape.mcap --json mine.json",
    "run 1 0 --link planar --json mine.json",
    "worlds check open:1 --json mine.json",
    "worlds convert clutter:7-7 mine.yaml",
    "worlds show open:1 --out mine.png",
]
"""Commands that write a file of the user's name, before all of their work."""
CHEAP = ("doctor", "policy", "record", "run", "worlds")
"""Commands that do all of their work here."""


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    drive(tmp_path / "tape.mcap", RobotConfig.of(None), 150)
    save(tmp_path / "model.zip")
    return tmp_path


@pytest.mark.parametrize("line", WRITES)
def test_a_file_of_somebody_else_is_refused_before_the_work(
    line: str, call: Call, place: Path
) -> None:
    name = next(word for word in line.split() if word.startswith("mine."))
    (place / name).write_text(MINE)
    code, out, error = call(*line.split())
    assert (code, out) == (2, "")
    assert_one_line(error, f"{name}: exists")
    assert "--force" in error
    assert (place / name).read_text() == MINE
    if line.startswith(CHEAP):
        assert call(*line.split(), "--force")[0] == 0
        assert (place / name).read_bytes() != MINE.encode()


@pytest.mark.parametrize(
    "line",
    [
        "policy point_goal --json out.json",
        "record info tape.mcap --json out.json",
        "worlds check open:1 --json out.json",
        "worlds show open:1 --out out.png",
        "worlds convert clutter:7-7 out.yaml",
        "worlds convert clutter:7-7 out.json",
    ],
)
def test_what_a_command_wrote_itself_is_replaced(line: str, call: Call, place: Path) -> None:
    """And what was empty before, as of mktemp."""
    (file,) = (place / word for word in line.split() if word.startswith("out."))
    file.touch()
    for _ in range(2):
        assert call(*line.split())[::2] == (0, "")
    assert file.stat().st_size


def test_the_result_of_another_command_is_one_of_somebody_else(call: Call, place: Path) -> None:
    assert call("policy", "point_goal", "--json", "out.json")[0] == 0
    assert json.loads(Path("out.json").read_text())["origin"] == "written by acsar-gym policy"
    code, _, error = call("worlds", "check", "open:1", "--json", "out.json")
    assert code == 2
    assert_one_line(error, "out.json: exists and wasn't written by 'acsar-gym worlds check': ")


def test_a_world_that_was_converted_and_then_edited_is_kept(call: Call, place: Path) -> None:
    convert = ("worlds", "convert", "clutter:7-7", "out.yaml")
    assert call(*convert)[0] == 0
    with Path("out.yaml").open("a") as file:
        file.write("# a remark\n")
    assert call(*convert)[0] == 2
    assert Path("out.yaml").read_text().endswith("# a remark\n")
    assert call(*convert, "--force")[0] == 0


def test_an_emulator_replaces_no_link_of_somebody_else(place: Path) -> None:
    (place / "rob").symlink_to("/dev/ttyUSB0")
    with pytest.raises(ConfigError, match="rob: is a symbolic link to /dev/ttyUSB0: name another"):
        EmulatedCable(115200, place / "rob")
    assert (place / "rob").is_symlink()
