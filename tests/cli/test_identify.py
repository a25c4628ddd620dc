"""The command identify: its errors, and what it writes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_tools import Call, assert_one_line

from acsar_gym import RobotConfig, open_link
from acsar_gym.recording import Recorder
from acsar_gym.robot import Robot

pytestmark = pytest.mark.usefixtures("deadline")
MISSING = "/dev/acsar-missing"


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of 2 s."""
    path = tmp_path_factory.mktemp("short") / "short.mcap"
    config = RobotConfig.preset("acsar")
    with Robot(open_link("planar", config), config, recorder=Recorder(path)) as robot:
        for tick in range(200):
            speed = 4.0 if tick % 50 < 25 else -4.0
            robot.tick((speed, -speed, speed, -speed))
    return path


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        ((), 2, "needs a device, or recordings"),
        (("missing.mcap",), 2, "missing.mcap"),
        ((MISSING,), 2, "add --yes"),
        ((MISSING, "--yes"), 3, f"{MISSING}: no such device"),
        ((MISSING, "--yes", "--duration", "1"), 2, "must be 12 to 600 s"),
        ((MISSING, "--yes", "--twin", "acsar"), 2, "--twin is for simulated robots"),
        (("planar", "--out", "/missing/robot.yaml"), 2, "can't be written"),
        ((MISSING, "--yes", "--out", "x.txt"), 2, "path = 'x.txt': a robot is written to .yaml"),
        (("one.mcap", MISSING), 2, "isn't a recording"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_errors_are_one_line(
    arguments: tuple[str, ...], status: int, said: str, call: Call
) -> None:
    code, _, error = call("identify", *arguments)
    assert code == status, error
    assert_one_line(error, said)


def test_a_short_log_has_reasons_and_no_numbers(short: Path, call: Call, tmp_path: Path) -> None:
    out, figures = tmp_path / "mine.yaml", tmp_path / "found.json"
    code, said, error = call("identify", str(short), "--out", str(out), "--json", str(figures))
    assert code == 0, error
    assert "can't tell: 2.0 s of log" in " ".join(said.split())
    told = {one["name"] for one in json.loads(figures.read_text())["findings"] if one["told"]}
    assert told == {"firmware.feedback_rate"}
    assert RobotConfig.load(out).motor == RobotConfig.preset("acsar").motor
