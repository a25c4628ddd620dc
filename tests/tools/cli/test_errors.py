"""A bad value of any command is one line that names it, and an exit code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from cli_tools import assert_one_line
from policy_tools import save
from recording_tools import drive

from acsar_gym import RobotConfig

pytestmark = pytest.mark.usefixtures("deadline")

MISSING = "/dev/acsar-missing"
BENCHMARK = "benchmark --sets open/acsar --links planar --scenes 1 --agents turn_drive"
HUGE = str(10**400)
ERRORS = [
    ("run 1 0 --link bulet", 2, "did you mean 'bullet'?"),
    ("run 1 0 --link socket://127.0.0.1:1 --yes", 3, "socket://127.0.0.1:1"),
    ("run 50 0 --link planar", 2, "goal = (50, 0)"),
    ("run 1 0 --link planar --record /dev/full", 2, "/dev/full: "),
    (f"evaluate --link planar --episodes {HUGE}", 2, "--episodes 1000"),
    ("evaluate --workers 0 --link planar", 2, "--workers 0"),
    (f"{BENCHMARK} --address nowhere", 2, "--address 'nowhere'"),
    ("emulate --duration nan", 2, "duration = nan: must be a finite number"),
    ("train --gamma 1.5", 2, "train.gamma = 1.5"),
    ("train --seeds 0-1 --resume runs/x", 2, "--resume: "),
    ("worlds convert clutter:2 two.json", 2, "clutter:2: 2 worlds are too many, at most 1"),
    ("worlds show open:1 --out open.gif", 2, "open.gif: pictures are PNG files"),
    (f"doctor {MISSING} --saw a b c d", 2, "need --spin"),
    ("doctor ros2 --spin --baud-rate 9600", 2, "--spin, --baud-rate: not of a robot in ROS"),
    ("drive --link planar --linear nan", 2, "--linear"),
    ("ros policy --episodes 0", 2, "--episodes 0: must be at least 1"),
    ("record export tape.mcap tape.mcap --to csv", 2, "several recordings: "),
    ("identify planar --out list.yaml", 2, "list.yaml: is there, and isn't a robot's file"),
    (f"identify one.mcap {MISSING}", 2, f"{MISSING}: "),
    ("identify tape.mcap --duration 5", 2, "--duration is for driving a robot"),
    ("calibrate planar turn --speeds 9", 2, "--speeds 9"),
    ("calibrate /dev/ttyUSB9 straight --space 9 9", 2, "--measured-deg"),
    ("calibrate planar straight --distance 0.6 --measured 61.5", 2, "contradicts the odometry"),
    ("gap tape.mcap tape.mcap --robot acsar", 2, "is the same recording as tape.mcap"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that the commands name."""
    folder = tmp_path_factory.mktemp("files")
    data = drive(folder / "tape.mcap", RobotConfig.of(None), 300).read_bytes()
    (folder / "part.mcap").write_bytes(data[: len(data) * 2 // 3])
    (folder / "odd.onnx").write_bytes(bytes(range(256)) * 8)
    (folder / "list.yaml").write_text("buy: milk\n")
    save(folder / "model.zip")
    return folder


@pytest.mark.parametrize(("line", "status", "message"), ERRORS, ids=lambda value: str(value)[:60])
def test_a_bad_value_is_one_line_and_an_exit_code(
    line: str, status: int, message: str, folder: Path, call: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    code, _, error = call(line)
    assert code == status, error
    assert_one_line(error, message)


def test_record_info_describes_a_cut_recording_as_far_as_it_goes(
    folder: Path, call: Any, tmp_path: Path
) -> None:
    code, out, _ = call("record info", folder / "part.mcap", "--json", tmp_path / "info.json")
    assert code == 0
    assert "cut: what followed is missing" in out
    assert not json.loads((tmp_path / "info.json").read_text())["whole"]
