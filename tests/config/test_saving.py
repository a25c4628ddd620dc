"""Robots written into files that exist: what differs is changed, and all else stays."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.resources import ASSETS

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
CHANGES: dict[str, dict[str, Any]] = {
    "nothing": {},
    "a number in a section": {"firmware": {"command_timeout": 0.8}},
    "another list": {"footprint": [(0.3, 0.2), (-0.3, 0.2), (-0.3, -0.2), (0.3, -0.2)]},
    "a new field": {"max_linear": 0.7, "odom_frame": "no"},
    "new sections": {"body": {"mass": 5.0}, "geofence": {"max_x": 2.0}},
    "a wiring": {"wheels": {"a": {"motor": "b"}, "b": {"motor": "a"}}},
    "nothing instead of a number": {"firmware": {"command_timeout": None}},
    "a default": {"wheel_check": True, "name": ""},
    "an interval less": {"measured": {"wheel_radius": INTERVAL}},
    "other intervals": {"measured": {"body.mass": INTERVAL, "motor.gain.b": INTERVAL}},
}
LOST = {
    "another list": {"nose"},
    "an interval less": {"by hand"},
    "other intervals": {"by hand"},
}
"""Comments inside of what was replaced."""
FLOWS = (
    "{wheel_radius: 0.06, measured: {wheel_radius: {low: 0.05, high: 0.07, method: x}, "
    "motor.gain.a: {low: 0.9, high: 1.1, method: x}, motor.gain.b: {low: 0.9, high: 1.1, "
    "method: x}}, firmware: {feedback_rate: 50.0, command_timeout: 0.5}, motor: {gain: 1.0}}"
)


def changed(config: RobotConfig, changes: dict[str, Any]) -> RobotConfig:
    if "measured" in changes and len(changes["measured"]) == 1 and config.measured:
        first = next(iter(changes["measured"]))
        kept = {} if first in config.measured else config.measured
        return config.with_(measured={**kept, **changes["measured"]})
    return config.with_(**changes)


def spaced(text: str) -> list[str]:
    """Lines without their spaces, which are aligned again."""
    return ["".join(line.split()) for line in text.splitlines()]


def comments(text: str) -> list[str]:
    return [line.partition("#")[2].strip() for line in text.splitlines() if "#" in line]


@pytest.mark.parametrize("text", [MINE, FLOWS], ids=["blocks", "flow"])
@pytest.mark.parametrize("name", CHANGES)
def test_differing_values_are_changed_and_the_rest_stays(
    name: str, text: str, tmp_path: Path
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    config = changed(RobotConfig.load(path), CHANGES[name])
    config.save(path)

    assert RobotConfig.load(path) == config
    if name == "nothing":
        assert path.read_text() == text
    if text is MINE:
        lost = set(comments(text)) - set(comments(path.read_text()))
        assert lost <= LOST.get(name, set())
        lines = difflib.ndiff(spaced(text), spaced(path.read_text()))
        assert sum(line[0] == "-" for line in lines) <= max(3, 2 * len(CHANGES[name]))


def test_untouched_numbers_stay_to_the_last_digit(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    interval = "{low: 8.468676132930924e-15, high: 9.012195287534179e-09, method: x}"
    path.write_text(f"measured:\n  firmware.command_delay: {interval}\n")
    RobotConfig.load(path).with_(wheel_radius=0.07).save(path)
    assert interval in path.read_text()


def test_a_file_of_windows_is_changed(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_bytes(b"wheel_radius: 0.06 # tape\r\nmotor:\r\n    gain: 1.1\r\n")
    config = RobotConfig.load(path).with_(motor={"gain": 1.2, "deadband": 0.1})
    config.save(path)
    assert path.read_text() == (
        "wheel_radius: 0.06 # tape\nmotor:\n    gain: 1.2\n    deadband: 0.1\n"
    )
    assert RobotConfig.load(path) == config


@pytest.mark.parametrize("text", ["", "\n", "# only a comment\n", "# no end of line"])
def test_a_file_without_fields_gets_them(text: str, tmp_path: Path) -> None:
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
            "name": st.text(st.characters(exclude_characters="\x85"), max_size=20),
            "odom_frame": st.sampled_from(
                ["null", "no", "1e3", "", "a: b", "# c", "süd", "'", "[x"]
            ),
            "watchdog_timeout": st.none() | st.floats(0.01, 1.0),
            "motor": st.fixed_dictionaries({"gain": st.floats(0.5, 2.0)}),
            "firmware": st.fixed_dictionaries({"delay_samples": st.lists(st.floats(0.0, 1.0))}),
        },
    )
)
def test_any_value_is_read_back(
    tmp_path_factory: pytest.TempPathFactory, fields: dict[str, Any]
) -> None:
    path = tmp_path_factory.mktemp("any") / "mine.yaml"
    path.write_text(MINE)
    config = RobotConfig.load(path).with_(**fields)
    config.save(path)
    assert RobotConfig.load(path) == config
    assert "# The end.\n" in path.read_text()


@pytest.mark.parametrize("preset", ["acsar", "jackal"])
def test_every_preset_keeps_its_remarks(preset: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    text = (ASSETS / "robots" / f"{preset}.yaml").read_text()
    path.write_text(text)
    config = RobotConfig.load(path).with_(wheel_separation_multiplier=1.6, motor={"gain": 1.02})
    config.save(path)
    assert RobotConfig.load(path) == config
    assert set(comments(text)) == set(comments(path.read_text()))


STRANGERS = {
    "notes": "buy: milk\nand: bread\n",
    "a field twice": "wheel_radius: 0.06\nwheel_radius: 0.07\n",
    "of ROS": "base:\n  ros__parameters: {wheel_radius: 0.1}\n",
    "with a mistake": "wheel_radius: 0.06\nwheel_seperation: 0.3\n",
}


@pytest.mark.parametrize("name", STRANGERS)
def test_a_file_of_something_else_is_refused_and_stays(name: str, tmp_path: Path) -> None:
    path = tmp_path / "notes.yaml"
    path.write_text(STRANGERS[name])
    with pytest.raises(ConfigError, match="isn't a robot's file") as caught:
        RobotConfig().save(path)
    assert "\n" not in str(caught.value)
    assert path.read_text() == STRANGERS[name]
    RobotConfig(max_linear=0.7).save(path, force=True)
    assert RobotConfig.load(path).max_linear == 0.7
    assert "milk" not in path.read_text()


def test_a_remark_is_written_once_and_goes_when_it_is_outdated(tmp_path: Path) -> None:
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
