"""Robots read from YAML and URDF, and written to YAML."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError

Load = Callable[[str], RobotConfig]

BILLION_LAUGHS = "<!DOCTYPE robot [<!ENTITY e0 'ha'>{}]>".format(
    "".join(f"<!ENTITY e{i} '{f'&e{i - 1};' * 10}'>" for i in range(1, 10))
)


def param(name: str, value: object) -> str:
    return f'<param name="{name}">{value}</param>'


def urdf(*params: str, doctype: str = "") -> str:
    return f"""<?xml version="1.0" encoding="utf-8"?>
{doctype}<robot name="acsar">
  <link name="base_link"/>
  <ros2_control name="acsar" type="system">
    <hardware>
      <plugin>acsar_hardware/ACSARInterface</plugin>
      {" ".join(params)}
    </hardware>
    <joint name="front_right"><param name="wheel_radius">9</param></joint>
  </ros2_control>
</robot>"""


@pytest.fixture
def load_urdf(tmp_path: Path) -> Load:
    def load(text: str) -> RobotConfig:
        path = tmp_path / "robot.urdf"
        path.write_text(text, encoding="utf-8")
        return RobotConfig.load(path)

    return load


@pytest.mark.parametrize("suffix", [".yaml", ".yml"])
def test_yaml_sets_fields_and_sections_and_leaves_the_rest(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"robot{suffix}"
    path.write_text("wheel_radius: 0.07\nodom_frame: süd\nmotor:\n  max_speed: 20\n", "utf-8")
    expected = RobotConfig(wheel_radius=0.07, odom_frame="süd").with_(motor={"max_speed": 20})
    assert RobotConfig.load(path) == expected
    assert RobotConfig.load(str(path)) == expected


@pytest.mark.parametrize(
    ("suffix", "text", "found"),
    [
        (".yaml", "- wheel_radius", "must be a mapping"),
        (".yaml", "odom_frame: \x00", "not valid YAML"),
        (".yaml", "wheel_radius: .nan", "wheel_radius"),
        (".yaml", "body: {mass: 0}", "body.mass"),
        *(
            (".yaml", f"wheel_radius: {scalar}", "")
            for scalar in ("2020-13-45", "!!int abc", "!!bool abc", '!!int ""')
        ),
        (".urdf", "", "not a valid URDF"),
        (".urdf", "<robot><ros2_control/></robot>", "<ros2_control><hardware>"),
        (".urdf", urdf(param("baud_rate", 4800)), "baud_rate"),
        (".urdf", urdf(param("baud_rate", 115200), param("wheel_radius", "")), "wheel_radius"),
        (".urdf.xacro", "{}", "robot.urdf.xacro"),
        ("", "{}", "robot"),
    ],
    ids=lambda text: text[:40],
)
def test_a_bad_file_is_one_line_that_names_it(
    suffix: str, text: str, found: str, tmp_path: Path
) -> None:
    path = tmp_path / f"robot{suffix}"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        RobotConfig.load(path)
    assert str(path) in str(caught.value)
    assert found in str(caught.value)
    assert "\n" not in str(caught.value)


def test_urdf_params_of_the_drivers_document(load_urdf: Load) -> None:
    values = {
        "serial_port": "/dev/ttyUSB0",
        "baud_rate": 57600,
        "wheel_radius": 0.07,
        "wheel_separation": 0.4,
        "odom_frame": "odometry",
        "base_frame": "base",
        "lidar_frame": "laser",
        "lidar_x_offset": 0.1,
        "lidar_y_offset": -0.2,
        "lidar_z_offset": 0.3,
    }
    config = load_urdf(urdf(*(param(name, value) for name, value in values.items())))
    assert config.model_dump(include=set(values)) == values
    assert config == RobotConfig().with_(**values)


def test_urdf_without_a_baud_rate_means_the_drivers_9600(load_urdf: Load) -> None:
    config = load_urdf(urdf(param("serial_port", "/dev/ttyUSB0")))
    assert (config.baud_rate, config.control_rate) == (9600, 20.0)
    assert load_urdf(urdf(param("control_rate", 25))).control_rate == 25.0
    with pytest.raises(ConfigError, match="baud_rate = 9600: carries 28 lines"):
        load_urdf(urdf(param("control_rate", 100)))


@pytest.mark.parametrize(
    ("near", "meant"),
    [
        ("wheel_radus", "wheel_radius"),
        ("baudrate", "baud_rate"),
        ("serial_prt", "serial_port"),
        ("wheel_seperation", "wheel_separation"),
    ],
)
def test_a_near_miss_of_a_urdf_param_is_an_error(load_urdf: Load, near: str, meant: str) -> None:
    with pytest.raises(ConfigError, match=f"unknown param '{near}'; did you mean '{meant}'?"):
        load_urdf(urdf(param(near, 1), param("baud_rate", 115200)))


def test_an_entity_bomb_is_refused_unexploded(load_urdf: Load) -> None:
    bomb = urdf(param("baud_rate", 115200), param("odom_frame", "&e9;"), doctype=BILLION_LAUGHS)
    with pytest.raises(ConfigError, match=r"not a valid URDF: .*Entit") as caught:
        load_urdf(bomb)
    assert len(str(caught.value)) < 1000


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
        "angular_limits": {"max_jerk": 60.0},
    },
    "a fence and a footprint": {
        "geofence": {"max_x": 2.0},
        "footprint": [(0.2, 0.2), (-0.2, 0.2), (-0.2, -0.2), (0.2, -0.2)],
    },
    "a wiring": {"wheels": {"a": {"motor_sign": -1, "sign": -1}, "b": {"sign": -1}}},
    "measured": {
        "body": {"turn_factor": 1.6},
        "measured": {"motor.time_constant.a": FIT, "firmware.command_delay": FIT},
    },
}


@pytest.mark.parametrize("name", ROBOTS)
def test_a_saved_robot_is_loaded_back_equal(name: str, tmp_path: Path) -> None:
    config = RobotConfig(**ROBOTS[name])
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
