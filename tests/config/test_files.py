"""Robots read from YAML, and written to new files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError


@pytest.mark.parametrize("suffix", [".yaml", ".yml"])
def test_yaml_sets_fields_and_sections_and_leaves_the_rest(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"robot{suffix}"
    path.write_text("wheel_radius: 0.07\nodom_frame: süd\nmotor:\n  max_speed: 20\n", "utf-8")
    expected = RobotConfig(wheel_radius=0.07, odom_frame="süd").with_(motor={"max_speed": 20})
    assert RobotConfig.load(path) == expected
    assert RobotConfig.load(str(path)) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("- wheel_radius", "must be a mapping"),
        ("odom_frame: \x00", "not valid YAML"),
        ("wheel_radius: .nan", "wheel_radius"),
        ("body: {mass: 0}", "body.mass"),
        ("wheel_radius: 2020-13-45", ""),
        ('wheel_radius: !!int ""', ""),
    ],
)
def test_a_bad_file_is_one_line_that_names_it(text: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        RobotConfig.load(path)
    assert str(path) in str(caught.value)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


FIT = {
    "low": 0.1,
    "high": 0.125,
    "method": "identify",
    "logs": ["0123456789012345", "0000000000000000", "1234567890e12345"],
}
ROBOTS: dict[str, dict[str, Any]] = {
    "defaults": {},
    "single wheels": {"motor": {"time_constant": [0.1, 0.11, 0.12, 0.13], "gain": 1.01}},
    "nothing instead of a number": {
        "watchdog_timeout": None,
        "firmware": {"command_timeout": None},
        "linear_limits": {"max_acceleration": None},
    },
    "a fence and a footprint": {
        "geofence": {"max_x": 2.0},
        "footprint": [(0.2, 0.2), (-0.2, 0.2), (-0.2, -0.2), (0.2, -0.2)],
    },
    "a wiring": {"wheels": {"a": {"motor_sign": -1, "sign": -1}, "b": {"sign": -1}}},
    "measured": {"measured": {"motor.time_constant.a": FIT, "firmware.command_delay": FIT}},
}


@pytest.mark.parametrize("name", ROBOTS)
def test_a_saved_robot_is_loaded_back_equal(name: str, tmp_path: Path) -> None:
    config = RobotConfig(**ROBOTS[name])
    config.save(tmp_path / "robot.yaml")
    assert RobotConfig.load(tmp_path / "robot.yaml") == config


def test_a_file_has_the_geometry_and_what_was_changed(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    RobotConfig.preset("acsar").with_(motor={"gain": 1.1}).save(path)

    assert "\nwheel_radius: 0.05\n" in path.read_text("utf-8")
    content = yaml.safe_load(path.read_text("utf-8"))
    assert content["motor"] == {"gain": 1.1}
    assert content["wheel_separation_multiplier"] == 1.5378
    assert set(content) - {"motor"} == {
        "wheel_radius",
        "wheel_separation",
        "wheelbase",
        "wheel_separation_multiplier",
        "left_wheel_radius_multiplier",
        "right_wheel_radius_multiplier",
    }
