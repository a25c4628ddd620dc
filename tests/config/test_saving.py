"""Robots read from YAML and written: what differs is changed in a file, and all else stays."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Any

import pytest
import yaml

from acsar_gym import RobotConfig
from acsar_gym.config.sections import GEOMETRY_FIELDS
from acsar_gym.errors import ConfigError

MINE = """\
# My robot, with new tyres.
---
# Measured in June.

wheel_radius:   0.060     # calliper
wheel_separation: .3      # tape
name: "it's mine"   # quoted
wheel_check: no

motor: {time_constant: 0.12, gain: [1.0, 0.98, 1.0, 1.01]}   # slow
footprint:
  - [0.2, 0.0]    # nose
  - [-0.17, 0.17]
  - [-0.17, -0.17]
firmware:
  # the board's
  feedback_rate: 50.0
  command_timeout: 5e-1    # its own

  # nothing else of the board
lidar:
  rate: 1e1
encoder: {}
measured:
  wheel_radius: {low: 0.05, high: 0.07, method: calibrate}   # by hand
  motor.gain.a: {low: 0.9, high: 1.1, method: identify}
# The end.
"""
INTERVAL = {"low": 0.1, "high": 0.2, "method": "identify"}
FLOWS = (
    "{wheel_radius: 0.06, measured: {wheel_radius: {low: 0.05, high: 0.07, method: x}, "
    "motor.gain.a: {low: 0.9, high: 1.1, method: x}, motor.gain.b: {low: 0.9, high: 1.1, "
    "method: x}}, firmware: {feedback_rate: 50.0, command_timeout: 0.5}, motor: {gain: 1.0}}"
)


def spaced(text: str) -> list[str]:
    """Lines without their spaces, which are aligned again."""
    return ["".join(line.split()) for line in text.splitlines()]


def comments(text: str) -> list[str]:
    return [line.partition("#")[2].strip() for line in text.splitlines() if "#" in line]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "mine.yaml"


@pytest.mark.parametrize("text", [MINE, FLOWS], ids=["blocks", "flow"])
@pytest.mark.parametrize(
    ("changes", "lost"),
    [
        ({}, set()),
        ({"firmware": {"command_timeout": 0.8}}, set()),
        ({"footprint": [(0.3, 0.2), (-0.3, 0.2), (0.0, -0.2)]}, {"nose"}),
        ({"max_linear": 0.7, "odom_frame": "no", "body": {"mass": 5.0}}, set()),
        ({"firmware": {"command_timeout": None}}, set()),
        ({"wheel_check": True, "name": ""}, set()),  # defaults
        ({"measured": {"wheel_radius": INTERVAL}}, {"by hand"}),
        ({"measured": {"motor.gain.b": INTERVAL}}, {"by hand"}),
    ],
)
def test_save_changes_what_differs_and_the_rest_stays(
    changes: dict[str, Any], lost: set[str], text: str, path: Path
) -> None:
    """Only comments inside of what is replaced are lost."""
    path.write_text(text)
    config = RobotConfig.load(path).with_(**changes)
    config.save(path)

    assert RobotConfig.load(path) == config
    if not changes:
        assert path.read_text() == text
    if text is MINE:
        assert set(comments(text)) - set(comments(path.read_text())) <= lost
        lines = difflib.ndiff(spaced(text), spaced(path.read_text()))
        assert sum(line[0] == "-" for line in lines) <= max(3, 2 * len(changes))


def test_save_leaves_other_numbers_to_the_last_digit(path: Path) -> None:
    interval = "{low: 8.468676132930924e-15, high: 9.012195287534179e-09, method: x}"
    path.write_text(f"measured:\n  firmware.command_delay: {interval}\n")
    RobotConfig.load(path).with_(wheel_radius=0.07).save(path)
    assert interval in path.read_text()


def test_save_changes_a_file_of_windows(path: Path) -> None:
    path.write_bytes(b"wheel_radius: 0.06 # tape\r\nmotor:\r\n    gain: 1.1\r\n")
    config = RobotConfig.load(path).with_(motor={"gain": 1.2, "deadband": 0.1})
    config.save(path)
    assert path.read_bytes() == (
        b"wheel_radius: 0.06 # tape\r\nmotor:\r\n    gain: 1.2\r\n    deadband: 0.1\r\n"
    )
    assert RobotConfig.load(path) == config


def test_save_removes_a_value_in_quotes(path: Path) -> None:
    path.write_text('serial_port: "/dev/ttyUSB0" # cable\nwheel_radius: "0.06"\n')
    config = RobotConfig.load(path).with_(serial_port=None, wheel_radius=0.07)
    config.save(path)
    assert RobotConfig.load(path) == config
    assert "# cable" in path.read_text()


@pytest.mark.parametrize("text", ["", "\n", "# only a comment\n", "# no end of line"])
def test_save_adds_fields_to_a_file_without(text: str, path: Path) -> None:
    path.write_text(text)
    config = RobotConfig(max_linear=0.7, motor={"gain": 1.1})
    config.save(path)
    assert RobotConfig.load(path) == config
    assert path.read_text().startswith(f"{text}\nmax_linear" if "no end" in text else text)


@pytest.mark.parametrize(
    "text", ["null", "no", "1e3", "", "a: b", "# c", "'", "[x", '\u00e9\u2028 "\n\t\x1b']
)
def test_save_and_load_any_text(text: str, path: Path) -> None:
    path.write_text(MINE)
    config = RobotConfig.load(path).with_(
        name=text, odom_frame=text, watchdog_timeout=None, firmware={"delay_samples": [0.0, 1 / 3]}
    )
    config.save(path)
    assert RobotConfig.load(path) == config
    assert "# The end.\n" in path.read_text()


@pytest.mark.parametrize(
    "text",
    [
        "buy: milk\nand: bread\n",
        "wheel_radius: 0.06\nwheel_radius: 0.07\n",
        "wheel_radius: 0.06\nwheel_seperation: 0.3\n",
    ],
)
def test_save_refuses_a_file_of_something_else(text: str, path: Path) -> None:
    path.write_text(text)
    with pytest.raises(ConfigError, match="isn't a robot's file"):
        RobotConfig().save(path)
    assert path.read_text() == text
    RobotConfig(max_linear=0.7).save(path, force=True)
    assert RobotConfig.load(path).max_linear == 0.7
    assert "milk" not in path.read_text()


def test_save_writes_a_remark_once_and_removes_it_when_it_is_outdated(path: Path) -> None:
    path.write_text("# mine\nwheel_radius: 0.06   # tape\n")
    wired = RobotConfig(wheel_radius=0.06, wheels={"a": {"sign": -1}})
    remark = "A guess:\nlook at the wheels."
    for _ in range(2):
        wired.save(path, {"wheels": remark}, outdated=(remark,))
        assert path.read_text().count("# A guess:\n# look at the wheels.\nwheels:") == 1
    wired.save(path, outdated=(remark,))
    assert "guess" not in path.read_text()
    assert path.read_text().startswith("# mine\nwheel_radius: 0.06   # tape\n")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("- wheel_radius", "must be a mapping"),
        ("odom_frame: \x00", "not valid YAML"),
        ("body: {mass: 0}", "body.mass"),
        ("wheel_radius: 2020-13-45", "not valid YAML"),
    ],
)
def test_load_names_a_bad_file_in_one_line(text: str, expected: str, path: Path) -> None:
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        RobotConfig.load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert expected in message
    assert "\n" not in message


def test_save_is_loaded_back_equal(path: Path) -> None:
    fit = INTERVAL | {"logs": ["0123456789012345"] * 2}
    config = RobotConfig(
        motor={"time_constant": [0.1, 0.11, 0.12, 0.13], "gain": 1.01},
        linear_limits={"max_acceleration": None},
        geofence={"max_x": 2.0},
        wheels={"a": {"motor_sign": -1, "sign": -1}, "b": {"sign": -1}},
        measured={"motor.time_constant.a": fit, "firmware.command_delay": fit},
    )
    config.save(path)
    assert RobotConfig.load(path) == config


def test_save_writes_the_geometry_and_what_was_changed(path: Path) -> None:
    RobotConfig.preset("acsar").with_(motor={"gain": 1.1}).save(path)
    content = yaml.safe_load(path.read_text("utf-8"))
    assert content["motor"] == {"gain": 1.1}
    assert content["wheel_separation_multiplier"] == 1.5378
    assert set(content) == {*GEOMETRY_FIELDS, "motor"}
