"""Robots in ROS parameter files: diff_drive_controller, nav2's footprints, and a URDF."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest
from urdf_tools import FOUR, PLATE, control, four_wheels, mesh, robot, tyre

from acsar_gym import RobotConfig
from acsar_gym.config.fleet import make_fleet
from acsar_gym.errors import ConfigError

Write = Callable[[str, str], str]

WHEELS = """
    left_wheel_names: [fl_joint, rl_joint]
    right_wheel_names: [fr_joint, rr_joint]
"""
FLAT = f"""
controller_manager:
  ros__parameters: {{update_rate: 50}}
base_drive:
  ros__parameters:{WHEELS}
    wheel_separation: 0.42
    wheel_radius: 0.11
    wheel_separation_multiplier: 1.7
    linear.x.max_velocity: 0.8
"""
NESTED = f"""
/**:
  controller_manager:
    ros__parameters:
      update_rate: 30
      base_drive: {{type: diff_drive_controller/DiffDriveController}}
  base_drive:
    ros__parameters:{WHEELS.replace("    ", "      ")}
      wheel_separation: 0.42
      wheel_radius: 0.11
      wheel_separation_multiplier: 1.7
      linear: {{x: {{max_velocity: 0.8}}}}
"""
WILD = f"""
/**:
  ros__parameters: {{wheel_radius: 0.11, wheel_separation: 0.42}}
/r1/base_drive:
  ros__parameters:{WHEELS}
    wheel_separation_multiplier: 1.7
    linear.x.max_velocity: 0.8
"""
NOETIC = """
base_drive:
  type: "diff_drive_controller/DiffDriveController"
  left_wheel: [fl_joint, rl_joint]
  right_wheel: [fr_joint, rr_joint]
  wheel_separation: 0.42
  wheel_radius: 0.11
  wheel_separation_multiplier: 1.7
  linear: {x: {has_velocity_limits: true, max_velocity: 0.8}}
"""
CART = robot(
    PLATE,
    four_wheels("base_link", 0.18, 0.21, 0.0, mesh(), tyre(0.1)),
    control(*FOUR, serial_port="/dev/base"),
)


def drive(*lines: str) -> str:
    """A controller's file with these parameters besides."""
    return FLAT + "".join(f"    {line}\n" for line in lines)


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def save(name: str, text: str) -> str:
        (tmp_path / name).write_text(text)
        return str(tmp_path / name)

    return save


@pytest.mark.parametrize(
    "text", [FLAT, NESTED, WILD, NOETIC], ids=["flat", "nested", "wild", "ros1"]
)
def test_a_controllers_file_is_a_robot(text: str, write: Write) -> None:
    config = RobotConfig.of(write("controllers.yaml", text))
    assert (config.wheel_radius, config.wheel_separation) == (0.11, 0.42)
    assert config.wheel_separation_multiplier == 1.7
    assert (config.max_linear, config.max_angular) == (0.8, RobotConfig().max_angular)
    assert config.wheel_joints == ("fr_joint", "fl_joint", "rl_joint", "rr_joint")
    skids = 1.0 + (config.wheelbase / config.wheel_separation) ** 2
    assert skids == pytest.approx(1.7, abs=1e-4)


def test_limits_and_time_out_are_those_of_humble(write: Write) -> None:
    text = drive(
        "cmd_vel_timeout: 0.25",
        "left_wheel_radius_multiplier: 1.02",
        "linear.x.has_jerk_limits: false",
        "linear.x.min_velocity: -0.4",
        "linear.x.max_acceleration: 1.5",
        "linear.x.min_acceleration: -3.0",
        "linear.x.max_jerk: 9.0",
        "angular.z.has_velocity_limits: false",
        "angular.z.has_acceleration_limits: false",
        "angular.z.max_velocity: 3.0",
        "angular.z.max_acceleration: 4.0",
        "angular.z.max_jerk: 0.0",
        "angular.z.min_jerk: .nan",
    )
    config = RobotConfig.of(write("controllers.yaml", text))
    assert config.firmware.command_timeout == 0.25
    assert config.left_wheel_radius_multiplier == 1.02
    assert config.linear_limits.model_dump(exclude_none=True) == {
        "min_velocity": -0.4,
        "max_acceleration": 1.5,
        "min_acceleration": -3.0,
    }
    assert config.max_angular == RobotConfig().max_angular
    assert config.angular_limits.model_dump(exclude_none=True) == {}


def test_limits_are_those_of_jazzy(write: Write) -> None:
    text = drive(
        "linear.x.min_velocity: -0.8",
        "linear.x.max_acceleration: .nan",
        "linear.x.max_deceleration: -2.5",
        "angular: {z: {max_velocity: 3.0, max_acceleration: 4.0, max_acceleration_reverse: -5.0}}",
        "cmd_vel_timeout: 0.0",
    )
    config = RobotConfig.of(write("controllers.yaml", text))
    assert config.linear_limits.model_dump(exclude_none=True) == {"max_deceleration": -2.5}
    assert config.max_angular == 3.0
    assert config.angular_limits.max_acceleration_reverse == -5.0
    assert config.firmware.command_timeout == RobotConfig().firmware.command_timeout


def test_one_of_several_controllers_is_named(write: Write) -> None:
    file = write(
        "controllers.yaml",
        FLAT
        + FLAT.replace("base_drive", "spare")
        .replace("0.11", "0.2")
        .replace("controller_manager", "another_manager"),
    )
    with pytest.raises(ConfigError, match=r"2 controllers .*base_drive, spare.*FILE:base_drive"):
        RobotConfig.of(file)
    assert RobotConfig.of(f"{file}:base_drive").wheel_radius == 0.11
    assert RobotConfig.of(f"{file}:spare").wheel_radius == 0.2
    with pytest.raises(ConfigError, match="no controller 'spar'; did you mean 'spare'"):
        RobotConfig.of(f"{file}:spar")


def test_urdf_and_controller_complete_each_other(write: Write) -> None:
    urdf = write("cart.urdf", CART)
    renamed = FLAT
    for end, name in (("f", "front"), ("r", "rear")):
        for side, word in (("l", "left"), ("r", "right")):
            renamed = renamed.replace(f"{end}{side}_joint", f"{name}_{word}_wheel_joint")
    config = RobotConfig.of(f"{urdf},{write('controllers.yaml', renamed)}")
    assert (config.wheel_radius, config.wheelbase) == (0.11, 0.36)  # the controller's, the URDF's
    assert (config.wheel_separation_multiplier, config.max_linear) == (1.7, 0.8)
    assert config.serial_port == "/dev/base"
    assert config.body.mass == 42.0
    assert config == RobotConfig.load(urdf, write("controllers.yaml", renamed))
    with pytest.raises(ConfigError, match="no joint 'fl_joint', which the controller drives"):
        RobotConfig.of(f"{urdf},{write('other.yaml', FLAT)}")


def test_a_controller_of_one_wheel_on_each_side_may_be_of_four(write: Write) -> None:
    one = f"{PAIR}, left_wheel_names: [rear_left_wheel_joint], right_wheel_names: "
    one += "[rear_right_wheel_joint]}"
    urdf, controllers = write("cart.urdf", CART), write("controllers.yaml", one)
    with pytest.raises(ConfigError, match="two driven wheels"):
        RobotConfig.of(controllers)
    config = RobotConfig.of(f"{urdf},{controllers}")
    assert (config.wheel_radius, config.wheelbase) == (0.03, 0.36)


NAV2 = """
local_costmap:
  local_costmap:
    ros__parameters: {footprint: "[ [0.35, 0.2], [0.35, -0.2], [-0.3, -0.2], [-0.3, 0.2] ]"}
global_costmap:
  global_costmap:
    ros__parameters: {robot_radius: 0.5}
controller_server:
  ros__parameters: {FollowPath: {max_vel_x: 0.26}}
"""


def test_nav2s_footprint_goes_with_a_robot(write: Write) -> None:
    nav2, urdf = write("nav2.yaml", NAV2), write("cart.urdf", CART)
    for name in (f"{urdf},{nav2}", f"jackal,{nav2}"):
        config = RobotConfig.of(name)
        assert set(config.footprint or ()) == {(0.35, 0.2), (0.35, -0.2), (-0.3, -0.2), (-0.3, 0.2)}
    with pytest.raises(ConfigError, match="nav2 knows the footprint alone"):
        RobotConfig.of(nav2)


def test_a_radius_of_nav2_is_a_round_footprint(write: Write) -> None:
    nav2 = write(
        "nav2.yaml", "local_costmap:\n  ros__parameters: {robot_radius: 0.3, footprint: '[]'}"
    )
    config = RobotConfig.of(f"acsar,{nav2}")
    assert config.footprint is not None
    assert len(config.footprint) == 16
    assert all(math.hypot(x, y) == pytest.approx(0.3, abs=1e-5) for x, y in config.footprint)


PAIR = "d:\n  ros__parameters: {wheel_separation: 0.2, wheel_radius: 0.03"
REFUSED = {
    "two wheels": (
        f"{PAIR}, left_wheel_names: [l], right_wheel_names: [r]}}",
        "two driven wheels (l, r)",
    ),
    "mecanum": (
        "d:\n  ros__parameters: {type: mecanum_drive_controller/MecanumDriveController, x: 1}",
        "a robot with mecanum or omni wheels",
    ),
    "a filter": (
        "ekf_filter_node:\n  ros__parameters: {frequency: 30.0, two_d_mode: true}",
        "is a ROS parameter file (ekf_filter_node) without a diff_drive_controller",
    ),
    "no multiplier": (
        FLAT.replace("1.7", "1.0"),
        "doesn't say wheelbase: a controller doesn't know",
    ),
    "centimetres": (FLAT.replace("0.11", "11"), "wheel_radius = 11: must be 0.005 to 1 m"),
    "a broken footprint": (
        "local_costmap:\n  ros__parameters: {footprint: 'wide'}",
        "footprint = 'wide': must be like",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_isnt_a_robot_is_said_to_be_what_it_is(name: str, write: Write) -> None:
    text, expected = REFUSED[name]
    with pytest.raises(ConfigError) as caught:
        RobotConfig.of(write("params.yaml", text))
    message = str(caught.value)
    assert expected in message
    assert "params.yaml: " in message
    assert "\n" not in message
    assert len(message) < 400


def test_in_a_fleet_a_parameter_file_goes_with_the_robot_before_it(write: Write) -> None:
    urdf, nav2 = write("cart.urdf", CART), write("nav2.yaml", NAV2)
    mine = write("mine.yaml", "wheel_radius: 0.06\n")
    fleet = make_fleet(f"2xacsar,{urdf},{nav2},{mine},jackal")
    assert [len(robot.footprint or ()) for robot in fleet.robots] == [0, 0, 4, 0, 0]
    assert [robot.wheel_radius for robot in fleet.robots] == [0.05, 0.05, 0.1, 0.06, 0.098]
    assert fleet.names[2] == f"{urdf},{nav2}"
