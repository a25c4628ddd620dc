"""Robots written to YAML files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from config_tools import config_of

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError

FIT = {
    "low": 0.1,
    "high": 0.125,
    "method": "identify",
    "logs": ["0123456789012345", "0000000000000000", "1234567890e12345"],
}
ROBOTS: dict[str, dict[str, Any]] = {
    "defaults": {},
    "geometry": {"wheelbase": 0.25, "left_wheel_radius_multiplier": 0.99},
    "single wheels": {"motor": {"time_constant": [0.1, 0.11, 0.12, 0.13], "gain": 1.01}},
    "nothing instead of a number": {
        "watchdog_timeout": None,
        "firmware": {"command_timeout": None},
        "linear_limits": {"max_acceleration": None},
        "angular_limits": {"max_jerk": 60.0},
    },
    "a fence and a footprint": {
        "geofence": {"max_x": 2.0},
        "footprint": [(0.2, 0.2), (-0.2, 0.2), (-0.2, -0.2), (0.2, -0.2)],
    },
    "texts": {"odom_frame": "süd", "base_frame": "null", "serial_port": "/dev/ttyUSB0"},
    "small numbers": {"firmware": {"delay_samples": [0.0, 1e-5]}, "body": {"slip_speed": 1e-7}},
    "measured": {
        "body": {"turn_factor": 1.6},
        "measured": {"motor.time_constant.a": FIT, "firmware.command_delay": FIT},
    },
}


@pytest.mark.parametrize("name", ROBOTS)
def test_a_saved_robot_is_loaded_back_equal(name: str, tmp_path: Path) -> None:
    config = config_of(**ROBOTS[name])
    config.save(tmp_path / "robot.yaml")
    assert RobotConfig.load(tmp_path / "robot.yaml") == config


def test_a_file_has_the_geometry_and_what_was_changed(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    RobotConfig.preset("acsar").with_(motor={"gain": 1.1}).save(path)
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


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("robot.urdf", "a robot is written to .yaml or .yml"),
        ("robot", "a robot is written to .yaml or .yml"),
        ("missing/robot.yaml", "can't be written: No such file"),
    ],
)
def test_a_file_that_cannot_be_written_is_one_error(name: str, found: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        RobotConfig().save(tmp_path / name)
    assert found in str(caught.value)
    assert "Path(" not in str(caught.value)
