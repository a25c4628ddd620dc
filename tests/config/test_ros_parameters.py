"""Robots in ROS parameter files: diff_drive_controller, nav2's footprints, and a URDF."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import gymnasium
import pytest
from urdf_tools import FOUR, PLATE, control, four_wheels, mesh, robot, tyre

from acsar_gym import RobotConfig, open_link
from acsar_gym.config.fleet import make_fleet
from acsar_gym.errors import ConfigError
from acsar_gym.physics.bodies import make_body

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
    assert RobotConfig.of(controllers).ros2.joints is not None
    config = RobotConfig.of(f"{urdf},{controllers}")
    assert (config.wheel_radius, config.wheelbase) == (0.03, 0.36)
    assert config.ros_joints[1:3] == ("front_left_wheel_joint", "rear_left_wheel_joint")
    config.check_simulated()


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


GROUP = """
controller_manager:
  ros__parameters:
    wheel_speeds: {type: velocity_controllers/JointGroupVelocityController}
wheel_speeds:
  ros__parameters: {joints: [rr_joint, fl_joint, fr_joint, rl_joint]}
"""


def test_a_controller_of_single_wheels_needs_a_robot_besides(write: Write) -> None:
    group = write("group.yaml", GROUP)
    robot = write("mine.yaml", "{wheel_radius: 0.1, wheel_separation: 0.4, wheelbase: 0.3}")
    config = RobotConfig.of(f"{robot},{group}")
    assert config.ros2.command == "wheel_speeds"
    assert config.ros2.command_joints == ("rr_joint", "fl_joint", "fr_joint", "rl_joint")
    assert config.ros2.command_topic == "wheel_speeds/commands"
    assert config.ros_joints == ("fr_joint", "fl_joint", "rl_joint", "rr_joint")
    pair = write("pair.yaml", GROUP.replace("rr_joint, fl_joint, fr_joint, rl_joint", "jr_r, jl_l"))
    two = RobotConfig.of(f"{robot},{pair}")
    assert two.ros_joints == ("jr_r", "jl_l", "jl_l", "jr_r")
    assert two.ros2.command_joints == ("jr_r", "jl_l")


def test_a_controller_of_single_wheels_has_the_geometry_of_the_one_beside_it(write: Write) -> None:
    _, _, group = GROUP.partition("wheel_speeds:\n")
    both = write("both.yaml", f"{FLAT}wheel_speeds:\n{group}")
    assert RobotConfig.of(both).ros2.command is None
    config = RobotConfig.of(f"{both}:wheel_speeds")
    assert (config.wheel_radius, config.ros2.command) == (0.11, "wheel_speeds")
    assert config.ros_joints == ("fr_joint", "fl_joint", "rl_joint", "rr_joint")


HUSKY = """
controller_manager:
  ros__parameters:
    update_rate: 10
    joint_state_broadcaster: {type: joint_state_broadcaster/JointStateBroadcaster}
    husky_velocity_controller: {type: diff_drive_controller/DiffDriveController}
husky_velocity_controller:
  ros__parameters:
    left_wheel_names: [front_left_wheel_joint, rear_left_wheel_joint]
    right_wheel_names: [front_right_wheel_joint, rear_right_wheel_joint]
    wheel_separation: 0.5708
    wheels_per_side: 1
    wheel_radius: 0.1651
    wheel_separation_multiplier: 1.0
    publish_rate: 50.0
    odom_frame_id: odom
    base_frame_id: base_link
    cmd_vel_timeout: 0.25
    use_stamped_vel: false
    linear.x.has_velocity_limits: true
    linear.x.max_velocity: 1.0
    linear.x.max_acceleration: 3.0
    angular.z.max_velocity: 2.0
    angular.z.max_acceleration: 6.0
"""
ROSBOT = """
/**:
  controller_manager:
    ros__parameters:
      update_rate: 20
      rosbot_base_controller: {type: diff_drive_controller/DiffDriveController}
  rosbot_base_controller:
    ros__parameters:
      left_wheel_names: [fl_wheel_joint, rl_wheel_joint]
      right_wheel_names: [fr_wheel_joint, rr_wheel_joint]
      wheel_separation: 0.186
      wheel_radius: 0.0425
      wheel_separation_multiplier: 1.45
      use_stamped_vel: true
      linear: {x: {max_velocity: 0.9, min_velocity: -0.9}}
"""
JACKAL = """
j100_0001:
  platform_velocity_controller:
    ros__parameters:
      left_wheel_names: [rear_left_wheel_joint, front_left_wheel_joint]
      right_wheel_names: [rear_right_wheel_joint, front_right_wheel_joint]
      wheel_separation: 0.37559
      wheel_radius: 0.098
      wheel_separation_multiplier: 1.5
      base_frame_id: base_link
"""
LEO = """
diff_drive_controller:
  ros__parameters:
    left_wheel_names: [wheel_FL_joint, wheel_RL_joint]
    right_wheel_names: [wheel_FR_joint, wheel_RR_joint]
    wheel_separation: 0.358
    wheel_radius: 0.0625
    wheel_separation_multiplier: 1.76
"""
ANDINO = """
controller_manager:
  ros__parameters:
    update_rate: 30
    diff_controller: {type: diff_drive_controller/DiffDriveController}
diff_controller:
  ros__parameters:
    publish_rate: 50.0
    base_frame_id: base_link
    left_wheel_names: ['left_wheel_joint']
    right_wheel_names: ['right_wheel_joint']
    wheel_separation: 0.137
    wheel_radius: 0.033
    use_stamped_vel: false
"""
CLEARPATH = (
    "front_right_wheel_joint front_left_wheel_joint rear_left_wheel_joint rear_right_wheel_joint"
)
ROBOTS = {
    "husky": (HUSKY, CLEARPATH, "twist", 10.0, 10.0),
    "rosbot": (ROSBOT, "fr_wheel_joint fl_wheel_joint rl_wheel_joint rr_wheel_joint",
               "twist_stamped", 20.0, 20.0),
    "jackal": (JACKAL, CLEARPATH, None, 100.0, 100.0),
    "leo": (LEO, "wheel_FR_joint wheel_FL_joint wheel_RL_joint wheel_RR_joint", None, 100.0, 100.0),
    "andino": (ANDINO, "right_wheel_joint left_wheel_joint left_wheel_joint right_wheel_joint",
               "twist", 100.0, 30.0),
}  # fmt: skip


@pytest.mark.parametrize("name", ROBOTS)
def test_robots_of_ros_are_known_by_their_controllers(
    name: str, write: Write, tmp_path: Path
) -> None:
    text, joints, command, rate, feedback = ROBOTS[name]
    config = RobotConfig.of(write("controllers.yaml", text))
    assert config.ros_joints == tuple(joints.split())
    assert config.ros2.command == command
    assert (config.control_rate, config.feedback_rate) == (rate, feedback)
    assert config.base_frame == "base_link"
    config.save(tmp_path / "mine.yaml")
    assert RobotConfig.load(tmp_path / "mine.yaml") == config


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (ANDINO, r"two driven wheels \(right_wheel_joint, left_wheel_joint\): only .*--link ros2"),
        (HUSKY, "no file says the wheelbase of this robot, .*give its URDF, too .*--link ros2"),
    ],
)
def test_what_cant_be_simulated_is_left_to_ros(text: str, reason: str, write: Write) -> None:
    file = write("controllers.yaml", text)
    config = RobotConfig.of(file)
    with pytest.raises(ConfigError, match=reason) as caught:
        open_link("planar", config)
    assert str(caught.value).isprintable()
    with pytest.raises(ConfigError, match=reason):
        make_body("planar", config)
    with pytest.raises(ConfigError, match=reason):
        gymnasium.make_vec(
            "acsar_gym/PointGoal-v0",
            num_envs=2,
            vectorization_mode="vector_entry_point",
            robot=file,
        )


def test_a_wire_drives_four_wheels_whose_wheelbase_nobody_knows(write: Write) -> None:
    open_link("/dev/ttyUSB0", write("husky.yaml", HUSKY))
    with pytest.raises(ConfigError, match="two driven wheels"):
        open_link("/dev/ttyUSB0", write("andino.yaml", ANDINO))


def test_a_wheelbase_of_another_file_is_enough_for_a_simulation(write: Write) -> None:
    mine = write("mine.yaml", "wheelbase: 0.512\n")
    config = RobotConfig.of(f"{mine},{write('controllers.yaml', HUSKY)}")
    assert (config.wheelbase, config.wheel_radius, config.ros2.only) == (0.512, 0.1651, None)
    config.check_simulated()


def test_one_joint_may_stand_for_two_wheels_of_a_side(write: Write) -> None:
    text = ANDINO.replace(
        "wheel_radius: 0.033",
        "wheel_radius: 0.033\n    wheels_per_side: 2\n    wheel_separation_multiplier: 1.6",
    )
    config = RobotConfig.of(write("controllers.yaml", text))
    assert config.ros_joints[:2] == ("right_wheel_joint", "left_wheel_joint")
    assert (config.wheelbase / config.wheel_separation) ** 2 == pytest.approx(0.6, abs=1e-3)
    config.check_simulated()


PAIR = "d:\n  ros__parameters: {wheel_separation: 0.2, wheel_radius: 0.03"
REFUSED = {
    "six wheels": (
        f"{PAIR}, left_wheel_names: [a, b, c], right_wheel_names: [d, e, f]}}",
        "is the controller of a robot with 6 wheels (a, b, c, d, e, f)",
    ),
    "one more on the left": (
        f"{PAIR}, left_wheel_names: [a, b], right_wheel_names: [d]}}",
        "is the controller of a robot with 3 wheels (a, b, d)",
    ),
    "one joint twice": (
        f"{PAIR}, left_wheel_names: [a], right_wheel_names: [a]}}",
        "ros2.joints = {'left': 'a', 'right': 'a'}: must name each joint once",
    ),
    "a group of three": (
        GROUP.replace("rr_joint, ", ""),
        "wheel_speeds.joints = ['fl_joint', 'fr_joint', 'rl_joint']: must be a list of 2 or 4",
    ),
    "a group alone": (
        GROUP,
        "doesn't say wheel_radius, wheel_separation and wheelbase: a velocity controller doesn't",
    ),
    "mecanum": (
        "d:\n  ros__parameters: {type: mecanum_drive_controller/MecanumDriveController, x: 1}",
        "a robot with mecanum or omni wheels",
    ),
    "a filter": (
        "ekf_filter_node:\n  ros__parameters: {frequency: 30.0, two_d_mode: true}",
        "is a ROS parameter file (ekf_filter_node) without a diff_drive_controller",
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
