"""What `acsar-gym ros driver` takes from ROS: parameters, files of them, remappings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter, parameter_value_to_python
from ros_tools import Client, StartProgram

pytestmark = pytest.mark.usefixtures("deadline")

DRIVER = ("-m", "acsar_gym", "ros", "driver")
PARAMETERS = """
/**:
  ros__parameters:
    robot: jackal
    link: bullet
    lidar: ""
    wheel_radius: 0.07
    wheel_radus: 0.08
    cmd_vel_timeout: 1
    odom_frame: map_of_wheels
    use_sim_time: true
"""


def read(client: Client, node: str, *names: str) -> list[Any]:
    """Values of parameters."""
    request = GetParameters.Request(names=names)
    answer = client.call(GetParameters, f"{node}/get_parameters", request)
    return [parameter_value_to_python(value) for value in answer.values]


def test_options_count_more_than_parameters(
    client: Client, namespace: str, start_program: StartProgram, tmp_path: Path
) -> None:
    (tmp_path / "params.yaml").write_text(PARAMETERS)
    driver = start_program(
        *(*DRIVER, "--ros-args", "-r", f"__ns:={namespace}", "-r", "__node:=base", "--params-file"),
        *(tmp_path / "params.yaml", "-p", "wheel_separation:=0.4", "-r", "cmd_vel:=go", "--"),
        *("--link", "planar", "--scene", "clutter:7"),
    )
    moved = client.hear(Odometry, "odom")
    names = ("robot", "link", "wheel_radius", "wheel_separation", "cmd_vel_timeout", "max_linear")
    values = read(client, f"{namespace}/base", *names)
    assert values == ["jackal", "planar", 0.07, 0.4, 1, 2.0]
    go = client.publisher(TwistStamped, "go")
    command = TwistStamped()
    command.twist.linear.x = 0.3

    def drives() -> bool:
        go.publish(command)
        return bool(moved.messages) and moved.messages[-1].twist.twist.linear.x > 0.2

    client.wait(drives, "the robot")
    assert moved.messages[-1].header.frame_id == "map_of_wheels"
    assert "wheel_radus: doesn't exist; did you mean 'wheel_radius'?" in driver.printed


def test_parameters_without_effect_cannot_be_set(
    client: Client, namespace: str, start_program: StartProgram
) -> None:
    start_program(*DRIVER, "--link", "planar", "--namespace", namespace)
    request = SetParameters.Request(
        parameters=[Parameter("wheel_radius", value=0.3).to_parameter_msg()]
    )
    answer = client.call(SetParameters, f"{namespace}/acsar_driver/set_parameters", request)
    assert not answer.results[0].successful
    assert "read-only" in answer.results[0].reason


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("-p", "wheel_radius:=abc"), "wheel_radius = 'abc': must be a valid number"),
        (("-p", "control_rate:=33"), "firmware.loop_rate = 200 Hz: must be a whole multiple of"),
        (("-p", "cmd_vel_timeout:=-1.0"), "cmd_vel_timeout = -1: must be positive"),
        (("-p", "publish_tf:=1"), "publish_tf = 1: must be of type bool"),
        (("-p", "twist_covariance_diagonal:=[0.1]"), "must be six variances"),
        (("-p", "robot:=nosuch"), "unknown robot preset 'nosuch'"),
        (("-p", "link:=planar", "-p", "scene:=nosuch:1-1"), "nosuch"),
        (("--params-file", "nofile.yaml"), "Couldn't parse params file: '--params-file nofile.y"),
        (("--nosuch",), "unknown arguments of ROS: ['--nosuch']"),
    ],
)  # fmt: skip
def test_driver_refuses_a_wrong_parameter(
    start_program: StartProgram, deadline: None, arguments: tuple[str, ...], reason: str
) -> None:
    driver = start_program(*DRIVER, "--ros-args", *arguments)
    assert driver.wait() == 2
    assert driver.printed.startswith("acsar-gym: ")
    assert driver.printed.count("\n") == 1
    assert reason in driver.printed
