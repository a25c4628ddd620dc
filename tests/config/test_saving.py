"""Robots read from YAML and written: what differs is changed in a file, and all else stays."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

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
CHANGES: dict[str, tuple[dict[str, Any], set[str]]] = {
    "nothing": ({}, set()),
    "a number in a section": ({"firmware": {"command_timeout": 0.8}}, set()),
    "another list": ({"footprint": [(0.3, 0.2), (-0.3, 0.2), (0.0, -0.2)]}, {"nose"}),
    "new fields": ({"max_linear": 0.7, "odom_frame": "no", "body": {"mass": 5.0}}, set()),
    "nothing instead of a number": ({"firmware": {"command_timeout": None}}, set()),
    "a default": ({"wheel_check": True, "name": ""}, set()),
    "an interval less": ({"measured": {"wheel_radius": INTERVAL}}, {"by hand"}),
    "other intervals": ({"measured": {"motor.gain.b": INTERVAL}}, {"by hand"}),
}
"""Changes, and the comments inside of what they replace."""
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


@pytest.mark.parametrize("text", [MINE, FLOWS], ids=["blocks", "flow"])
@pytest.mark.parametrize("name", CHANGES)
def test_save_changes_what_differs_and_the_rest_stays(name: str, text: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    changes, lost = CHANGES[name]
    config = RobotConfig.load(path).with_(**changes)
    config.save(path)

    assert RobotConfig.load(path) == config
    if name == "nothing":
        assert path.read_text() == text
    if text is MINE:
        assert set(comments(text)) - set(comments(path.read_text())) <= lost
        lines = difflib.ndiff(spaced(text), spaced(path.read_text()))
        assert sum(line[0] == "-" for line in lines) <= max(3, 2 * len(changes))


def test_save_leaves_other_numbers_to_the_last_digit(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    interval = "{low: 8.468676132930924e-15, high: 9.012195287534179e-09, method: x}"
    path.write_text(f"measured:\n  firmware.command_delay: {interval}\n")
    RobotConfig.load(path).with_(wheel_radius=0.07).save(path)
    assert interval in path.read_text()


def test_save_changes_a_file_of_windows(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_bytes(b"wheel_radius: 0.06 # tape\r\nmotor:\r\n    gain: 1.1\r\n")
    config = RobotConfig.load(path).with_(motor={"gain": 1.2, "deadband": 0.1})
    config.save(path)
    assert path.read_text() == (
        "wheel_radius: 0.06 # tape\nmotor:\n    gain: 1.2\n    deadband: 0.1\n"
    )
    assert RobotConfig.load(path) == config


@pytest.mark.parametrize("text", ["", "\n", "# only a comment\n", "# no end of line"])
def test_save_adds_fields_to_a_file_without(text: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    config = RobotConfig(max_linear=0.7, motor={"gain": 1.1})
    config.save(path)
    assert RobotConfig.load(path) == config
    assert path.read_text().startswith(f"{text}\nmax_linear" if "no end" in text else text)


@given(
    st.fixed_dictionaries(
        {},
        optional={
            "wheel_radius": st.floats(0.02, 0.9),
            "name": st.text(st.characters(codec="utf-8", exclude_characters="\x85"), max_size=20),
            "odom_frame": st.sampled_from(["null", "no", "1e3", "", "a: b", "# c", "'", "[x"]),
            "watchdog_timeout": st.none() | st.floats(0.01, 1.0),
            "firmware": st.fixed_dictionaries({"delay_samples": st.lists(st.floats(0.0, 1.0))}),
        },
    )
)
def test_save_and_load_any_value(
    tmp_path_factory: pytest.TempPathFactory, fields: dict[str, Any]
) -> None:
    path = tmp_path_factory.mktemp("any") / "mine.yaml"
    path.write_text(MINE)
    config = RobotConfig.load(path).with_(**fields)
    config.save(path)
    assert RobotConfig.load(path) == config
    assert "# The end.\n" in path.read_text()


STRANGERS = {
    "notes": "buy: milk\nand: bread\n",
    "a field twice": "wheel_radius: 0.06\nwheel_radius: 0.07\n",
    "with a mistake": "wheel_radius: 0.06\nwheel_seperation: 0.3\n",
}


@pytest.mark.parametrize("name", STRANGERS)
def test_save_refuses_a_file_of_something_else(name: str, tmp_path: Path) -> None:
    path = tmp_path / "notes.yaml"
    path.write_text(STRANGERS[name])
    with pytest.raises(ConfigError, match="isn't a robot's file") as caught:
        RobotConfig().save(path)
    assert "\n" not in str(caught.value)
    assert path.read_text() == STRANGERS[name]
    RobotConfig(max_linear=0.7).save(path, force=True)
    assert RobotConfig.load(path).max_linear == 0.7
    assert "milk" not in path.read_text()


def test_save_writes_a_remark_once_and_removes_it_when_it_is_outdated(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
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
def test_load_names_a_bad_file_in_one_line(text: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        RobotConfig.load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert expected in message
    assert "\n" not in message


FIT = {"low": 0.1, "high": 0.125, "method": "identify", "logs": ["0123456789012345"] * 2}
ROBOTS: dict[str, dict[str, Any]] = {
    "single wheels": {"motor": {"time_constant": [0.1, 0.11, 0.12, 0.13], "gain": 1.01}},
    "no limit but a fence": {
        "linear_limits": {"max_acceleration": None},
        "geofence": {"max_x": 2.0},
    },
    "a wiring": {"wheels": {"a": {"motor_sign": -1, "sign": -1}, "b": {"sign": -1}}},
    "measured": {"measured": {"motor.time_constant.a": FIT, "firmware.command_delay": FIT}},
}


@pytest.mark.parametrize("name", ROBOTS)
def test_save_is_loaded_back_equal(name: str, tmp_path: Path) -> None:
    config = RobotConfig(**ROBOTS[name])
    config.save(tmp_path / "robot.yaml")
    assert RobotConfig.load(tmp_path / "robot.yaml") == config


def test_save_writes_the_geometry_and_what_was_changed(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    RobotConfig.preset("acsar").with_(motor={"gain": 1.1}).save(path)
    content = yaml.safe_load(path.read_text("utf-8"))
    assert content["motor"] == {"gain": 1.1}
    assert content["wheel_separation_multiplier"] == 1.5378
    assert set(content) == {*GEOMETRY_FIELDS, "motor"}
