"""The command identify: its errors, and what it writes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_tools import Call, assert_one_line

from acsar_gym import RobotConfig, open_link
from acsar_gym.recording import Recorder
from acsar_gym.robot import Robot
from acsar_gym.tools.cli.sysid import describe_lateness

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
        (("planer",), 2, "did you mean 'planar'"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_errors_are_one_line(
    arguments: tuple[str, ...], status: int, said: str, call: Call
) -> None:
    code, _, error = call("identify", *arguments)
    assert code == status, error
    assert_one_line(error, said)


def test_a_short_log_has_reasons_and_no_file(short: Path, call: Call, tmp_path: Path) -> None:
    out, figures = tmp_path / "mine.yaml", tmp_path / "found.json"
    code, said, error = call("identify", str(short), "--out", str(out), "--json", str(figures))
    assert code == 1
    assert_one_line(error, "nothing to write: nothing new was found")
    assert "can't tell: 2.0 s of log" in " ".join(said.split())
    told = {one["name"] for one in json.loads(figures.read_text())["findings"] if one["told"]}
    assert told == {"firmware.feedback_rate"}
    assert not out.exists()


def test_a_file_that_is_no_device_is_no_unknown_name(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("rob").symlink_to("/dev/acsar-missing")
    code, _, error = call("identify", "rob", "--yes")
    assert code == 2
    assert_one_line(error, "unknown link 'rob': for a device, write its full path, or ./")


def test_a_dead_wheel_is_said_in_one_line(call: Call, tmp_path: Path) -> None:
    twin, out = tmp_path / "twin.yaml", tmp_path / "mine.yaml"
    dead = RobotConfig(motor={"deadband": (0.0, 0.0, 20.0, 0.0)})
    dead.save(twin)
    options = ("--twin", twin, "--duration", "12", "--out", out)
    code, said, error = call("identify", "planar", *options)
    assert code == 0, error
    assert "rear_left never turned: nothing of it was found" in said
    assert out.exists()


def test_a_miswired_robot_is_refused(call: Call, tmp_path: Path) -> None:
    twin, out = tmp_path / "twin.yaml", tmp_path / "mine.yaml"
    RobotConfig(wheels={"a": {"motor": "b"}, "b": {"motor": "a"}}).save(twin)
    options = ("--twin", twin, "--duration", "12", "--out", out)
    code, _, error = call("identify", "planar", *options)
    assert code == 1
    assert_one_line(error, "front_right answers front_left's command: run 'acsar-gym doctor DEV")
    assert not out.exists()


def test_a_computer_that_was_late_is_told() -> None:
    assert describe_lateness(19.6, 20.0, "/dev/ttyUSB0") == ""
    said = describe_lateness(41.1, 20.0, "/dev/ttyUSB0")
    assert "took 41.1 s instead of 20" in said
    assert "acsar-gym doctor /dev/ttyUSB0 --timing" in said
