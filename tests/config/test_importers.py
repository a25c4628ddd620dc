"""Robots from the driver's URDF and from controllers, and the refusal of all other robots."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from acsar_gym import RobotConfig, open_link
from acsar_gym.envs.ids import make_vec
from acsar_gym.errors import ConfigError
from acsar_gym.physics.bodies import make_body

Write = Callable[[str, str], str]

SIX_NUMBERS = (
    "write wheel_radius, wheel_separation, wheelbase, wheel_separation_multiplier, max_linear and "
    "max_angular into a YAML file"
)
SKID = """
controller_manager:
  ros__parameters: {update_rate: 50}
base_drive:
  ros__parameters:
    left_wheel_names: [fl_joint, rl_joint]
    right_wheel_names: [fr_joint, rr_joint]
    wheel_separation: 0.42
    wheel_radius: 0.11
    wheel_separation_multiplier: 1.7
    linear.x.max_velocity: 0.8
"""
GRIP = SKID.replace("1.7", "1.0")
PAIR = SKID.replace("fl_joint, rl_joint", "left").replace("fr_joint, rr_joint", "right")
BILLION_LAUGHS = "<!DOCTYPE robot [<!ENTITY e0 'ha'>{}]>".format(
    "".join(f"<!ENTITY e{i} '{f'&e{i - 1};' * 10}'>" for i in range(1, 10))
)


def drive(*lines: str) -> str:
    """A controller's file with more parameters."""
    return SKID + "".join(f"    {line}\n" for line in lines)


def urdf(plugin: str = "acsar_hardware/ACSARInterface", head: str = "", **params: object) -> str:
    lines = [f'<param name="{name}">{value}</param>' for name, value in params.items()]
    joint = '<joint name="front_right"><param name="wheel_radius">9</param></joint>'
    return (
        f"{head}<robot><ros2_control><hardware><plugin>{plugin}</plugin>{''.join(lines)}"
        f"</hardware>{joint}</ros2_control></robot>"
    )


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def save(name: str, text: str) -> str:
        (tmp_path / name).write_text(text, encoding="utf-8")
        return str(tmp_path / name)

    return save


def test_urdf_has_the_parameters_of_the_drivers_document(write: Write) -> None:
    values: dict[str, Any] = {
        "serial_port": "/dev/ttyUSB0",
        "baud_rate": 57600,
        "wheel_radius": 0.07,
        "wheel_separation": 0.4,
        "odom_frame": "odometry",
        "lidar_x_offset": 0.1,
        "lidar_y_offset": -0.2,
    }
    config = RobotConfig.load(write("robot.urdf", urdf(**values, command_mode="fast")))
    assert config == RobotConfig().with_(**values)


def test_urdf_without_a_baud_rate_means_the_drivers_9600(write: Write) -> None:
    config = RobotConfig.load(write("robot.urdf", urdf(serial_port="/dev/ttyUSB0")))
    assert (config.baud_rate, config.control_rate) == (9600, 20.0)
    with pytest.raises(ConfigError, match=r"baud_rate = 9600: carries 28 .*use baud_rate 38400"):
        RobotConfig.load(write("robot.urdf", urdf(control_rate=100)))


def test_urdf_joints_are_measured_if_its_parameters_are_silent(write: Write) -> None:
    places = {"front_right": (0.2, -0.25), "front_left": (0.2, 0.25), "rear_left": (-0.16, 0.25)}
    joints = "".join(
        f'<joint name="{name}_wheel_joint" type="continuous"><origin xyz="{x} {y} 0"/></joint>'
        for name, (x, y) in places.items()
    )
    text = urdf(wheel_radius=0.1).replace("<ros2_control>", f"{joints}<ros2_control>")
    config = RobotConfig.load(write("robot.urdf", text))
    assert (config.wheel_separation, config.wheelbase) == (0.5, 0.36)
    text = text.replace("</hardware>", '<param name="wheelbase">0.3</param></hardware>')
    assert RobotConfig.load(write("robot.urdf", text)).wheelbase == 0.3


def test_controller_is_a_robot(write: Write) -> None:
    config = RobotConfig.of(write("controllers.yaml", SKID))
    assert (config.wheel_radius, config.wheel_separation) == (0.11, 0.42)
    assert config.wheel_separation_multiplier == 1.7
    assert (config.max_linear, config.max_angular) == (0.8, RobotConfig().max_angular)
    assert config.wheel_joints == ("fr_joint", "fl_joint", "rl_joint", "rr_joint")
    skids = 1.0 + (config.wheelbase / config.wheel_separation) ** 2
    assert skids == pytest.approx(1.7, abs=1e-4)
    config.check_simulated()


def test_controller_has_limits_frames_and_time_out(write: Write) -> None:
    lines = [
        "odom_frame_id: wheels",
        "cmd_vel_timeout: 0.25",
        "left_wheel_radius_multiplier: 1.02",
        "linear.x.has_jerk_limits: false",
        "linear.x.min_velocity: -0.4",
        "linear.x.max_acceleration: .nan",
        "linear.x.max_deceleration: -2.5",
        "linear.x.max_jerk: 9.0",
        "angular.z.has_acceleration_limits: false",
        "angular.z.max_velocity: 3.0",
        "angular.z.max_acceleration: 4.0",
        "angular.z.max_jerk: 0.0",
    ]

    config = RobotConfig.of(write("controllers.yaml", drive(*lines)))
    assert config.odom_frame == "wheels"
    assert config.firmware.command_timeout == 0.25
    assert config.left_wheel_radius_multiplier == 1.02
    limits = config.linear_limits.model_dump(exclude_none=True)
    assert limits == {"min_velocity": -0.4, "max_deceleration": -2.5}
    assert config.max_angular == 3.0
    assert config.angular_limits.model_dump(exclude_none=True) == {}

    mine = Path(write("mine.yaml", ""))
    config.save(mine)
    assert RobotConfig.load(mine) == config


def test_controller_without_values_has_defaults(write: Write) -> None:
    """ROS writes NaN for no limit and an empty name for none."""
    lines = ["angular.z.max_velocity: .nan", "cmd_vel_timeout: .nan", "base_frame_id: ''"]
    config = RobotConfig.of(write("controllers.yaml", drive(*lines)))
    assert config == RobotConfig.of(write("plain.yaml", SKID))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (PAIR, r"two driven wheels \(right, left\): only .*--link ros2"),
        (GRIP, f"no file has the wheelbase of this robot, .*--link ros2 .*{SIX_NUMBERS}"),
    ],
)
def test_robot_that_cant_be_simulated_is_left_to_ros(text: str, reason: str, write: Write) -> None:
    config = RobotConfig.of(write("controllers.yaml", text))
    for make in (open_link, make_body):
        with pytest.raises(ConfigError, match=reason):
            make("planar", config)
    with pytest.raises(ConfigError, match=reason):
        make_vec("acsar_gym/PointGoal-v0", 2, robot=config)

    # Four wheels are driven over a wire all the same.
    if config.has_two_wheels:
        with pytest.raises(ConfigError, match=reason):
            open_link("/dev/ttyUSB0", config)
    else:
        open_link("/dev/ttyUSB0", config)


@pytest.mark.parametrize(
    ("file", "text", "expected"),
    [
        ("robot.urdf", urdf("cart/System", wheel_radius=0.1), SIX_NUMBERS),
        ("a.urdf", urdf(baudrate=9600), "'baudrate'; did you mean 'baud_rate'"),
        ("a.urdf", urdf(head=BILLION_LAUGHS, odom_frame="&e9;"), "not a valid URDF: Entit"),
        ("a.yaml", SKID + SKID.replace("base_drive", "spare"), SIX_NUMBERS),
        ("a.yaml", drive("linear: {x: {max_velocity: 0.9}}"), "no nested parameters: write"),
        ("a.yaml", "base_drive: {type: DiffDrive, wheel_radius: 0.1}", SIX_NUMBERS),  # ROS 1
        ("a.yaml", SKID.replace("_joint, r", "_joint, m, r"), "must be two names each"),
        ("a.yaml", SKID.replace("0.42", "wide"), "must be numbers"),
        ("a.yaml", "wheel_radus: 0.1", "'wheel_radus'; did you mean 'wheel_radius'"),
        ("a.yaml", "wheel_base: 0.3", "write wheel_separation for the distance"),
    ],
)
def test_load_refuses_any_other_robot_in_a_line_that_names_the_file(
    file: str, text: str, expected: str, write: Write
) -> None:
    with pytest.raises(ConfigError) as caught:
        RobotConfig.of(write(file, text))
    message = str(caught.value)
    assert expected in message
    assert f"{file}: " in message
    assert "\n" not in message
